"""Programs that are compiled as a whole: the operation that stands for one.

A member of an ensemble is integrated by one such program. How it is compiled depends on
the device and on what the program holds: `_lowering` and `_ensemble` decide.
"""

from collections.abc import Callable, Hashable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.extend

from ._shortened import shortened


T = TypeVar("T")


class Programs:
    """The programs of functions that have been traced already, by what they are given.

    What functions of a user read may change from one call of `integrate` to the next,
    so that programs are kept while one run is traced and differentiated, not longer.
    """

    def __init__(self):
        self._known: dict[Hashable, _Traced] = {}

    def find(self, key: Hashable) -> "_Traced | None":
        """Return the program that was kept for this key, if there is one."""
        return self._known.get(key)

    def keep(self, key: Hashable, traced: "_Traced") -> None:
        """Keep a program, unless it contains what belongs to another trace."""
        if not _captures(traced.program):
            self._known[key] = traced


class _Traced(NamedTuple):
    """The program of a function: its arrays, their structure, and its other results."""

    program: Any
    structure: Any
    rest: Any


def as_cpu_kernel(
    function: Callable[..., T],
    *args: Any,
    programs: Programs | None = None,
    is_brief: bool = False,
) -> T:
    """Compute `function(*args)`, in one kernel of the CPU if that is possible.

    The call can be transformed like the function itself. The programs of its
    derivatives, forward and transposed, go into kernels too. A batch of calls is an
    ensemble, whose members run in the lanes of vectors where that is possible. With
    `programs` the function is traced once for each kind of arguments, and must depend
    on nothing but these. What `is_brief` runs once and shortly: it is compiled in less
    time to slower code.
    """
    # Who asks for no compilation wants to look at one operation after the other.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return function(*args)
    dynamic, static = eqx.partition(args, eqx.is_array)
    leaves, treedef = jax.tree.flatten(dynamic)
    if programs is None:
        traced = _traced(function, static, treedef, leaves)
    else:
        others, structure = jax.tree.flatten(static)
        key = function, treedef, structure, *others, *map(jax.typeof, leaves)
        traced = programs.find(key)
        if traced is None:
            traced = _traced(function, static, treedef, leaves)
            programs.keep(key, traced)
    out = run_program(traced.program, leaves, is_brief)
    return eqx.combine(jax.tree.unflatten(traced.structure, out), traced.rest)


def _traced(
    function: Callable[..., Any], static: Any, treedef: Any, leaves: list[Any]
) -> _Traced:
    kept = []

    def flat(*leaves):
        args = eqx.combine(jax.tree.unflatten(treedef, leaves), static)
        arrays, rest = eqx.partition(function(*args), eqx.is_array)
        kept.append((jax.tree.structure(arrays), rest))
        return jax.tree.leaves(arrays)

    program = shortened(jax.make_jaxpr(flat)(*leaves))
    return _Traced(program, *kept[0])


def call(flat: Callable[..., list[Any]], leaves: list[Any]) -> list[Any]:
    """Compute `flat(*leaves)` in a kernel, or without one if it has effects."""
    return run_program(jax.make_jaxpr(flat)(*leaves), leaves)


def run_program(program: Any, leaves: list[Any], is_brief: bool = False) -> list[Any]:
    """Compute a program in a kernel, or without one if it has effects."""
    program = shortened(program)
    # A primitive needs all traced values as operands, and may not print, for instance.
    if program.effects or _captures(program):
        return jax.extend.core.jaxpr_as_fun(program)(*leaves)
    return kernel.bind(*leaves, program=program, is_brief=is_brief)


def _captures(program: Any) -> bool:
    return any(isinstance(const, jax.core.Tracer) for const in program.consts)


def never_high(*_: Any, **__: Any) -> bool:
    """Tell JAX not to write out operations in a program before it is lowered.

    Since JAX 0.12 it would ask a primitive for a rule to do so (`to_lojax`) if its
    program has such operations. Here they are written out while a program is lowered.
    """
    return False


kernel = jax.extend.core.Primitive("cpu_kernel")
kernel.multiple_results = True
kernel.is_high = never_high


@kernel.def_impl
def _run(*operands, program, is_brief):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        # A kernel that was traced before. `jax.jit` would call this very rule again.
        return jax.extend.core.jaxpr_as_fun(program)(*operands)
    run = partial(kernel.bind, program=program, is_brief=is_brief)
    return jax.jit(run)(*operands)


@kernel.def_abstract_eval
def _shapes(*operands, program, is_brief):
    del operands, is_brief
    return program.out_avals
