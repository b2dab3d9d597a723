"""The operation that runs a program for many members, and its rules in JAX.

`jax.vmap` of a compiled program is one operation, `batched_call`, which contains the
program of one member. On the CPU the compiler of `nhjax.lanes` vectorises over the
members (SIMD). If it cannot compile the program, and the options allow single kernels,
XLA compiles the program of one member to one kernel, which runs for one member after
the other. In all other cases, and on other devices, JAX batches the program.
"""

from functools import partial

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching

from ._jaxprs import BATCHED_CALL
from ._kernel import (
    kernel,
    kernel_jvp,
    kernel_transpose,
    merge_lists,
    never_high,
    partition_list,
)


batched_call = jax.extend.core.Primitive(BATCHED_CALL)
batched_call.multiple_results = True
batched_call.is_high = never_high


@batched_call.def_impl
def _run(*operands, program, is_batched, options):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return by_vmap(
            *operands, program=program, is_batched=is_batched, options=options
        )
    given = {"program": program, "is_batched": is_batched, "options": options}
    run = partial(batched_call.bind, **given)
    return jax.jit(run)(*operands)


@batched_call.def_abstract_eval
def _shapes(*operands, program, is_batched, options):
    del options
    members = num_members(operands, is_batched)
    return [
        jax.core.ShapedArray(
            (members, *aval.shape), aval.dtype, weak_type=aval.weak_type
        )
        for aval in program.out_avals
    ]


def num_members(operands, is_batched: tuple[bool, ...]) -> int:
    """Return the number of members of a batched call."""
    return partition_list(is_batched, operands)[0][0].shape[0]


def _axes(is_batched: tuple[bool, ...]) -> list[int | None]:
    return [0 if mark else None for mark in is_batched]


def _vmap_of_kernel(operands, axes, *, program, options):
    is_batched = tuple(axis is not None for axis in axes)
    operands = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes, strict=True)
    ]
    given = {"program": program, "is_batched": is_batched, "options": options}
    out = batched_call.bind(*operands, **given)
    return out, [0] * len(out)


batching.primitive_batchers[kernel] = _vmap_of_kernel


def _vmap_of_batched_call(operands, axes, *, program, is_batched, options):
    """Batch a batched call again, with both axes of members flattened to one."""
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
    given = {"program": program, "is_batched": marks, "options": options}
    out = batched_call.bind(*whole, **given)
    return [x.reshape(size, members, *x.shape[1:]) for x in out], [0] * len(out)


batching.primitive_batchers[batched_call] = _vmap_of_batched_call


def _jvp_of_batched_call(operands, tangents, *, program, is_batched, options):
    """Compute values and tangents member by member, by the rule for a single run."""
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = partition_list(is_moving, tangents)
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.in_avals]
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    axes = _axes(is_batched)

    def member(operands, rates):
        moving = merge_lists(is_moving, rates, partition_list(is_moving, zeros)[1])
        out, changes = kernel_jvp(operands, moving, program=program, options=options)
        return out, partition_list(is_smooth, changes)[0]

    out, changes = jax.vmap(member, in_axes=(axes, partition_list(is_moving, axes)[0]))(
        list(operands), rates
    )
    still = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out]
    return out, merge_lists(is_smooth, changes, partition_list(is_smooth, still)[1])


ad.primitive_jvps[batched_call] = _jvp_of_batched_call


def _transpose_of_batched_call(cotangents, *operands, program, is_batched, options):
    """Transpose member by member, and sum over the members that share an operand."""
    is_linear = [ad.is_undefined_primal(x) for x in operands]
    is_asked = [not isinstance(cotangent, ad.Zero) for cotangent in cotangents]
    asked, known = (
        partition_list(is_asked, cotangents)[0],
        partition_list(is_linear, operands)[1],
    )
    unknown = [ad.UndefinedPrimal(aval) for aval in program.in_avals]
    zeros = [ad.Zero(aval) for aval in program.out_avals]
    linear_marks, known_marks = partition_list(is_linear, is_batched)

    def member(known, asked):
        everything = merge_lists(
            is_linear, partition_list(is_linear, unknown)[0], known
        )
        given = merge_lists(is_asked, asked, partition_list(is_asked, zeros)[1])
        rule = partial(kernel_transpose, program=program, options=options)
        return partition_list(is_linear, rule(given, *everything))[0]

    pulled = jax.vmap(member, in_axes=(_axes(tuple(known_marks)), 0))(known, asked)
    pulled = [
        x if mark else jnp.sum(x, axis=0)
        for x, mark in zip(pulled, linear_marks, strict=True)
    ]
    return merge_lists(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[batched_call] = _transpose_of_batched_call


def by_vmap(*operands, program, is_batched, options):
    """Compute the operation by JAX's own `vmap`."""
    del options
    run = jax.extend.core.jaxpr_as_fun(program)
    return jax.vmap(run, in_axes=_axes(is_batched))(*operands)
