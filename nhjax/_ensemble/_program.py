"""The program that runs a chunk of members, compiled once for all chunks."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree

from .._compile import tracked_jit
from .._errors import naming
from .._system import no_array
from ._reduction import AbstractReduction
from ._verdict import is_good, verdict, without_results


AXIS = "members"


class Layout(NamedTuple):
    """The devices on which chunks run, and the order in which statistics are formed.

    `is_fixed` is true if this order must not depend on the number of devices.
    """

    devices: tuple[Any, ...]
    is_fixed: bool


class Chunk(NamedTuple):
    """What came of a chunk: codes of `RESULTS`, steps of failures, and values."""

    codes: Int[Array, " c"]
    steps: Int[Array, " c"]
    content: PyTree[Array]


def is_reduction(x: Any) -> bool:
    """Tell whether `x` is a reduction, which is itself a tree."""
    return isinstance(x, AbstractReduction)


def each_reduction(function: Callable[..., Any], reductions: Any, *trees: Any) -> Any:
    """Map a function over a tree of reductions and the like parts of other trees."""
    return jax.tree.map(function, reductions, *trees, is_leaf=is_reduction)


def _members_of(run: Any, make: Any, inputs: Any, layout: Layout) -> Any:
    def member(one):
        value = run(make(one))
        return value, *verdict(value)

    every = jax.vmap(member)
    if len(layout.devices) > 1:
        # Members have nothing to do with each other; JAX's check of what varies
        # between devices does not know the operations of an ensemble.
        every = _on_each(layout, every, jax.P(AXIS), jax.P(AXIS))
    return every(inputs)


def spread(layout: Layout, axes: Any) -> jax.sharding.Sharding:
    """Make the sharding of arrays along the given axes of the devices."""
    if len(layout.devices) == 1:
        return jax.sharding.SingleDeviceSharding(layout.devices[0])
    return jax.sharding.NamedSharding(_mesh(layout), axes)


def _mesh(layout: Layout) -> jax.sharding.Mesh:
    return jax.sharding.Mesh(np.array(layout.devices), (AXIS,))


def _on_each(layout: Layout, function: Any, inside: Any, outside: Any) -> Any:
    mesh = _mesh(layout)
    return jax.shard_map(
        function, mesh=mesh, in_specs=inside, out_specs=outside, check_vma=False
    )


@tracked_jit("run", "make")
def values_of_chunk(run: Any, make: Any, inputs: Any, layout: Layout) -> Chunk:
    """Run the members of a chunk."""
    value, codes, steps = _members_of(run, make, inputs, layout)
    return Chunk(codes, steps, value)


@tracked_jit("run", "make", "reductions")
def reduced_chunk(
    run: Any,
    make: Any,
    reductions: Any,
    inputs: Any,
    is_there: Bool[Array, " c"],
    layout: Layout,
) -> Chunk:
    """Run the members of a chunk, and make of them the states of reductions."""
    value, codes, steps = _members_of(run, make, inputs, layout)
    values = without_results(value)
    counts = is_there & is_good(codes)
    structure = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), values
    )

    def of_all(values, counts):
        return each_reduction(
            lambda each: each.update(each.init(structure), values, counts), reductions
        )

    if len(layout.devices) == 1:
        return Chunk(codes, steps, of_all(values, counts))
    if layout.is_fixed:
        # Every device has all members, so that the order is that of one device.
        everywhere = _on_each(layout, of_all, jax.P(), jax.P())
        return Chunk(codes, steps, everywhere(values, counts))

    def of_some(values, counts):
        return jax.tree.map(lambda x: x[None], of_all(values, counts))

    stacked = _on_each(layout, of_some, jax.P(AXIS), jax.P(AXIS))(values, counts)
    state, *others = [
        jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(len(layout.devices))
    ]
    for other in others:
        state = each_reduction(_merged, reductions, state, other)
    return Chunk(codes, steps, state)


@tracked_jit("reductions")
def merged_states(reductions: Any, one: Any, other: Any) -> Any:
    """Merge the states of reductions of two sets of members.

    It is a program of its own, so that it rounds in the same way wherever the states
    come from.
    """
    return each_reduction(_merged, reductions, one, other)


def _merged(each: AbstractReduction, one: Any, other: Any) -> Any:
    return each.merge(one, other)


def value_structure(run: Any, make: Any, inputs: Any) -> Any:
    """Find what `run` returns for one member: shapes and dtypes.

    **Raises:** `TypeError` if there is anything but arrays of numbers.
    """
    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), inputs)

    def value(one):
        member = make(one)
        with naming("run(member)", run):
            return run(member)

    structure = eqx.filter_eval_shape(value, one)
    leaves = jax.tree_util.tree_leaves_with_path(structure)
    if not leaves:
        raise TypeError(
            f"`run` must return arrays for each member, got {no_array(structure)}"
        )
    for path, leaf in leaves:
        name = f"`run(member){jax.tree_util.keystr(path)}`"
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            raise TypeError(
                f"{name} is {leaf!r}, but `run` must return arrays, in tuples, "
                "dictionaries and other trees, for each member."
            )
        if jnp.issubdtype(leaf.dtype, jax.dtypes.extended):
            raise TypeError(
                f"{name} has dtype {leaf.dtype}: of a random key return "
                "`jax.random.key_data`."
            )
    return structure
