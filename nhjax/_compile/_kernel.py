"""The operation that stands for a program compiled as a whole, and its derivatives.

`as_cpu_kernel` traces a function to a program and binds it as one operation,
`cpu_kernel`. Its forward derivative is a pair of such operations, one for the values
and one that is linear in the tangents; reverse mode transposes the second. `_lowering`
and `_batched_call` decide how a program is compiled: this depends on the device and on
the operations of the program.
"""

from collections.abc import Callable, Hashable, Iterable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad

from ._garbage_collection import rare_collections
from ._jaxprs import cse_dce


T = TypeVar("T")


class TraceCache:
    """The traced programs of functions, by their arguments.

    A function of the user may read values that change between two calls of `integrate`.
    Programs are therefore kept only while one run is traced and differentiated.
    """

    def __init__(self):
        self._known: dict[Hashable, _Traced] = {}

    def find(self, key: Hashable) -> "_Traced | None":
        """Return the program of this key, or `None`."""
        return self._known.get(key)

    def keep(self, key: Hashable, traced: "_Traced") -> None:
        """Keep a program, unless it contains a tracer of another trace."""
        if not _captures(traced.program):
            self._known[key] = traced


class _Traced(NamedTuple):
    """A traced function: its jaxpr, the structure of its arrays, and other results."""

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
    - `programs`: a cache of traced programs. With it, the function is traced once for
        each kind of arguments, and must not depend on other values.
    - `is_brief`: whether the program runs once and for a short time. Then it is
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
        kept = []

        def flat(*leaves):
            args = eqx.combine(jax.tree.unflatten(treedef, leaves), static)
            arrays, rest = eqx.partition(function(*args), eqx.is_array)
            kept.append((jax.tree.structure(arrays), rest))
            return jax.tree.leaves(arrays)

        traced = _Traced(cse_dce(jax.make_jaxpr(flat)(*leaves)), *kept[0])
        if programs is not None:
            programs.keep(key, traced)
    out = run_program(traced.program, leaves, is_brief)
    return eqx.combine(jax.tree.unflatten(traced.structure, out), traced.rest)


def call(flat: Callable[..., list[Any]], leaves: list[Any]) -> list[Any]:
    """Trace `flat`, and compute it in a kernel, or without one if it has effects."""
    return run_program(jax.make_jaxpr(flat)(*leaves), leaves)


def run_program(program: Any, leaves: list[Any], is_brief: bool = False) -> list[Any]:
    """Compute a program in a kernel, or without a kernel if it has effects."""
    program = cse_dce(program)
    # All traced values must be operands of a primitive, and it must have no effects,
    # such as printing.
    if program.effects or _captures(program):
        return jax.extend.core.jaxpr_as_fun(program)(*leaves)
    return kernel.bind(*leaves, program=program, is_brief=is_brief)


def _captures(program: Any) -> bool:
    return any(isinstance(const, jax.core.Tracer) for const in program.consts)


def never_high(*_: Any, **__: Any) -> bool:
    """Tell JAX not to expand operations inside a program before it is lowered.

    Since JAX 0.12 a primitive whose program contains such operations would need a rule
    to expand them (`to_lojax`). Here they are expanded when a program is lowered.
    """
    return False


kernel = jax.extend.core.Primitive("cpu_kernel")
kernel.multiple_results = True
kernel.is_high = never_high


@kernel.def_impl
def _run(*operands, program, is_brief):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        # A kernel that was traced before. `jax.jit` would call this same rule again.
        return jax.extend.core.jaxpr_as_fun(program)(*operands)
    run = partial(kernel.bind, program=program, is_brief=is_brief)
    return jax.jit(run)(*operands)


@kernel.def_abstract_eval
def _shapes(*operands, program, is_brief):
    del operands, is_brief
    return program.out_avals


@rare_collections()
def kernel_jvp(operands, tangents, *, program, is_brief=False):
    """Compute values and tangents in two kernels, the second linear in the tangents.

    There are two kernels so that reverse mode can store the results of the first and
    transpose the second.
    """
    del is_brief
    run = jax.extend.core.jaxpr_as_fun(program)
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = partition_list(is_moving, tangents)
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    treedef = None

    def linearised(*operands):
        nonlocal treedef
        moving, fixed = partition_list(is_moving, operands)

        def values(*moving):
            return partition_list(
                is_smooth, run(*merge_lists(is_moving, moving, fixed))
            )

        smooth, push, rest = jax.linearize(values, *moving, has_aux=True)
        residuals, treedef = jax.tree.flatten(push)
        return [*merge_lists(is_smooth, smooth, rest), *residuals]

    try:
        whole = jax.make_jaxpr(linearised)(*operands)
    except ValueError:
        # JAX cannot linearise a while loop, for instance. Such programs have forward
        # mode only.
        all_rates = [ad.instantiate_zeros(tangent) for tangent in tangents]
        return jax.jvp(run, operands, all_rates)
    size = len(program.out_avals)
    # Residuals that depend on no operand are recomputed and not stored: in a loop they
    # would be stored in each iteration.
    fixed, is_varying = _fixed_part(whole)
    is_kept = [True] * size + is_varying[size:]
    kept, fixed_results = partition_list(is_kept, whole.jaxpr.outvars)
    results = run_program(_part(whole, outvars=kept), list(operands))
    out, residuals = results[:size], results[size:]

    def push(*given):
        residuals, rates = given[: -sum(is_moving)], given[-sum(is_moving) :]
        constants = jax.extend.core.jaxpr_as_fun(
            _part(whole, invars=[], eqns=fixed, outvars=fixed_results)
        )()
        everything = merge_lists(is_kept[size:], residuals, constants)
        return list(jax.tree.unflatten(treedef, everything)(*rates))

    changes = call(push, [*residuals, *rates])
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.out_avals]
    return out, merge_lists(is_smooth, changes, partition_list(is_smooth, zeros)[1])


def _fixed_part(program) -> tuple[list[Any], list[bool]]:
    """Find the operations that depend on no operand, and mark such results."""
    traced = [isinstance(const, jax.core.Tracer) for const in program.consts]
    varying = {
        *program.jaxpr.invars,
        *partition_list(traced, program.jaxpr.constvars)[0],
    }

    def varies(x) -> bool:
        return not isinstance(x, jax.extend.core.Literal) and x in varying

    fixed = []
    for equation in program.eqns:
        if equation.effects or any(map(varies, equation.invars)):
            varying.update(equation.outvars)
        else:
            fixed.append(equation)
    return fixed, list(map(varies, program.jaxpr.outvars))


def split_by_operands(program) -> tuple[list[Any], Any]:
    """Compute what depends on no operand, and return a program for the rest.

    Returns the values that the rest uses, and the rest. These values are its first
    operands.
    """
    jaxpr = program.jaxpr
    varying, fixed, others = set(jaxpr.invars), [], []
    for equation in jaxpr.eqns:
        if varying.isdisjoint(_variables(equation.invars)):
            fixed.append(equation)
        else:
            varying.update(equation.outvars)
            others.append(equation)
    used = [v for equation in others for v in _variables(equation.invars)]
    used += _variables(jaxpr.outvars)
    names = list(dict.fromkeys(v for v in used if v not in varying))
    values = jax.extend.core.jaxpr_as_fun(
        _part(program, invars=[], eqns=fixed, outvars=names)
    )()
    rest = jaxpr.replace(
        constvars=[],
        invars=[*names, *jaxpr.invars],
        eqns=others,
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return values, jax.extend.core.ClosedJaxpr(rest, [])


def _variables(operands: Iterable[Any]) -> list[Any]:
    return [v for v in operands if not isinstance(v, jax.extend.core.Literal)]


def _part(program, **fields: list[Any]):
    """Return a program with a part of the operations, operands or results replaced."""
    jaxpr = program.jaxpr
    names = jaxpr.debug_info.with_unknown_names()
    return program.replace(jaxpr=jaxpr.replace(debug_info=names, **fields))


ad.primitive_jvps[kernel] = kernel_jvp


@rare_collections()
def kernel_transpose(cotangents, *operands, program, is_brief=False):
    del is_brief
    run = jax.extend.core.jaxpr_as_fun(program)
    is_linear = [ad.is_undefined_primal(x) for x in operands]
    linear, known = partition_list(is_linear, operands)
    is_asked = [not isinstance(cotangent, ad.Zero) for cotangent in cotangents]
    asked, _ = partition_list(is_asked, cotangents)

    def pull(*given):
        known, asked = given[: -sum(is_asked)], given[-sum(is_asked) :]

        def push(*rates):
            return partition_list(is_asked, run(*merge_lists(is_linear, rates, known)))[
                0
            ]

        transpose = jax.linear_transpose(push, *(x.aval for x in linear))
        return list(transpose(list(asked)))

    pulled = call(pull, [*known, *asked])
    return merge_lists(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[kernel] = kernel_transpose


def partition_list(
    marks: Iterable[bool], xs: Iterable[Any]
) -> tuple[list[Any], list[Any]]:
    """Split a list into the entries whose mark is true, and the other entries."""
    pairs = list(zip(marks, xs, strict=True))
    return [x for mark, x in pairs if mark], [x for mark, x in pairs if not mark]


def merge_lists(
    marks: Iterable[bool], marked: Iterable[Any], others: Iterable[Any]
) -> list[Any]:
    """Merge the two lists that `partition_list` returns, in the original order."""
    marked, others = iter(marked), iter(others)
    return [next(marked) if mark else next(others) for mark in marks]
