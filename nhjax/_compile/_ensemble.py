"""Ensembles: a program that runs for many members, and its transformations.

`jax.vmap` of a program that is compiled as a whole is one operation with the same
program. On the CPU its members run in the lanes of vectors, or else one after the other
in kernels; elsewhere, and if neither can be, the program is batched by JAX.
"""

from functools import partial

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir

from ..lanes import compile_batched, Unsupported
from ._garbage_collection import rare_collections
from ._kernel import differentiated, kernel, merged, never_high, split, transposed
from ._lowering import (
    is_exported,
    is_within_kernel,
    note,
    reason_against_kernel,
    reason_against_lanes,
)


ensemble = jax.extend.core.Primitive("ensemble")
ensemble.multiple_results = True
ensemble.is_high = never_high


@ensemble.def_impl
def _run(*operands, program, is_batched, is_brief):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return _together(
            *operands, program=program, is_batched=is_batched, is_brief=is_brief
        )
    given = {"program": program, "is_batched": is_batched, "is_brief": is_brief}
    run = partial(ensemble.bind, **given)
    return jax.jit(run)(*operands)


@ensemble.def_abstract_eval
def _shapes(*operands, program, is_batched, is_brief):
    del is_brief
    members = _members(operands, is_batched)
    return [
        jax.core.ShapedArray((members, *aval.shape), aval.dtype)
        for aval in program.out_avals
    ]


def _members(operands, is_batched: tuple[bool, ...]) -> int:
    return split(is_batched, operands)[0][0].shape[0]


def _axes(is_batched: tuple[bool, ...]) -> list[int | None]:
    return [0 if mark else None for mark in is_batched]


def _batched_kernel(operands, axes, *, program, is_brief):
    is_batched = tuple(axis is not None for axis in axes)
    operands = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes, strict=True)
    ]
    given = {"program": program, "is_batched": is_batched, "is_brief": is_brief}
    out = ensemble.bind(*operands, **given)
    return out, [0] * len(out)


batching.primitive_batchers[kernel] = _batched_kernel


def _batched_ensemble(operands, axes, *, program, is_batched, is_brief):
    """Flatten an ensemble under `jax.vmap` to one ensemble with one axis of members."""
    pairs = list(zip(operands, axes, strict=True))
    size = next(x.shape[axis] for x, axis in pairs if axis is not None)
    member_shapes = [aval.shape for aval in program.in_avals]
    at = is_batched.index(True)
    shape = list(operands[at].shape)
    if axes[at] is not None:
        del shape[axes[at]]
    members = shape[0]

    def flat(x, axis, mark, shape):
        if axis is None and not mark:
            return x
        x = x[None] if axis is None else jnp.moveaxis(x, axis, 0)
        x = x if mark else x[:, None]
        x = jnp.broadcast_to(x, (size, members, *shape))
        return x.reshape(size * members, *shape)

    whole = [
        flat(x, axis, mark, shape)
        for (x, axis), mark, shape in zip(pairs, is_batched, member_shapes, strict=True)
    ]
    marks = tuple(
        mark or axis is not None for mark, axis in zip(is_batched, axes, strict=True)
    )
    given = {"program": program, "is_batched": marks, "is_brief": is_brief}
    out = ensemble.bind(*whole, **given)
    return [x.reshape(size, members, *x.shape[1:]) for x in out], [0] * len(out)


batching.primitive_batchers[ensemble] = _batched_ensemble


def _differentiated_ensemble(operands, tangents, *, program, is_batched, is_brief):
    """Compute values and tangents member by member, as for a single program."""
    del is_brief
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = split(is_moving, tangents)
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.in_avals]
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    axes = _axes(is_batched)

    def member(operands, rates):
        moving = merged(is_moving, rates, split(is_moving, zeros)[1])
        out, changes = differentiated(operands, moving, program=program)
        return out, split(is_smooth, changes)[0]

    out, changes = jax.vmap(member, in_axes=(axes, split(is_moving, axes)[0]))(
        list(operands), rates
    )
    still = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out]
    return out, merged(is_smooth, changes, split(is_smooth, still)[1])


ad.primitive_jvps[ensemble] = _differentiated_ensemble


def _transposed_ensemble(cotangents, *operands, program, is_batched, is_brief):
    """Transpose member by member, and sum where members share an operand."""
    del is_brief
    is_linear = [ad.is_undefined_primal(x) for x in operands]
    is_asked = [not isinstance(cotangent, ad.Zero) for cotangent in cotangents]
    asked, known = split(is_asked, cotangents)[0], split(is_linear, operands)[1]
    unknown = [ad.UndefinedPrimal(aval) for aval in program.in_avals]
    zeros = [ad.Zero(aval) for aval in program.out_avals]
    linear_marks, known_marks = split(is_linear, is_batched)

    def member(known, asked):
        everything = merged(is_linear, split(is_linear, unknown)[0], known)
        given = merged(is_asked, asked, split(is_asked, zeros)[1])
        return split(is_linear, transposed(given, *everything, program=program))[0]

    pulled = jax.vmap(member, in_axes=(_axes(tuple(known_marks)), 0))(known, asked)
    pulled = [
        x if mark else jnp.sum(x, axis=0)
        for x, mark in zip(pulled, linear_marks, strict=True)
    ]
    return merged(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[ensemble] = _transposed_ensemble


def _together(*operands, program, is_batched, is_brief):
    del is_brief
    run = jax.extend.core.jaxpr_as_fun(program)
    return jax.vmap(run, in_axes=_axes(is_batched))(*operands)


def _one_by_one(*operands, program, is_batched, is_brief):
    batched, shared = split(is_batched, operands)

    def member(batched):
        given = {"program": program, "is_brief": is_brief}
        return kernel.bind(*merged(is_batched, batched, shared), **given)

    return jax.lax.map(member, batched)


@rare_collections()
def _lowered(ctx, *operands, program, is_batched, is_brief):
    members = _members(ctx.avals_in, is_batched)
    given = {"program": program, "is_batched": is_batched, "is_brief": is_brief}
    if is_exported(ctx):
        note("xla", "the program is exported", members)
        return _together_by_xla(ctx, *operands, **given)
    reason = reason_against_lanes()
    if reason is None:
        try:
            name = compile_batched(program, is_batched, is_brief)
        except Unsupported as error:
            reason = str(error)
        else:
            note("lanes", "the first choice", members)
            return jax.ffi.ffi_lowering(name)(ctx, *operands)
    against = reason_against_kernel(program)
    if against is not None or is_within_kernel():
        note("xla", against or reason, members)
        lower = _together_by_xla
    else:
        note("kernels", reason, members)
        lower = mlir.lower_fun(_one_by_one, multiple_results=True)
    return lower(ctx, *operands, **given)


_together_by_xla = mlir.lower_fun(_together, multiple_results=True)
mlir.register_lowering(ensemble, _together_by_xla, cacheable=False)
mlir.register_lowering(ensemble, _lowered, platform="cpu", cacheable=False)
