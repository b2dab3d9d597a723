"""Functions of nhjax that are compiled as one program, with a cache of their traces.

`as_cpu_kernel` traces a function to a program, and calls this program as one operation,
which `nhjax.lanes` compiles as a whole.
"""

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax

from ..lanes import captures_tracers, CompileOptions, cse_dce, run_program


T = TypeVar("T")


class TraceCache:
    """A cache of the traced programs of functions.

    A key contains the function, the types of its array arguments, and its other
    arguments, but not the globals and closed-over variables that the function reads.
    These may change between two calls of `integrate`. A cache is therefore used only
    while one run is traced and differentiated.
    """

    def __init__(self):
        self._known: dict[Hashable, _Traced] = {}

    def find(self, key: Hashable) -> "_Traced | None":
        """Return the program stored under `key`, or `None` if there is none."""
        return self._known.get(key)

    def keep(self, key: Hashable, traced: "_Traced") -> None:
        """Store a program, unless it contains a tracer of another trace."""
        if not captures_tracers(traced.program):
            self._known[key] = traced


class _Traced(NamedTuple):
    """A jaxpr, the tree structure of its array results, and the other results."""

    program: Any
    structure: Any
    rest: Any


def as_cpu_kernel(
    function: Callable[..., T],
    *args: Any,
    programs: TraceCache | None = None,
    is_brief: bool = False,
) -> T:
    """Compute `function(*args)` in one kernel of the CPU where possible.

    The call can be transformed like the function itself. The programs of its
    derivatives, both forward and transposed, become kernels too. Under `jax.vmap` the
    call becomes one operation for all members, vectorised (SIMD) where possible.

    **Arguments:**

    - `function`, `args`: the function, and its arguments: trees of arrays and other
        objects.
    - `programs`: a cache of traced programs. With a cache, the function is traced once
        for each structure, shape and dtype of the arrays in `args`, and for each value
        of the other objects in `args`. The function must then not depend on values
        outside `args`.
    - `is_brief`: whether the program runs once and for a short time. Such a program is
        compiled in less time, to slower code.
    """
    # With `jax.disable_jit`, the user wants to step through single operations.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return function(*args)
    dynamic, static = eqx.partition(args, eqx.is_array)
    leaves, treedef = jax.tree.flatten(dynamic)
    others, structure = jax.tree.flatten(static)
    key = function, treedef, structure, *others, *map(jax.typeof, leaves)
    traced = None if programs is None else programs.find(key)
    if traced is None:
        program, shapes, rest = eqx.filter_make_jaxpr(function)(*args)
        traced = _Traced(cse_dce(program), jax.tree.structure(shapes), rest)
        if programs is not None:
            programs.keep(key, traced)
    out = run_program(traced.program, leaves, CompileOptions(is_brief))
    return eqx.combine(jax.tree.unflatten(traced.structure, out), traced.rest)
