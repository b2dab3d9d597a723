"""Groups that a user might write: seven methods each."""

import jax.numpy as jnp

from nhjax._errors import ShapeError
from nhjax._manifold import AbstractLieGroup


class Heisenberg(AbstractLieGroup):
    """R^3 with (x, y, z)(x', y', z') = (x + x', y + y', z + z' + (x y' - y x')/2)."""

    @property
    def dim(self):
        return 3

    def identity(self, dtype=None):
        return jnp.zeros(3, dtype)

    def check(self, q, name="q"):
        if jnp.shape(q) != (3,):
            raise ShapeError(f"`{name}` must have shape (3,)")
        return q

    def compose(self, g, h):
        return (g + h).at[2].add(0.5 * (g[0] * h[1] - g[1] * h[0]))

    def inverse(self, g):
        return -g

    def retract(self, xi):
        return xi

    def local(self, g):
        return g


class HeisenbergBySecondKind(Heisenberg):
    """The same group by coordinates of the second kind, with τ(-ξ) ≠ τ(ξ)⁻¹.

    τ(ξ) = (0, ξ₂, 0)(ξ₁, 0, ξ₃).
    """

    def retract(self, xi):
        return xi.at[2].add(-0.5 * xi[0] * xi[1])

    def local(self, g):
        return g.at[2].add(0.5 * g[0] * g[1])


class SL2(AbstractLieGroup):
    """The real 2 x 2 matrices of determinant 1, with Cayley's map."""

    @property
    def dim(self):
        return 3

    def identity(self, dtype=None):
        return jnp.eye(2, dtype=dtype)

    def check(self, q, name="q"):
        return q

    def compose(self, g, h):
        return g @ h

    def inverse(self, g):
        return jnp.array([[g[1, 1], -g[0, 1]], [-g[1, 0], g[0, 0]]])

    def retract(self, xi):
        X, one = self.hat(xi), self.identity(xi.dtype)
        # X² is a multiple of the identity: (I - X/2)⁻¹ = (I + X/2)/(1 - X²/4).
        square = xi[0] ** 2 + xi[1] * xi[2]
        return (one + 0.5 * X) @ (one + 0.5 * X) / (1 - 0.25 * square)

    def local(self, g):
        scale = 2 / (2 + g[0, 0] + g[1, 1])
        return scale * jnp.array([g[0, 0] - g[1, 1], 2 * g[0, 1], 2 * g[1, 0]])

    def hat(self, xi):
        return jnp.array([[xi[0], xi[1]], [xi[2], -xi[0]]])

    def matrix(self, g):
        return g
