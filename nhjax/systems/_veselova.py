"""Veselova's problem."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from ._base import (
    AbstractConstrainedGroupExample,
    coordinates,
    require_possible,
    require_shape,
)


_INERTIA = ((1.0, 0.1, 0.2), (0.1, 1.4, -0.15), (0.2, -0.15, 0.8))


class Veselova(AbstractConstrainedGroupExample):
    """A rigid body that cannot turn about an axis fixed in space, on SO(3).

    ℓ = ½ ω·Jω - w·γ,  φ = γ·ω,  γ = Rᵀ e₃.

    Here q is the attitude quaternion of the rotation R, ω is the body angular velocity,
    and γ is the upward vertical in body axes. Without weight, the horizontal part of
    the angular momentum in space is conserved in addition to the energy, and the
    problem is integrable.

    **Parameters:** `inertia` J, the matrix of inertia about the fixed point [kg m²];
    `weight` w = m g X [N m], with the vector X from the fixed point to the centre of
    mass in body axes; `retraction`, the retraction of SO(3).

    **Source:** Veselov and Veselova, "Integrable nonholonomic systems on Lie groups",
    Math. Notes 44 (1988).

    !!! example

        >>> from nhjax.systems import Veselova
        >>> veselova = Veselova(weight=(0.0, 0.0, 0.0))
        >>> veselova.horizontal_momentum(veselova.q0, veselova.v0).shape
        (2,)
    """

    inertia: Array = eqx.field(converter=coordinates, default=_INERTIA)
    weight: Array = eqx.field(converter=coordinates, default=(0.0, 0.0, 0.3))
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates, default=(0.9, 0.3, -0.3, 0.1), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(0.8, -0.2, -0.6), kw_only=True
    )

    def __check_init__(self) -> None:
        require_shape((3, 3), inertia=self.inertia)
        require_shape((3,), weight=self.weight)
        symmetric = jnp.all(self.inertia == self.inertia.T)
        require_possible(
            symmetric & jnp.all(jnp.linalg.eigvalsh(self.inertia) > 0),
            f"`inertia` must be symmetric and positive definite, got {self.inertia}.",
        )

    @property
    def manifold(self) -> SO3:
        """Return the group SO(3) with the retraction of the example."""
        return SO3(self.retraction)

    def vertical(self, q: Array) -> Array:
        """Compute γ = Rᵀ e₃, the upward vertical in body axes."""
        return self.manifold.Ad_dual(q, jnp.array([0.0, 0.0, 1.0], q.dtype))

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the left-trivialised Lagrangian ℓ = ½ ω·Jω - w·γ."""
        kinetic = 0.5 * (v @ self.inertia.astype(v.dtype) @ v)
        return kinetic - self.weight.astype(v.dtype) @ self.vertical(q)

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint φ = γ·ω."""
        return self.vertical(q) @ v

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def horizontal_momentum(self, q: Array, v: Array) -> Array:
        """Compute the horizontal part of R J ω, which is conserved without weight."""
        return self.manifold.matrix(q)[:2] @ (self.inertia.astype(v.dtype) @ v)
