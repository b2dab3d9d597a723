"""The variables that the code of a function reads, and the modules of libraries."""

import dis
import sys
import sysconfig
import types
from functools import lru_cache
from typing import NamedTuple, TypeAlias


# The attributes that are read of a variable, as in `module.part.constant`.
Path: TypeAlias = tuple[str, ...]

_LOADS_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
_LOADS_CLOSED = ("LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF")
_LOADS_ATTRIBUTE = ("LOAD_ATTR", "LOAD_METHOD")
# These libraries may be installed from a working copy, outside of the usual folders.
_LIBRARIES = ("equinox", "jax", "jaxlib", "jaxtyping", "nhjax", "numpy")


class Names(NamedTuple):
    """The variables that code reads, each with the attribute paths that start there.

    Variables that the code itself assigns are left out: a function must not be traced
    anew because of what it did itself.
    """

    of_globals: dict[str, set[Path]]
    closed_over: dict[str, set[Path]]


@lru_cache(maxsize=4096)
def names(code: types.CodeType) -> Names:
    """Find the variables that a function and the functions defined inside it read."""
    found, assigned = Names({}, {}), Names({}, {})
    path: list[str] | None = None
    for instruction in dis.get_instructions(code):
        operation, name = instruction.opname, instruction.argval
        if operation in _LOADS_ATTRIBUTE and path is not None:
            path.append(name)
            continue
        _close(found, path)
        path = None
        if operation in _LOADS_GLOBAL:
            path = ["of_globals", name]
        elif operation in _LOADS_CLOSED:
            path = ["closed_over", name]
        elif operation == "STORE_GLOBAL":
            assigned.of_globals[name] = set()
        elif operation == "STORE_DEREF":
            assigned.closed_over[name] = set()
    _close(found, path)
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            for variables, others in zip(found, names(inner), strict=True):
                for name, paths in others.items():
                    variables.setdefault(name, set()).update(paths)
    return Names(*map(_without, found, assigned))


def _close(found: Names, path: list[str] | None) -> None:
    if path is not None:
        kind, name, *attributes = path
        getattr(found, kind).setdefault(name, set()).add(tuple(attributes))


def _without(
    variables: dict[str, set[Path]], others: dict[str, set[Path]]
) -> dict[str, set[Path]]:
    return {name: paths for name, paths in variables.items() if name not in others}


@lru_cache(maxsize=4096)
def is_installed(module: str) -> bool:
    """Tell whether a module is Python's own or an installed library's, not a user's."""
    if module == "__main__":
        return False
    if module.partition(".")[0] in (*_LIBRARIES, *sys.builtin_module_names):
        return True
    file = getattr(sys.modules.get(module), "__file__", None)
    folders = {
        sysconfig.get_path(name)
        for name in ("stdlib", "platstdlib", "purelib", "platlib")
    }
    return file is not None and file.startswith(tuple(folders))
