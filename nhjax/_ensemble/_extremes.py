from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, PyTree

from ._reduction import AbstractReduction, selected_of_each, selected_structure


class Minimum(AbstractReduction):
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

    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Make the largest numbers there are."""
        return _full(selected_structure(self.of, value), largest=True)

    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Compare with the members of a chunk."""
        values = _counted(selected_of_each(self.of, values), counts, largest=True)
        return self.merge(state, jax.tree.map(lambda x: jnp.min(x, axis=0), values))

    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Take the lesser."""
        return jax.tree.map(jnp.minimum, one, other)

    def finish(self, state: PyTree[Array]) -> PyTree[Array]:
        """Return the least values."""
        return state


class Maximum(AbstractReduction):
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

    of: Callable[[Any], Any] | None = eqx.field(static=True, default=None)

    def init(self, value: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
        """Make the least numbers there are."""
        return _full(selected_structure(self.of, value), largest=False)

    def update(
        self, state: PyTree[Array], values: PyTree[Array], counts: Bool[Array, " c"]
    ) -> PyTree[Array]:
        """Compare with the members of a chunk."""
        values = _counted(selected_of_each(self.of, values), counts, largest=False)
        return self.merge(state, jax.tree.map(lambda x: jnp.max(x, axis=0), values))

    def merge(self, one: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
        """Take the larger."""
        return jax.tree.map(jnp.maximum, one, other)

    def finish(self, state: PyTree[Array]) -> PyTree[Array]:
        """Return the largest values."""
        return state


def _limit(dtype: Any, largest: bool) -> Any:
    if jnp.issubdtype(dtype, jnp.floating):
        return np.inf if largest else -np.inf
    if jnp.issubdtype(dtype, jnp.bool_):
        return largest
    if not jnp.issubdtype(dtype, jnp.integer):
        raise TypeError(
            f"There is no order of numbers of dtype {dtype}: let `of` take real ones."
        )
    limits = jnp.iinfo(dtype)
    return limits.max if largest else limits.min


def _full(value: Any, *, largest: bool) -> Any:
    return jax.tree.map(
        lambda x: jnp.full(x.shape, _limit(x.dtype, largest), x.dtype), value
    )


def _counted(values: Any, counts: Bool[Array, " c"], *, largest: bool) -> Any:
    def leaf(x):
        marks = counts.reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(marks, x, jnp.asarray(_limit(x.dtype, largest), x.dtype))

    return jax.tree.map(leaf, values)
