import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree


class AbstractReduction(eqx.Module):
    """A statistic of the members of an ensemble that is collected chunk by chunk.

    A reduction of one's own is a subclass with the four methods below, which are traced
    by JAX, but for `finish`. What `run` returns for one member is called a value; its
    `nhjax.RESULTS` are `None` here. A state is any tree of arrays of fixed shapes.
    `merge` must be associative up to round-off, and the state of `init` neutral in it.
    """

    @abstractmethod
    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Make the state of no members, for values of this structure."""

    @abstractmethod
    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Add the members of a chunk to a state.

        `values` have the c members as leading axis. Those that do not count, since they
        have failed or fill up the last chunk, may hold anything, even NaN.
        """

    @abstractmethod
    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Combine the states of two sets of members; those of `one` come first."""

    @abstractmethod
    def finish(self, state: PyTree[Array]) -> Any:
        """Compute the statistic from the state of all members."""


def selected(of: Callable[[Any], Any] | None, value: Any) -> Any:
    """Take the part of a value that a reduction is of; all of it by default."""
    return value if of is None else of(value)


def selected_of_each(of: Callable[[Any], Any] | None, values: Any) -> Any:
    """Take, from the value of each member, the part that a reduction is of."""
    return values if of is None else jax.vmap(of)(values)


def selected_structure(of: Callable[[Any], Any] | None, value: Any) -> Any:
    """Find the shapes and dtypes of the part of a value that a reduction is of."""
    return value if of is None else jax.eval_shape(of, value)


def fold(
    merge: Callable[[Any, Any], Any],
    lift: Callable[[Any, Any], Any],
    values: PyTree[Array],
    counts: Bool[Array, " c"],
) -> PyTree[Array]:
    """Merge the states of the members of a chunk, in an order that c alone decides.

    About √c states take up members side by side and are then merged: there are few
    iterations, vectors are long, and memory does not grow with c.

    **Arguments:**

    - `lift`: makes the state of one member from its value and whether it counts.
    """
    size = counts.shape[0]
    columns = max(1, math.isqrt(size))
    rows = -(-size // columns)

    def arranged(x):
        widths = [(0, rows * columns - size)] + [(0, 0)] * (x.ndim - 1)
        return jnp.pad(x, widths).reshape(rows, columns, *x.shape[1:])

    values, counts = jax.tree.map(arranged, (values, counts))
    first, rest = [
        jax.tree.map(lambda x, part=part: x[part], (values, counts))
        for part in (0, slice(1, None))
    ]

    def add_row(states, row):
        return jax.vmap(merge)(states, jax.vmap(lift)(*row)), None

    states, _ = jax.lax.scan(add_row, jax.vmap(lift)(*first), rest)
    start, others = [
        jax.tree.map(lambda x, part=part: x[part], states)
        for part in (0, slice(1, None))
    ]
    state, _ = jax.lax.scan(lambda a, b: (merge(a, b), None), start, others)
    return state


def where_counted(counts: Bool[Array, ""], x: Array, otherwise: Any) -> Array:
    """Take `x` of a member that counts; else a number that changes nothing."""
    return jnp.where(counts, x, jnp.asarray(otherwise, x.dtype))


def as_floating(x: Any) -> Any:
    """Return the dtype in which means of `x` are computed: its own if it is floating.

    Means of integers and booleans are computed in JAX's default precision.
    """
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x.dtype
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise TypeError(
            "Statistics are of real numbers, but `run` returns an array of dtype "
            f"{x.dtype}: return its real and imaginary parts instead."
        )
    return jnp.result_type(float)
