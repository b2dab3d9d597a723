"""The structures of XLA's foreign function interface, and its errors, in LLVM IR.

The structures come from the header `xla/ffi/api/c_api.h` in `jax.ffi.include_dir()`.
They are written as LLVM types, which have the layout of the platform's C compiler.
Within a major version of the interface, structures only grow at the end, so that the
offsets of the listed fields do not change. Each structure contains its size, so that
code compiled with an older header still works. Names may change. The names here are the
names of version 0.3; version 0.5 has the same fields at the same offsets. A test
compares the structures with the installed header.
"""

# The lowest version of the interface that has all fields that the handler uses. A
# runtime refuses a handler that requires a newer version than its own.
MAJOR, MINOR = 0, 1

# Values of the interface's enumerations.
EXTENSION_METADATA = 1
INVALID_ARGUMENT, RESOURCE_EXHAUSTED = 3, 8

_HEAD = {"struct_size": "i64", "extension_start": "ptr"}
_LIST = {"size": "i64", "types": "ptr"}

# The fields of each structure in order, up to the last field that is used.
STRUCTS: dict[str, dict[str, str]] = {
    "XLA_FFI_Extension_Base": {"struct_size": "i64", "type": "i32", "next": "ptr"},
    "XLA_FFI_Api_Version": {**_HEAD, "major_version": "i32", "minor_version": "i32"},
    "XLA_FFI_Metadata": {
        "struct_size": "i64",
        "api_version": "%XLA_FFI_Api_Version",
        "traits": "i32",
    },
    "XLA_FFI_Metadata_Extension": {
        "extension_base": "%XLA_FFI_Extension_Base",
        "metadata": "ptr",
    },
    "XLA_FFI_Buffer": {
        **_HEAD,
        "dtype": "i32",
        "data": "ptr",
        "rank": "i64",
        "dims": "ptr",
    },
    "XLA_FFI_Args": {**_HEAD, **_LIST, "args": "ptr"},
    "XLA_FFI_Rets": {**_HEAD, **_LIST, "rets": "ptr"},
    "XLA_FFI_CallFrame": {
        **_HEAD,
        "api": "ptr",
        "ctx": "ptr",
        "stage": "i32",
        "args": "%XLA_FFI_Args",
        "rets": "%XLA_FFI_Rets",
    },
    "XLA_FFI_Error_Create_Args": {**_HEAD, "message": "ptr", "errc": "i32"},
    "XLA_FFI_Error_Destroy_Args": {**_HEAD, "error": "ptr"},
    "XLA_FFI_ThreadPool_Schedule_Args": {
        **_HEAD,
        "ctx": "ptr",
        "task": "ptr",
        "data": "ptr",
    },
    "XLA_FFI_ThreadPool_NumThreads_Args": {
        **_HEAD,
        "ctx": "ptr",
        "num_threads": "ptr",
    },
    "XLA_FFI_Api": {
        **_HEAD,
        "api_version": "%XLA_FFI_Api_Version",
        "internal_api": "ptr",
        "XLA_FFI_Error_Create": "ptr",
        "XLA_FFI_Error_GetMessage": "ptr",
        "XLA_FFI_Error_Destroy": "ptr",
        "XLA_FFI_Handler_Register": "ptr",
        "XLA_FFI_Stream_Get": "ptr",
        "XLA_FFI_Type_Register": "ptr",
        "XLA_FFI_ExecutionContext_Get": "ptr",
        "XLA_FFI_State_Set": "ptr",
        "XLA_FFI_State_Get": "ptr",
        "XLA_FFI_DeviceMemory_Allocate": "ptr",
        "XLA_FFI_DeviceMemory_Free": "ptr",
        "XLA_FFI_ThreadPool_Schedule": "ptr",
        "XLA_FFI_ThreadPool_NumThreads": "ptr",
    },
}


def type_definitions(structs: dict[str, dict[str, str]]) -> str:
    """Return the definitions of structures as LLVM types."""
    return "\n".join(
        f"%{name} = type {{ {', '.join(fields.values())} }}"
        for name, fields in structs.items()
    )


def size_of(struct: str) -> str:
    """Return the constant expression for the size of a structure."""
    return f"ptrtoint (ptr getelementptr (%{struct}, ptr null, i32 1) to i64)"


def field(pointer: str, struct: str, *path: str) -> str:
    """Return the instruction that computes the address of a field.

    **Arguments:**

    - `pointer`: the address of the structure.
    - `struct`: the name of the structure.
    - `path`: the name of the field. If the field is a structure, the name of a field in
        this structure may follow.
    """
    indices, current = ["i32 0"], struct
    for name in path:
        names = list(STRUCTS[current])
        indices.append(f"i32 {names.index(name)}")
        current = STRUCTS[current][name].removeprefix("%")
    return f"getelementptr inbounds %{struct}, ptr {pointer}, {', '.join(indices)}"


# The names, in the module, of the constant strings with the error messages.
NO_MEMORY, MISMATCH = "nhjax.no_memory", "nhjax.mismatch"
NO_SCRATCH = "nhjax.no_scratch"


def _constant_string(name: str, text: str) -> str:
    size = len(text) + 1
    return f'@{name} = internal constant [{size} x i8] c"{text}\\00"'


_CREATE, _DESTROY = "XLA_FFI_Error_Create_Args", "XLA_FFI_Error_Destroy_Args"

ERRORS = f"""
{_constant_string(NO_MEMORY, "no memory to share a call's blocks")}
{_constant_string(NO_SCRATCH, "no memory for the arrays that a program works with")}
{_constant_string(MISMATCH, "unexpected numbers of arrays")}

; Create an error, which XLA will destroy.
define internal ptr @nhjax.error(ptr %frame, ptr %message, i32 %code) {{
  %args = alloca %{_CREATE}
  store %{_CREATE} zeroinitializer, ptr %args
  store i64 {size_of(_CREATE)}, ptr %args
  %message_at = {field("%args", _CREATE, "message")}
  store ptr %message, ptr %message_at
  %code_at = {field("%args", _CREATE, "errc")}
  store i32 %code, ptr %code_at
  %api_at = {field("%frame", "XLA_FFI_CallFrame", "api")}
  %api = load ptr, ptr %api_at
  %create_at = {field("%api", "XLA_FFI_Api", "XLA_FFI_Error_Create")}
  %create = load ptr, ptr %create_at
  %error = call ptr %create(ptr %args)
  ret ptr %error
}}

; Return whether a call of the interface failed, and destroy its error, which is ours.
define internal i1 @nhjax.failed(ptr %api, ptr %error) {{
  %is_fine = icmp eq ptr %error, null
  br i1 %is_fine, label %fine, label %failed
fine:
  ret i1 false
failed:
  %args = alloca %{_DESTROY}
  store %{_DESTROY} zeroinitializer, ptr %args
  store i64 {size_of(_DESTROY)}, ptr %args
  %error_at = {field("%args", _DESTROY, "error")}
  store ptr %error, ptr %error_at
  %destroy_at = {field("%api", "XLA_FFI_Api", "XLA_FFI_Error_Destroy")}
  %destroy = load ptr, ptr %destroy_at
  call void %destroy(ptr %args)
  ret i1 true
}}
"""
