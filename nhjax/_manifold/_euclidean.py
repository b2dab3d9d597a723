from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._compensated import two_sum
from .._errors import ShapeError
from ._abstract import AbstractLieGroup


class Euclidean(AbstractLieGroup):
    """The vector space R^n: the abelian group whose retraction is the identity.

    **Arguments:**

    - `n`: the number of coordinates.

    !!! example

        >>> import nhjax
        >>> nhjax.Euclidean(3).dim
        3
    """

    n: int = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.n, int) or self.n < 1:
            raise ValueError(f"Euclidean: `n` must be an int >= 1, got {self.n!r}.")

    @property
    def dim(self) -> int:
        """The dimension n."""
        return self.n

    def check(self, q: Float[Array, " n"]) -> Float[Array, " n"]:
        """`q`, or a `ShapeError` if it is not of shape (n,)."""
        if jnp.shape(q) != (self.n,):
            raise ShapeError(
                f"`q` has shape {jnp.shape(q)}, but the manifold Euclidean({self.n}) "
                f"needs shape ({self.n},). For many trajectories use `jax.vmap`."
            )
        return q

    def act(self, q: Float[Array, " n"], xi: Float[Array, " n"]) -> Float[Array, " n"]:
        """The point q + Ξ."""
        return q + xi

    def advance(
        self,
        q: Float[Array, " n"],
        xi: Float[Array, " n"],
        compensation: Float[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The point q + Ξ by compensated summation."""
        return two_sum(q, xi + compensation)

    def no_compensation(self, q: Float[Array, " n"]) -> Float[Array, " n"]:
        """A zero vector."""
        return jnp.zeros_like(q)

    def left_gradient(
        self,
        function: Callable[[Float[Array, " n"]], Array],
        q: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """The gradient of `function` at q."""
        return jax.grad(function)(q)
