"""The operation that stands for a program of many members, and its rules.

`jax.vmap` of a compiled program is one operation, `batched_call`, with the program of
one member. On the CPU the members are vectorised (SIMD) by nhjax's own compiler; if
that is not possible, they run one after the other in kernels. On other devices, and if
neither is possible, JAX batches the program.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir

from ..lanes import compile_batched, Unsupported
from ._garbage_collection import rare_collections
from ._jaxprs import BATCHED_CALL, cse_dce, num_results
from ._kernel import (
    kernel,
    kernel_jvp,
    kernel_transpose,
    merge_lists,
    never_high,
    partition_list,
    split_by_operands,
)
from ._lowering import (
    as_parts_of_a_program,
    is_exported,
    is_part_of_a_program,
    is_within_kernel,
    reason_against_kernel,
    reason_against_lanes,
    record_engine,
    require_not_chosen,
)


T = TypeVar("T")

batched_call = jax.extend.core.Primitive(BATCHED_CALL)
batched_call.multiple_results = True
batched_call.is_high = never_high

# Functions that compute fewer numbers for all rows together are written out for each
# row, because a loop would save little time of the compiler.
SHORTEST_IN_LOOP = 2000


def vmapped(function: Callable[..., T], *rows: Any, out_axis: int = 0) -> T:
    """Compute `jax.vmap(function)(*rows)`, with a long function as one operation.

    Within a program that nhjax's own compiler compiles, the operation is a loop over
    the rows. Then the time of compilation does not grow with the number of rows. What
    does not depend on the rows is computed before, once.

    **Arguments:**

    - `function`: a function of trees of arrays, with arrays as results.
    - `rows`: trees of arrays that have the same first axis.
    - `out_axis`: the axis of the results that lists the rows.
    """
    leaves, treedef = jax.tree.flatten(rows)
    structure = None

    def flat(*leaves):
        nonlocal structure
        out = function(*jax.tree.unflatten(treedef, leaves))
        leaves, structure = jax.tree.flatten(out)
        return leaves

    # With `jax.disable_jit`, the user wants to step through single operations.
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return jax.vmap(function, out_axes=out_axis)(*rows)
    row = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in leaves]
    program = cse_dce(jax.make_jaxpr(flat)(*row))
    if program.effects:
        return jax.vmap(function, out_axes=out_axis)(*rows)
    shared, program = split_by_operands(program)
    number = leaves[0].shape[0]
    if number == 1 or number * num_results(program.jaxpr) < SHORTEST_IN_LOOP:
        in_axes = [*[None] * len(shared), *[0] * len(leaves)]
        run = jax.extend.core.jaxpr_as_fun(program)
        out = jax.vmap(run, in_axes, out_axis)(*shared, *leaves)
        return jax.tree.unflatten(structure, out)
    marks = (False,) * len(shared) + (True,) * len(leaves)
    given = {"program": program, "is_batched": marks, "is_brief": False}
    out = batched_call.bind(*shared, *leaves, **given)
    return jax.tree.unflatten(structure, [jnp.moveaxis(x, 0, out_axis) for x in out])


@batched_call.def_impl
def _run(*operands, program, is_batched, is_brief):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return _vmapped(
            *operands, program=program, is_batched=is_batched, is_brief=is_brief
        )
    given = {"program": program, "is_batched": is_batched, "is_brief": is_brief}
    run = partial(batched_call.bind, **given)
    return jax.jit(run)(*operands)


@batched_call.def_abstract_eval
def _shapes(*operands, program, is_batched, is_brief):
    del is_brief
    members = _members(operands, is_batched)
    return [
        jax.core.ShapedArray((members, *aval.shape), aval.dtype)
        for aval in program.out_avals
    ]


def _members(operands, is_batched: tuple[bool, ...]) -> int:
    return partition_list(is_batched, operands)[0][0].shape[0]


def _axes(is_batched: tuple[bool, ...]) -> list[int | None]:
    return [0 if mark else None for mark in is_batched]


def _vmap_of_kernel(operands, axes, *, program, is_brief):
    is_batched = tuple(axis is not None for axis in axes)
    operands = [
        x if axis is None else jnp.moveaxis(x, axis, 0)
        for x, axis in zip(operands, axes, strict=True)
    ]
    given = {"program": program, "is_batched": is_batched, "is_brief": is_brief}
    out = batched_call.bind(*operands, **given)
    return out, [0] * len(out)


batching.primitive_batchers[kernel] = _vmap_of_kernel


def _vmap_of_batched_call(operands, axes, *, program, is_batched, is_brief):
    """Flatten two axes of members to one."""
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
    out = batched_call.bind(*whole, **given)
    return [x.reshape(size, members, *x.shape[1:]) for x in out], [0] * len(out)


batching.primitive_batchers[batched_call] = _vmap_of_batched_call


def _jvp_of_batched_call(operands, tangents, *, program, is_batched, is_brief):
    """Compute values and tangents member by member, by the rule for one program."""
    del is_brief
    is_moving = [not isinstance(tangent, ad.Zero) for tangent in tangents]
    rates, _ = partition_list(is_moving, tangents)
    zeros = [ad.Zero(aval.to_tangent_aval()) for aval in program.in_avals]
    is_smooth = [jnp.issubdtype(x.dtype, jnp.inexact) for x in program.out_avals]
    axes = _axes(is_batched)

    def member(operands, rates):
        moving = merge_lists(is_moving, rates, partition_list(is_moving, zeros)[1])
        out, changes = kernel_jvp(operands, moving, program=program)
        return out, partition_list(is_smooth, changes)[0]

    out, changes = jax.vmap(member, in_axes=(axes, partition_list(is_moving, axes)[0]))(
        list(operands), rates
    )
    still = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in out]
    return out, merge_lists(is_smooth, changes, partition_list(is_smooth, still)[1])


ad.primitive_jvps[batched_call] = _jvp_of_batched_call


def _transpose_of_batched_call(cotangents, *operands, program, is_batched, is_brief):
    """Transpose member by member, and sum over the members that share an operand."""
    del is_brief
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
        return partition_list(
            is_linear, kernel_transpose(given, *everything, program=program)
        )[0]

    pulled = jax.vmap(member, in_axes=(_axes(tuple(known_marks)), 0))(known, asked)
    pulled = [
        x if mark else jnp.sum(x, axis=0)
        for x, mark in zip(pulled, linear_marks, strict=True)
    ]
    return merge_lists(is_linear, pulled, [None] * len(known))


ad.primitive_transposes[batched_call] = _transpose_of_batched_call


def _vmapped(*operands, program, is_batched, is_brief):
    del is_brief
    run = jax.extend.core.jaxpr_as_fun(program)
    return jax.vmap(run, in_axes=_axes(is_batched))(*operands)


def _mapped(*operands, program, is_batched, is_brief):
    batched, shared = partition_list(is_batched, operands)

    def member(batched):
        given = {"program": program, "is_brief": is_brief}
        return kernel.bind(*merge_lists(is_batched, batched, shared), **given)

    return jax.lax.map(member, batched)


@rare_collections()
def _lowered(ctx, *operands, program, is_batched, is_brief):
    members = _members(ctx.avals_in, is_batched)
    given = {"program": program, "is_batched": is_batched, "is_brief": is_brief}
    if is_part_of_a_program():
        return _by_xla(ctx, *operands, **given)
    if is_exported(ctx):
        record_engine("xla", "the program is exported", members)
        return _by_xla(ctx, *operands, **given)
    reason = reason_against_lanes()
    if reason is None:
        try:
            name = compile_batched(program, is_batched, is_brief)
        except Unsupported as error:
            reason = str(error)
        else:
            record_engine("lanes", "the first choice", members)
            return jax.ffi.ffi_lowering(name)(ctx, *operands)
    against = reason_against_kernel(program)
    if not is_within_kernel():
        require_not_chosen("lanes", reason)
        if against is not None:
            require_not_chosen("kernels", against)
    if against is not None or is_within_kernel():
        record_engine("xla", against or reason, members)
        lower = _by_xla
    else:
        record_engine("kernels", reason, members)
        lower = mlir.lower_fun(_mapped, multiple_results=True)
    return lower(ctx, *operands, **given)


_by_xla = as_parts_of_a_program(mlir.lower_fun(_vmapped, multiple_results=True))
mlir.register_lowering(batched_call, _by_xla, cacheable=False)
mlir.register_lowering(batched_call, _lowered, platform="cpu", cacheable=False)
