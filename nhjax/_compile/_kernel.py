"""Compilation of a program into one kernel of the CPU, if its operations allow it.

XLA runs a program on the CPU as a sequence of kernels, and each costs some 50 ns to
start, which is as long as the arithmetic of tens of numbers takes. An iteration on the
stages of a step is some fifty such kernels. A called computation that is marked as
small is compiled to a single kernel instead, its loops included; on the gallery's
systems that is three to five times faster.

The mark is internal to the compiler, and its meaning may change. Without the mark, as
on other devices, the results are the same; `NHJAX_ONE_KERNEL=0` in the environment
leaves it out.
"""

import os
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jaxlib.mlir import ir

from ._elementary import is_elementary, LARGEST_REDUCTION


T = TypeVar("T")


def as_cpu_kernel(function: Callable[..., T], *args: Any) -> T:
    """Compute `function(*args)`, in one kernel of the CPU if that is possible.

    The call can be transformed like the function itself. The programs of its
    derivatives, forward and transposed, go into kernels too. Members of a batch run one
    after the other, each for as long as it needs, which is faster than to run all of
    them together, kernel by kernel.
    """
    # Who asks for no compilation wants to look at one operation after the other.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return function(*args)
    dynamic, static = eqx.partition(args, eqx.is_array)
    leaves, treedef = jax.tree.flatten(dynamic)
    kept = []

    def flat(*leaves):
        args = eqx.combine(jax.tree.unflatten(treedef, leaves), static)
        arrays, rest = eqx.partition(function(*args), eqx.is_array)
        kept.append((jax.tree.structure(arrays), rest))
        return jax.tree.leaves(arrays)

    out = _call(flat, leaves)
    structure, rest = kept[0]
    return eqx.combine(jax.tree.unflatten(structure, out), rest)


def _call(flat: Callable[..., list[Any]], leaves: list[Any]) -> list[Any]:
    program = jax.make_jaxpr(flat)(*leaves)
    # A primitive needs all traced values as operands, and may not print, for instance.
    captured = any(isinstance(const, jax.core.Tracer) for const in program.consts)
    if program.effects or captured:
        return jax.extend.core.jaxpr_as_fun(program)(*leaves)
    return _kernel.bind(*leaves, program=program)


def _split(marks: Iterable[bool], xs: Iterable[Any]) -> tuple[list[Any], list[Any]]:
    """Split a sequence into the entries whose mark is true, and the other entries."""
    pairs = list(zip(marks, xs, strict=True))
    return [x for mark, x in pairs if mark], [x for mark, x in pairs if not mark]


def _merged(
    marks: Iterable[bool], marked: Iterable[Any], others: Iterable[Any]
) -> list[Any]:
    """Merge two sequences that `_split` made, in the original order."""
    marked, others = iter(marked), iter(others)
    return [next(marked) if mark else next(others) for mark in marks]


_kernel = jax.extend.core.Primitive("one_kernel")
_kernel.multiple_results = True


@_kernel.def_impl
def _run(*operands, program):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        # A kernel that was traced before. `jax.jit` would call this very rule again.
        return jax.extend.core.jaxpr_as_fun(program)(*operands)
    return jax.jit(lambda *x: _kernel.bind(*x, program=program))(*operands)


@_kernel.def_abstract_eval
def _shapes(*operands, program):
    del operands
    return program.out_avals


def _is_possible(program) -> bool:
    # The dtype of random keys has no attribute `kind`, which gives None here.
    kinds = {getattr(aval.dtype, "kind", None) for aval in program.in_avals}
    plain = kinds <= set("fiub")
    wanted = os.environ.get("NHJAX_ONE_KERNEL") != "0"
    return wanted and plain and is_elementary(program.jaxpr)


# Whether a kernel is being lowered; kernels inside of it do not become kernels of their
# own.
_within = ContextVar("within", default=False)


def _marked(ctx, *operands, program):
    if _within.get() or not _is_possible(program):
        return mlir.lower_fun(_unmarked, multiple_results=True)(
            ctx, *operands, program=program
        )
    run = jax.extend.core.jaxpr_as_fun(program)

    def call(*operands):
        # The compiler would remove operands without elements: they are left out here.
        is_full = [x.size > 0 for x in operands]
        full, empty = _split(is_full, operands)

        def kernel(*full):
            return run(*_merged(is_full, _tied(full), map(jnp.zeros_like, empty)))

        # The barrier hides which operands are constants: those would be removed too.
        return jax.jit(kernel)(*jax.lax.optimization_barrier(full))

    token = _within.set(True)
    try:
        results = mlir.lower_fun(call, multiple_results=True)(ctx, *operands)
    finally:
        _within.reset(token)
    attributes = {"xla_cpu_small_call": "true", "inlineable": "false"}
    results[0].owner.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(
        {key: ir.StringAttr.get(value) for key, value in attributes.items()}
    )
    return results


def _tied(operands: tuple[Any, ...]) -> list[Any]:
    """Return the same operands, made so that the compiler cannot find one unused.

    The compiler aborts if a parameter of a marked call is not used, even if this turns
    out only after all simplifications. For this reason every small operand is made to
    depend on all others in a way that never changes its value.
    """
    firsts = [x.reshape(-1)[0] for x in operands]
    signs = [(x != jnp.zeros_like(x)).astype(jnp.int32) for x in firsts]
    never = jnp.sum(jnp.stack(signs)) < 0
    return [
        jnp.where(never, jnp.zeros_like(x), x) if x.size <= LARGEST_REDUCTION else x
        for x in operands
    ]


def _unmarked(*operands, program):
    return jax.extend.core.jaxpr_as_fun(program)(*operands)


mlir.register_lowering(
    _kernel, mlir.lower_fun(_unmarked, multiple_results=True), cacheable=False
)
mlir.register_lowering(_kernel, _marked, platform="cpu", cacheable=False)


def _batched(operands, axes, *, program):
    """Run the members of a batch one by one in a kernel on the CPU, else together."""
    run = partial(_kernel.bind, program=program)
    if jax.default_backend() != "cpu" or not _is_possible(program):
        run = jax.extend.core.jaxpr_as_fun(program)
        out = jax.vmap(run, in_axes=axes)(*operands)
        return out, [0] * len(out)
    is_batched = [axis is not None for axis in axes]
    batched, shared = _split(is_batched, operands)
    batched = [
        jnp.moveaxis(x, axis, 0)
        for x, axis in zip(batched, _split(is_batched, axes)[0], strict=True)
    ]

    def member(batched):
        return run(*_merged(is_batched, batched, shared))

    out = jax.lax.map(member, batched)
    return out, [0] * len(out)


batching.primitive_batchers[_kernel] = _batched


def _differentiated(operands, tangents, *, program):
    """Compute values and tangents in two kernels, the second linear in the tangents.

    There are two kernels so that reverse mode can keep the results of the first and
    transpose the second.
    """
    run = jax.extend.core.jaxpr_as_fun(program)
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = _split(is_moving, tangents)
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    treedef = None

    def linearised(*operands):
        nonlocal treedef
        moving, fixed = _split(is_moving, operands)

        def values(*moving):
            return _split(is_smooth, run(*_merged(is_moving, moving, fixed)))

        smooth, push, rest = jax.linearize(values, *moving, has_aux=True)
        residuals, treedef = jax.tree.flatten(push)
        return [*_merged(is_smooth, smooth, rest), *residuals]

    try:
        whole = jax.make_jaxpr(linearised)(*operands)
    except ValueError:
        # What JAX cannot linearise, such as a while loop, has forward mode at least.
        all_rates = [ad.instantiate_zeros(tangent) for tangent in tangents]
        return jax.jvp(run, operands, all_rates)
    size = len(program.out_avals)
    # Residuals that depend on no operand are computed again and not kept: in a loop
    # they would be kept once for each round.
    fixed, is_varying = _fixed_part(whole)
    is_kept = [True] * size + is_varying[size:]
    results = _call(
        lambda *operands: _split(
            is_kept, jax.extend.core.jaxpr_as_fun(whole)(*operands)
        )[0],
        list(operands),
    )
    out, residuals = results[:size], results[size:]

    def push(*given):
        residuals, rates = given[: -sum(is_moving)], given[-sum(is_moving) :]
        everything = _merged(
            is_kept[size:], residuals, _constants(whole, fixed, is_kept)
        )
        return list(jax.tree.unflatten(treedef, everything)(*rates))

    changes = _call(push, [*residuals, *rates])
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.out_avals]
    return out, _merged(is_smooth, changes, _split(is_smooth, zeros)[1])


def _fixed_part(program) -> tuple[list[Any], list[bool]]:
    """Find the operations that depend on no operand, and the results that do on one."""
    traced = [isinstance(const, jax.core.Tracer) for const in program.consts]
    varying = {*program.jaxpr.invars, *_split(traced, program.jaxpr.constvars)[0]}

    def varies(x) -> bool:
        return not isinstance(x, jax.extend.core.Literal) and x in varying

    fixed = []
    for equation in program.eqns:
        if equation.effects or any(map(varies, equation.invars)):
            varying.update(equation.outvars)
        else:
            fixed.append(equation)
    return fixed, list(map(varies, program.jaxpr.outvars))


def _constants(program, fixed: list[Any], is_kept: list[bool]) -> list[Any]:
    """Compute the results of a program that are not kept, from its fixed operations."""
    jaxpr = program.jaxpr
    part = jaxpr.replace(
        invars=[],
        eqns=fixed,
        outvars=_split(is_kept, jaxpr.outvars)[1],
        debug_info=jaxpr.debug_info.with_unknown_names(),
    )
    return jax.core.eval_jaxpr(part, program.consts)


ad.primitive_jvps[_kernel] = _differentiated


def _transposed(cotangents, *operands, program):
    run = jax.extend.core.jaxpr_as_fun(program)
    is_linear = [ad.is_undefined_primal(x) for x in operands]
    linear, known = _split(is_linear, operands)
    is_asked = [not isinstance(cotangent, ad.Zero) for cotangent in cotangents]
    asked, _ = _split(is_asked, cotangents)

    def pull(*given):
        known, asked = given[: -sum(is_asked)], given[-sum(is_asked) :]

        def push(*rates):
            return _split(is_asked, run(*_merged(is_linear, rates, known)))[0]

        transpose = jax.linear_transpose(push, *(x.aval for x in linear))
        return list(transpose(list(asked)))

    pulled = _call(pull, [*known, *asked])
    return _merged(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[_kernel] = _transposed
