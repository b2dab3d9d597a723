from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int, PyTree

from .._numerics import tree_where
from ._pairs import Pair, pair, plus, value as rounded
from ._reduction import (
    AbstractReduction,
    as_floating,
    fold,
    selected,
    selected_structure,
    where_counted,
)


class _Sums(NamedTuple):
    """How many members there are, and a tree of `Pair`s, the sums of their values."""

    number: Int[Array, ""]
    sums: Any


class _Moments(NamedTuple):
    """How many members there are, their mean, and sums of squares about the mean.

    The latter two are trees of `Pair`s.
    """

    number: Int[Array, ""]
    mean: Any
    squares: Any


def _is_pair(x: Any) -> bool:
    return isinstance(x, Pair)


def _pairs(function: Callable[..., Any], *trees: Any) -> Any:
    return jax.tree.map(function, *trees, is_leaf=_is_pair)


def _zeros(value: Any) -> Any:
    return jax.tree.map(lambda x: pair(jnp.zeros(x.shape, as_floating(x))), value)


def _lifted(value: Any, counts: Bool[Array, ""]) -> Any:
    return jax.tree.map(
        lambda x: pair(where_counted(counts, x.astype(as_floating(x)), 0)), value
    )


class Mean(AbstractReduction):
    """The mean over the members of an ensemble, of every number that `run` returns.

    Sums carry their rounding errors along (see Hida, Li, Bailey, 2001), so that the
    result is rounded once, whatever the chunks: mean = (1/n) Σ x_j.

    **Arguments:**

    - `of`: a function that takes from the value of a member what the mean is of; all
        by default.

    **Returns:** in the outcome, a tree of the same shapes as that of one member.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(lambda x: x**2, jnp.arange(4.0),
        ...     reduce=nhjax.Mean())
        >>> float(outcome.statistics)
        3.5
    """

    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> Any:
        """Make the sums of an empty set of members."""
        return _Sums(jnp.zeros((), int), _zeros(selected_structure(self.of, value)))

    def update(
        self, state: Any, values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> Any:
        """Add the members of a chunk."""
        return self.merge(state, fold(self.merge, self._lift, values, counts))

    def _lift(self, value: Any, counts: Bool[Array, ""]) -> _Sums:
        return _Sums(counts.astype(int), _lifted(selected(self.of, value), counts))

    def merge(self, one: Any, other: Any) -> Any:
        """Combine the sums of two sets of members."""
        return _Sums(one.number + other.number, _pairs(plus, one.sums, other.sums))

    def finish(self, state: Any) -> PyTree[Array]:
        """Divide by the number of members."""
        count = int(np.asarray(state.number))
        return _pairs(lambda x: rounded(x) / count, state.sums)


class Variance(AbstractReduction):
    """The variance over the members of an ensemble, of every number `run` returns.

    Σ (x_j - mean)² / (n - ddof), by the rule of Chan, Golub and LeVeque (1983,
    *Algorithms for computing the sample variance*), of which Welford's is the case of
    one more member: with δ the difference of the means of two sets of n_a and n_b,

    mean = mean_a + δ n_b/n,   S = S_a + S_b + δ² n_a n_b/n.

    Means and sums carry their rounding errors along, so that the result has full
    precision even if the mean is 1e8 times the deviation.

    **Arguments:**

    - `of`: a function that takes from the value of a member what the variance is of;
        all by default.
    - `ddof`: what is subtracted from the number of members, 1 by default.

    **Returns:** in the outcome, a tree of the same shapes as that of one member.

    **Raises:** `ValueError` if there are not more than `ddof` members.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(lambda x: x + 1e8, jnp.arange(4.0),
        ...     reduce=nhjax.Variance(ddof=0))
        >>> float(outcome.statistics)
        1.25
    """

    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)
    ddof: int = eqx.field(static=True, default=1)

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> Any:
        """Make moments of no members."""
        zeros = _zeros(selected_structure(self.of, value))
        return _Moments(jnp.zeros((), int), zeros, zeros)

    def update(
        self, state: Any, values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> Any:
        """Add the members of a chunk."""
        return self.merge(state, fold(self.merge, self._lift, values, counts))

    def _lift(self, value: Any, counts: Bool[Array, ""]) -> _Moments:
        mean = _lifted(selected(self.of, value), counts)
        zeros = jax.tree.map(jnp.zeros_like, mean)
        return _Moments(counts.astype(int), mean, zeros)

    def merge(self, one: Any, other: Any) -> Any:
        """Combine the moments of two sets of members."""
        count = one.number + other.number

        def mean(a: Pair, b: Pair) -> Pair:
            dtype = a.high.dtype
            share = other.number.astype(dtype) / jnp.maximum(count, 1).astype(dtype)
            moved = plus(a, pair(_difference(a, b) * share))
            # The mean of the only members there are, to its last bit.
            return tree_where(one.number == 0, b, moved)

        def squares(a: Pair, b: Pair, x: Pair, y: Pair) -> Pair:
            dtype, δ = a.high.dtype, _difference(x, y)
            share = other.number.astype(dtype) / jnp.maximum(count, 1).astype(dtype)
            # Neither factor overflows before their product does.
            between = (δ * share) * (δ * one.number.astype(dtype))
            return plus(plus(a, b), pair(between))

        return _Moments(
            count,
            _pairs(mean, one.mean, other.mean),
            _pairs(squares, one.squares, other.squares, one.mean, other.mean),
        )

    def finish(self, state: Any) -> PyTree[Array]:
        """Divide by the number of members less `ddof`."""
        count = int(np.asarray(state.number))
        if count <= self.ddof:
            raise ValueError(
                f"`Variance(ddof={self.ddof})` needs more than {self.ddof} members "
                f"that have not failed, got {count}."
            )
        return _pairs(lambda x: rounded(x) / (count - self.ddof), state.squares)


def _difference(a: Pair, b: Pair) -> Array:
    return rounded(plus(b, Pair(-a.high, -a.low)))
