from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from ._reduction import AbstractReduction, selected_of_each, selected_structure


class _AbstractExtreme(AbstractReduction):
    """The best of the numbers of members; any is at least as good as `worst`."""

    worst: eqx.AbstractClassVar[float]
    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)

    @abstractmethod
    def best(self, rows: Array) -> Array:
        """Choose the best along the leading axis."""

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Make the worst numbers there are."""
        return jax.tree.map(
            lambda x: jnp.full(x.shape, self._limit(x.dtype), x.dtype),
            selected_structure(self.of, value),
        )

    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Compare with the members of a chunk."""

        def leaf(x):
            marks = counts.reshape(-1, *[1] * (x.ndim - 1))
            worst = jnp.asarray(self._limit(x.dtype), x.dtype)
            return self.best(jnp.where(marks, x, worst))

        found = jax.tree.map(leaf, selected_of_each(self.of, values))
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
            raise TypeError(
                f"There is no order of numbers of dtype {dtype}: let `of` take real "
                "ones."
            )
        limits = jnp.iinfo(dtype)
        return limits.max if is_large else limits.min


class Minimum(_AbstractExtreme):
    """The least value over the members of an ensemble, of every number `run` returns.

    NaN of a member that has not failed is handed on.

    **Arguments:**

    - `of`: a function that takes from the value of a member what is looked at; all by
        default.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(jnp.cos, jnp.arange(4.0), reduce=nhjax.Minimum())
        >>> bool(outcome.statistics == jnp.cos(3.0))
        True
    """

    worst: ClassVar[float] = np.inf

    def best(self, rows: Array) -> Array:
        """Compute the smallest of the values along the first axis."""
        return jnp.min(rows, axis=0)


class Maximum(_AbstractExtreme):
    """The largest value over the members of an ensemble, of every number of a value.

    NaN of a member that has not failed is handed on.

    **Arguments:**

    - `of`: a function that takes from the value of a member what is looked at; all by
        default.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(jnp.cos, jnp.arange(4.0), reduce=nhjax.Maximum())
        >>> float(outcome.statistics)
        1.0
    """

    worst: ClassVar[float] = -np.inf

    def best(self, rows: Array) -> Array:
        """Compute the largest of the values along the first axis."""
        return jnp.max(rows, axis=0)
