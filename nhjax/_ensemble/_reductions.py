"""Statistics of an ensemble that are computed chunk by chunk.

A reduction has a state of fixed size. `update` adds the members of a chunk to a state,
`merge` combines the states of two sets of members, and `finish` computes the statistic.
Sums are computed in double-double arithmetic, so that the size of the chunks affects at
most the last bit of the result.
"""

import math
import operator
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._numerics import tree_where, two_sum


class AbstractReduction(eqx.Module):
    """A statistic of the members of an ensemble that is computed chunk by chunk.

    To define your own reduction, write a subclass with the four methods below. JAX
    traces all of them except `finish`. A value is the result of `run` for one member,
    with `None` in place of its `nhjax.RESULTS`. A state is any tree of arrays with
    fixed shapes. `merge` must be associative up to round-off, and merging a state with
    the state that `init` returns must not change the state.
    """

    @abstractmethod
    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Create the state of an empty set of members, for values of this structure."""

    @abstractmethod
    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Add the members of a chunk to a state.

        The leading axis of `values` has the c members. `counts` is False for members
        that failed and for the padding of the last chunk; their values may be anything,
        including NaN.
        """

    @abstractmethod
    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Combine the states of two sets of members; `one` comes first."""

    @abstractmethod
    def finish(self, state: PyTree[Array]) -> Any:
        """Compute the statistic from the state of all members."""


class Mean(AbstractReduction):
    """The mean over the members of an ensemble, for every number that `run` returns.

    mean = (1/n) Σ x_j. The sums are double-double numbers (Hida, Li, Bailey, 2001), so
    that for any chunk size only two roundings matter: when the final sum is converted
    to one number, and when this number is divided by n.

    **Arguments:**

    - `of`: a function that selects, from the value of a member, the part to average;
        by default everything.

    **Returns:** `statistics` is a tree with the shapes of the value of one member.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(lambda x: x**2, jnp.arange(4.0),
        ...     reduce=nhjax.Mean())
        >>> float(outcome.statistics)
        3.5
    """

    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> Any:
        """Create the sums of an empty set of members."""
        return _Sums(jnp.zeros((), int), _zeros(_select_structure(self.of, value)))

    def update(
        self, state: Any, values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> Any:
        """Add the members of a chunk."""
        found = _select_each(self.of, values)
        return _fold_vectors(self.merge, _sums_of_one, state, found, counts)

    def merge(self, one: Any, other: Any) -> Any:
        """Combine the sums of two sets of members."""
        return _Sums(one.number + other.number, _map(add, one.sums, other.sums))

    def finish(self, state: Any) -> PyTree[Array]:
        """Divide the sums by the number of members."""
        count = int(np.asarray(state.number))
        return _map(lambda x: rounded(x) / count, state.sums)


class Variance(AbstractReduction):
    """The variance over the members of an ensemble, for every number `run` returns.

    The variance is Σ (x_j - mean)² / (n - ddof), computed by the update of Chan, Golub
    and LeVeque (1983, *Algorithms for computing the sample variance*). For one
    additional member this is Welford's update. Let two sets have n_a and n_b members,
    and the sums of squares S_a and S_b about their means. With δ = mean_b - mean_a and
    n = n_a + n_b,

    mean = mean_a + δ n_b/n,   S = S_a + S_b + δ² n_a n_b/n.

    Means and sums are double-double numbers, so that the result has full precision even
    if the mean is 1e8 times the standard deviation.

    **Arguments:**

    - `of`: a function that selects, from the value of a member, the part to use; by
        default everything.
    - `ddof`: the number subtracted from the number of members, 1 by default.

    **Returns:** `statistics` is a tree with the shapes of the value of one member.

    **Raises:** `ValueError` if there are `ddof` members or fewer.

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
        """Create the moments of an empty set of members."""
        zeros = _zeros(_select_structure(self.of, value))
        return _Moments(jnp.zeros((), int), zeros, zeros)

    def update(
        self, state: Any, values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> Any:
        """Add the members of a chunk."""
        found = _select_each(self.of, values)
        return _fold_vectors(self.merge, _moments_of_one, state, found, counts)

    def merge(self, one: Any, other: Any) -> Any:
        """Combine the moments of two sets of members."""
        count = one.number + other.number

        def mean(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
            dtype = a.high.dtype
            share = other.number.astype(dtype) / jnp.maximum(count, 1).astype(dtype)
            moved = add(a, double_double(_difference(a, b) * share))
            # If `one` is empty, keep the mean of `other` exactly.
            return tree_where(one.number == 0, b, moved)

        def squares(
            a: DoubleDouble, b: DoubleDouble, x: DoubleDouble, y: DoubleDouble
        ) -> DoubleDouble:
            dtype, δ = a.high.dtype, _difference(x, y)
            share = other.number.astype(dtype) / jnp.maximum(count, 1).astype(dtype)
            # In this order, no factor overflows unless the whole product overflows.
            between = (δ * share) * (δ * one.number.astype(dtype))
            return add(add(a, b), double_double(between))

        return _Moments(
            count,
            _map(mean, one.mean, other.mean),
            _map(squares, one.squares, other.squares, one.mean, other.mean),
        )

    def finish(self, state: Any) -> PyTree[Array]:
        """Divide the sums of squares by the number of members minus `ddof`."""
        count = int(np.asarray(state.number))
        if count <= self.ddof:
            raise ValueError(
                f"`Variance(ddof={self.ddof})` needs more than {self.ddof} members "
                f"that have not failed, got {count}."
            )
        return _map(lambda x: rounded(x) / (count - self.ddof), state.squares)


class _AbstractExtreme(AbstractReduction):
    """The smallest or the largest of the values of members, chosen by `best`.

    The comparison starts with `worst`, the worst possible value.
    """

    worst: eqx.AbstractClassVar[float]
    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)

    @abstractmethod
    def best(self, rows: Array) -> Array:
        """Choose the best along the leading axis."""

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Create arrays filled with the worst value of their dtype."""
        return jax.tree.map(
            lambda x: jnp.full(x.shape, self._limit(x.dtype), x.dtype),
            _select_structure(self.of, value),
        )

    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Compare the state with the members of a chunk, and keep the best values."""

        def leaf(x):
            mask = counts.reshape(-1, *[1] * (x.ndim - 1))
            worst = jnp.asarray(self._limit(x.dtype), x.dtype)
            return self.best(jnp.where(mask, x, worst))

        found = jax.tree.map(leaf, _select_each(self.of, values))
        return self.merge(state, found)

    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Combine the extremes of two sets of members, entry by entry."""
        return jax.tree.map(lambda x, y: self.best(jnp.stack([x, y])), one, other)

    def finish(self, state: PyTree[Array]) -> PyTree[Array]:
        """Return the extremes of all members."""
        return state

    def _limit(self, dtype: Any) -> Any:
        if jnp.issubdtype(dtype, jnp.floating):
            return self.worst
        is_large = self.worst > 0
        if jnp.issubdtype(dtype, jnp.bool_):
            return is_large
        if not jnp.issubdtype(dtype, jnp.integer):
            raise _unordered(dtype)
        limits = jnp.iinfo(dtype)
        return limits.max if is_large else limits.min


class Minimum(_AbstractExtreme):
    """The minimum over the members of an ensemble, for every number `run` returns.

    The minimum is NaN if the value of a member that has not failed is NaN.

    **Arguments:**

    - `of`: a function that selects, from the value of a member, the part to compare; by
        default everything.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(jnp.cos, jnp.arange(4.0), reduce=nhjax.Minimum())
        >>> bool(outcome.statistics == jnp.cos(3.0))
        True
    """

    worst: ClassVar[float] = np.inf

    def best(self, rows: Array) -> Array:
        """Compute the minimum along the leading axis."""
        return jnp.min(rows, axis=0)


class Maximum(_AbstractExtreme):
    """The maximum over the members of an ensemble, for every number `run` returns.

    The maximum is NaN if the value of a member that has not failed is NaN.

    **Arguments:**

    - `of`: a function that selects, from the value of a member, the part to compare; by
        default everything.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(jnp.cos, jnp.arange(4.0), reduce=nhjax.Maximum())
        >>> float(outcome.statistics)
        1.0
    """

    worst: ClassVar[float] = -np.inf

    def best(self, rows: Array) -> Array:
        """Compute the maximum along the leading axis."""
        return jnp.max(rows, axis=0)


class Histogram(AbstractReduction):
    """The number of members in each bin, for every number that `run` returns.

    **Arguments:**

    - `edges`: b + 1 increasing numbers. Bin i holds edges[i] <= x < edges[i + 1].
    - `of`: a function that selects, from the value of a member, the part to count; by
        default everything.

    **Returns:** `statistics` is the value of one member with an
    `nhjax.HistogramCounts` in place of each array.

    **Raises:** `ValueError` if the edges do not increase or are not finite.

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
                "`edges` must be a sequence of two or more numbers, got shape "
                f"{numbers.shape}."
            )
        if not np.all(np.isfinite(numbers)) or np.any(np.diff(numbers) <= 0):
            raise ValueError(
                f"`edges` must be finite and increase, got {numbers.tolist()}."
            )
        self.edges = tuple(map(float, numbers))
        self.of = of

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Create the counts of an empty set of members."""

        def leaf(x):
            if jnp.issubdtype(x.dtype, jnp.complexfloating):
                raise _unordered(x.dtype)
            return jnp.zeros((len(self.edges) + 2, *x.shape), int)

        return jax.tree.map(leaf, _select_structure(self.of, value))

    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Count the members of a chunk.

        The state has the number of members, the number that are not NaN, and for each
        edge the number at or above it. Comparing all members with every edge is faster
        than finding the bin of each member and incrementing its count.
        """

        def leaf(x):
            mask = counts.reshape(-1, *[1] * (x.ndim - 1))
            if not jnp.issubdtype(x.dtype, jnp.floating):
                x = x.astype(jnp.result_type(float))

            def at_or_above(edge):
                return jnp.sum(mask & (x >= edge), axis=0, dtype=int)

            total = jnp.sum(jnp.broadcast_to(mask, x.shape), axis=0, dtype=int)
            not_nan = jnp.sum(mask & ~jnp.isnan(x), axis=0, dtype=int)
            edges = jnp.asarray(self.edges, x.dtype)
            reached = jax.lax.map(at_or_above, edges)
            return jnp.concatenate([total[None], not_nan[None], reached])

        found = jax.tree.map(leaf, _select_each(self.of, values))
        return self.merge(state, found)

    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Add the counts of two sets of members."""
        return jax.tree.map(jnp.add, one, other)

    def finish(self, state: PyTree[Array]) -> Any:
        """Compute the count of each bin from the counts at or above its two edges."""

        def leaf(x):
            total, not_nan, reached = x[0], x[1], x[2:]
            return HistogramCounts(
                self.edges,
                counts=np.moveaxis(reached[:-1] - reached[1:], 0, -1),
                below=np.asarray(not_nan - reached[0]),
                above=np.asarray(reached[-1]),
                nan=np.asarray(total - not_nan),
            )

        return jax.tree.map(lambda x: leaf(np.asarray(x)), state)


class HistogramCounts(eqx.Module):
    """The histogram of the members of an ensemble, computed by `nhjax.Histogram`.

    - `edges`: the b + 1 edges.
    - `counts`: the number of members in each bin, of shape (..., b) for an array of
        shape (...).
    - `below`, `above`: the number of members below the first edge, and the number at or
        above the last edge.
    - `nan`: the number of members that are NaN.
    """

    edges: tuple[float, ...] = eqx.field(static=True)
    counts: np.ndarray
    below: np.ndarray
    above: np.ndarray
    nan: np.ndarray

    def quantile(self, fraction: float) -> np.ndarray:
        """Compute a quantile, with an error of at most the width of its bin.

        The members of a bin are assumed to be spread evenly over it.

        **Arguments:**

        - `fraction`: between 0 and 1; 0.5 gives the median.

        **Returns:** an array of shape (...).

        **Raises:** `ValueError` if the quantile lies outside of the edges, or if any
        member is NaN.

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
                f"The quantile is undefined: {int(np.max(self.nan))} members are NaN."
            )
        inside = np.sum(self.counts, axis=-1)
        target = fraction * (self.below + inside + self.above) - self.below
        if np.any((target < 0) | (target > inside) | (inside == 0)):
            raise ValueError(
                f"The quantile {fraction} lies outside of the edges {self.edges[0]:g} "
                f"to {self.edges[-1]:g}: {int(np.max(self.below))} members are below "
                f"them and {int(np.max(self.above))} above. Choose edges further apart."
            )
        flat = self.counts.reshape(-1, self.counts.shape[-1])
        found = [
            _interpolated_quantile(counts, goal, np.asarray(self.edges))
            for counts, goal in zip(flat, target.reshape(-1), strict=True)
        ]
        return np.array(found).reshape(target.shape)


def _interpolated_quantile(
    counts: np.ndarray, target: float, edges: np.ndarray
) -> float:
    cumulative = np.concatenate([[0], np.cumsum(counts)])
    # The first nonempty bin for which the count up to its end reaches the target.
    last = int(np.argmax((cumulative[1:] >= target) & (counts > 0)))
    share = (target - cumulative[last]) / counts[last]
    return float(edges[last] + share * (edges[last + 1] - edges[last]))


def fold(
    merge: Callable[[Any, Any], Any],
    lift: Callable[[Any, Any], Any],
    state: PyTree[Array],
    values: PyTree[Array],
    counts: Bool[Array, " c"],
) -> PyTree[Array]:
    """Add the c members of a chunk to a state, in an order that depends only on c.

    About √c states each collect about √c members. All these states are updated at the
    same time, as vectors, and are merged at the end. This needs only about 2√c
    iterations, and memory for only about √c states.

    **Arguments:**

    - `merge`: merges two states.
    - `lift`: creates the state of one member from its value and from a boolean, which
        is False for a member that does not count.
    - `state`: the state of the members before this chunk.
    - `values`, `counts`: as for `AbstractReduction.update`.
    """
    size = counts.shape[0]
    columns = max(1, math.isqrt(size))
    rows = -(-size // columns)

    def arranged(x):
        widths = [(0, rows * columns - size)] + [(0, 0)] * (x.ndim - 1)
        return jnp.pad(x, widths).reshape(rows, columns, *x.shape[1:])

    def add_row(states, row):
        return jax.vmap(merge)(states, jax.vmap(lift)(*row)), None

    members = jax.tree.map(arranged, (values, counts))
    first, rest = [
        jax.tree.map(lambda x, part=part: x[part], members)
        for part in (0, slice(1, None))
    ]
    states, _ = jax.lax.scan(add_row, jax.vmap(lift)(*first), rest)
    return jax.lax.scan(lambda a, b: (merge(a, b), None), state, states)[0]


def _fold_vectors(
    merge: Callable[[Any, Any], Any],
    lift: Callable[[Any, Any], Any],
    state: Any,
    values: PyTree[Array],
    counts: Bool[Array, " c"],
) -> Any:
    """Add the members of a chunk to a state, with all numbers of a dtype as one vector.

    This saves compile time: XLA compiles an expression for each array, and sums of
    double-double numbers are long expressions.
    """
    values = jax.tree.map(lambda x: x.astype(_sum_dtype(x)), values)
    number, *trees = state
    start = type(state)(number, *map(_double_vectors, trees))
    vectors = _vectors(values, 1)
    number, *found = fold(merge, lift, start, vectors, counts)
    pairs = zip(found, trees, strict=True)
    return type(state)(number, *[_as_doubles(x, tree) for x, tree in pairs])


def _vectors(tree: PyTree[Array], axis: int) -> list[Array]:
    """Join the arrays of each dtype, with the axes from `axis` on as one axis."""
    groups: dict[Any, list[Array]] = {}
    for x in jax.tree.leaves(tree):
        groups.setdefault(x.dtype, []).append(x.reshape(*x.shape[:axis], -1))
    return [jnp.concatenate(group, axis) for group in groups.values()]


def _double_vectors(tree: Any) -> list["DoubleDouble"]:
    parts = [_vectors(_map(operator.itemgetter(i), tree), 0) for i in (0, 1)]
    return [DoubleDouble(*pair) for pair in zip(*parts, strict=True)]


def _as_doubles(vectors: list["DoubleDouble"], tree: Any) -> Any:
    """Undo `_double_vectors`: return a tree like `tree` with numbers of `vectors`."""
    place = {x.high.dtype: (x, 0) for x in vectors}

    def part(like: DoubleDouble) -> DoubleDouble:
        vector, start = place[like.high.dtype]
        end = start + like.high.size
        place[like.high.dtype] = vector, end
        return DoubleDouble(*[x[start:end].reshape(like.high.shape) for x in vector])

    return _map(part, tree)


def _select_each(of: Callable[[Any], Any] | None, values: Any) -> Any:
    return values if of is None else jax.vmap(of)(values)


def _select_structure(of: Callable[[Any], Any] | None, value: Any) -> Any:
    return value if of is None else jax.eval_shape(of, value)


def _unordered(dtype: Any) -> TypeError:
    return TypeError(
        f"Numbers of dtype {dtype} have no order: let `of` return real numbers."
    )


class DoubleDouble(NamedTuple):
    """An unevaluated sum `high + low`, with |low| at most half an ulp of `high`."""

    high: Float[Array, "*n"]
    low: Float[Array, "*n"]


def double_double(x: Float[Array, "*n"]) -> DoubleDouble:
    """Convert a number exactly to a double-double number."""
    return DoubleDouble(x, jnp.zeros_like(x))


def add(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Add two double-double numbers, with a relative error of about 2^-104 in float64.

    Knuth's TwoSum is applied to both parts (Hida, Li, Bailey, 2001, *Algorithms for
    quad-double precision floating point arithmetic*). Infinite numbers add as in IEEE
    arithmetic: their rounding errors, which would be NaN, are replaced by zero.
    """
    high, low = two_sum(a.high, b.high)
    tail, rest = two_sum(a.low, b.low)
    low = jnp.where(jnp.isfinite(low), low, jnp.zeros_like(low))
    high, low = _normalised(high, low + tail)
    return DoubleDouble(*_normalised(high, low + rest))


def _normalised(
    high: Float[Array, "*n"], low: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    total = high + low
    error = low - (total - high)
    return total, jnp.where(jnp.isfinite(error), error, jnp.zeros_like(error))


def rounded(a: DoubleDouble) -> Float[Array, "*n"]:
    """Round a double-double number to one number."""
    return a.high + a.low


def _difference(a: DoubleDouble, b: DoubleDouble) -> Array:
    return rounded(add(b, DoubleDouble(-a.high, -a.low)))


class _Sums(NamedTuple):
    """The number of members, and the sums of their values: a tree of `DoubleDouble`."""

    number: Int[Array, ""]
    sums: Any


class _Moments(NamedTuple):
    """The number of members, their mean, and sums of squares about the mean.

    `mean` and `squares` are trees of `DoubleDouble`.
    """

    number: Int[Array, ""]
    mean: Any
    squares: Any


def _sums_of_one(value: Any, counts: Bool[Array, ""]) -> _Sums:
    return _Sums(counts.astype(int), _lifted(value, counts))


def _moments_of_one(value: Any, counts: Bool[Array, ""]) -> _Moments:
    mean = _lifted(value, counts)
    return _Moments(counts.astype(int), mean, jax.tree.map(jnp.zeros_like, mean))


def _map(function: Callable[..., Any], *trees: Any) -> Any:
    """Map over the `DoubleDouble` nodes of trees."""
    return jax.tree.map(function, *trees, is_leaf=lambda x: isinstance(x, DoubleDouble))


def _zeros(value: Any) -> Any:
    return jax.tree.map(
        lambda x: double_double(jnp.zeros(x.shape, _sum_dtype(x))), value
    )


def _lifted(value: Any, counts: Bool[Array, ""]) -> Any:
    """Convert values to double-double numbers, or to zeros if `counts` is False."""
    return jax.tree.map(
        lambda x: double_double(jnp.where(counts, x, jnp.asarray(0, x.dtype))), value
    )


def _sum_dtype(x: Any) -> Any:
    """Return the dtype of the mean of `x`: the dtype of `x`, or JAX's default float.

    The default is used for integers.
    """
    if jnp.issubdtype(x.dtype, jnp.floating):
        return x.dtype
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise TypeError(
            "Statistics need real numbers, but `run` returns an array of dtype "
            f"{x.dtype}: return its real and imaginary parts instead."
        )
    return jnp.result_type(float)
