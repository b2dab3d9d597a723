from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from ._reduction import AbstractReduction, selected_of_each, selected_structure


class Histogram(AbstractReduction):
    """How many members lie between given edges, for every number that `run` returns.

    **Arguments:**

    - `edges`: b + 1 increasing numbers. Bin i holds edges[i] <= x < edges[i + 1].
    - `of`: a function that takes from the value of a member what is counted; all by
        default.

    **Returns:** in the outcome, an `nhjax.HistogramCounts` in place of each array.

    **Raises:** `ValueError` for edges that do not increase or are not finite.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(lambda x: x, jnp.arange(10.0),
        ...     reduce=nhjax.Histogram([0, 5, 20]))
        >>> outcome.statistics.counts.tolist()
        [5, 5]
    """

    edges: tuple[float, ...] = eqx.field(static=True)
    of: Callable[[Any], Any] | None = eqx.field(static=True)

    def __init__(
        self,
        edges: Sequence[float] | np.ndarray,
        of: Callable[[Any], Any] | None = None,
    ):
        numbers = np.asarray(edges, float)
        if numbers.ndim != 1 or numbers.size < 2:
            raise ValueError(
                f"`edges` must be two numbers or more, got shape {numbers.shape}."
            )
        if not np.all(np.isfinite(numbers)) or np.any(np.diff(numbers) <= 0):
            raise ValueError("`edges` must be finite and increase.")
        self.edges = tuple(map(float, numbers))
        self.of = of

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Make counts of no members."""

        def leaf(x):
            if jnp.issubdtype(x.dtype, jnp.complexfloating):
                raise TypeError(
                    f"There is no order of numbers of dtype {x.dtype}: let `of` take "
                    "real ones."
                )
            return jnp.zeros((len(self.edges) + 2, *x.shape), int)

        return jax.tree.map(leaf, selected_structure(self.of, value))

    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Count the members of a chunk.

        The state has the numbers of members, of those that are numbers, and of those
        that are not below each edge: comparing is faster than adding at places.
        """

        def leaf(x):
            marks = counts.reshape(-1, *[1] * (x.ndim - 1))
            if not jnp.issubdtype(x.dtype, jnp.floating):
                x = x.astype(jnp.result_type(float))

            def above(edge):
                return jnp.sum(marks & (x >= edge), axis=0, dtype=int)

            there = jnp.sum(jnp.broadcast_to(marks, x.shape), axis=0, dtype=int)
            known = jnp.sum(marks & ~jnp.isnan(x), axis=0, dtype=int)
            edges = jnp.asarray(self.edges, x.dtype)
            reached = jax.lax.map(above, edges)
            return jnp.concatenate([there[None], known[None], reached])

        found = jax.tree.map(leaf, selected_of_each(self.of, values))
        return self.merge(state, found)

    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Add the counts of two sets of members."""
        return jax.tree.map(jnp.add, one, other)

    def finish(self, state: PyTree[Array]) -> Any:
        """Take differences, which are the counts of the bins."""

        def leaf(x):
            there, known, above = x[0], x[1], x[2:]
            return HistogramCounts(
                self.edges,
                counts=np.moveaxis(above[:-1] - above[1:], 0, -1),
                below=np.asarray(known - above[0]),
                above=np.asarray(above[-1]),
                nan=np.asarray(there - known),
            )

        return jax.tree.map(lambda x: leaf(np.asarray(x)), state)


class HistogramCounts(eqx.Module):
    """The histogram of members of an ensemble, made by `nhjax.Histogram`.

    - `edges`: the b + 1 edges.
    - `counts`: how many members are in each bin, of shape (..., b) for an array of
        shape (...).
    - `below`, `above`: how many are less than the first edge, and how many at least
        the last one.
    - `nan`: how many are no numbers.
    """

    edges: tuple[float, ...] = eqx.field(static=True)
    counts: np.ndarray
    below: np.ndarray
    above: np.ndarray
    nan: np.ndarray

    def quantile(self, fraction: float) -> np.ndarray:
        """Compute a quantile, to within the width of the bin in which it lies.

        Members are taken to be spread evenly over their bin.

        **Arguments:**

        - `fraction`: between 0 and 1; 0.5 is the median.

        **Returns:** an array of shape (...).

        **Raises:** `ValueError` if the quantile lies outside of the edges, or members
        are no numbers.

        !!! example

            >>> import jax.numpy as jnp, nhjax
            >>> outcome = nhjax.ensemble(lambda x: x, jnp.arange(100.0),
            ...     reduce=nhjax.Histogram(range(0, 101, 10)))
            >>> float(outcome.statistics.quantile(0.25))
            25.0
        """
        if not 0 <= fraction <= 1:
            raise ValueError(f"`fraction` must be between 0 and 1, got {fraction}.")
        if np.any(self.nan):
            raise ValueError(
                f"There is no quantile: {int(np.max(self.nan))} members are no numbers."
            )
        inside = np.sum(self.counts, axis=-1)
        target = fraction * (self.below + inside + self.above) - self.below
        if np.any((target < 0) | (target > inside) | (inside == 0)):
            raise ValueError(
                f"The quantile {fraction} lies outside of the edges {self.edges[0]:g} "
                f"to {self.edges[-1]:g}: {int(np.max(self.below))} members are below "
                f"them and {int(np.max(self.above))} above. Take edges further apart."
            )
        flat = self.counts.reshape(-1, self.counts.shape[-1])
        found = [
            _within(counts, goal, np.asarray(self.edges))
            for counts, goal in zip(flat, target.reshape(-1), strict=True)
        ]
        return np.array(found).reshape(target.shape)


def _within(counts: np.ndarray, target: float, edges: np.ndarray) -> float:
    reached = np.concatenate([[0], np.cumsum(counts)])
    # The first bin at whose end there are enough members, and which is not empty.
    last = int(np.argmax((reached[1:] >= target) & (counts > 0)))
    share = (target - reached[last]) / counts[last]
    return float(edges[last] + share * (edges[last + 1] - edges[last]))
