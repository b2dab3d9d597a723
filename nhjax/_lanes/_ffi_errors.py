"""Errors of XLA's foreign function interface, made and destroyed, as LLVM IR."""

from ._ffi_structs import field, size_of


# The names of the messages, as constants of the module.
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

; Make an error, for XLA to destroy.
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

; Whether a call of the interface failed; its error, which is ours then, is destroyed.
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
