"""Chaplygin's top: a sphere whose centre of mass is not at its centre."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from ._base import (
    coordinates,
    parameter,
    require_positive,
    require_possible,
    require_shape,
)
from ._rolling_body import AbstractRollingBody


class ChaplyginTop(AbstractRollingBody):
    """A loaded sphere that rolls on a plane: Routh's sphere, and Chaplygin's top.

    ℓ = m/2 |v|² + ½ (I₁ω₁² + I₂ω₂² + I₃ω₃²) - m g z,  Φ = z + e₃·(R s),
    φ = (R (v + ω × s))₁₂,  s = a e₃ - r γ,  γ = Rᵀ e₃.

    Here q = (R, x): the attitude quaternion and the position of the centre of mass [m];
    v and ω are the linear and angular velocity along the principal axes [m/s, 1/s]. If
    the third axis points upward, the centre of mass is at the distance a below the
    centre of the sphere. The vector from the centre of mass to the contact is s; Φ is
    the height of the contact, and φ the horizontal velocity there. The multipliers are
    the components, along the axes of space, of the force that the plane exerts on the
    sphere [N]. e₃ is (0, 0, 1), and γ the upward vertical in body axes.

    If I₁ = I₂, the body is Routh's sphere, which is integrable. Besides the energy, two
    quantities are then conserved: Jellett's integral K·s, with the angular momentum K
    about the contact, and Routh's integral ω₃ √(I₁I₃ + m (I₁ (s₁² + s₂²) + I₃ s₃²)).

    **Parameters:** `mass` m [kg]; `radius` r [m]; `offset` a [m], of either sign;
    `moments` (I₁, I₂, I₃) about the centre of mass [kg m²]; `gravity` g [m/s²];
    `retraction`, the retraction of SE(3).

    **Source:** Routh, *Advanced Rigid Dynamics*; Chaplygin, *On a motion
    of a heavy body of revolution on a horizontal plane* (1897), in English in Regular
    and Chaotic Dynamics 7 (2002); Bustamante and Lynch, *Nonholonomic Noetherian
    symmetries and integrals of the Routh sphere and Chaplygin ball*, arXiv:1908.09781.

    !!! example

        >>> from nhjax.systems import ChaplyginTop
        >>> top = ChaplyginTop(moments=(0.3, 0.35, 0.4))
        >>> system, y0 = top.system, top.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [-0.091, 1.772, 9.879]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    radius: Array = eqx.field(converter=parameter, default=1.0)
    offset: Array = eqx.field(converter=parameter, default=0.25)
    moments: Array = eqx.field(converter=coordinates, default=(0.35, 0.35, 0.4))
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(0.8, 0.6, 0.0, 0.0, 0.0, 0.24, 0.93),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(-1.95, -0.015, 0.48, 0.5, -1.0, 2.0),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_shape((3,), moments=self.moments)
        require_positive(
            mass=self.mass,
            radius=self.radius,
            moments=self.moments,
            gravity=self.gravity,
        )
        require_possible(
            abs(self.offset) < self.radius,
            f"`offset` must be smaller than `radius` = {self.radius}, got "
            f"{self.offset}.",
        )

    @property
    def weight(self) -> Array:
        """Return the weight m g."""
        return self.mass * self.gravity

    @property
    def inertia(self) -> Float[Array, "3 3"]:
        """Return the matrix of inertia about the centre of mass."""
        return jnp.diag(self.moments)

    def lowest_point(self, up: Array) -> Array:
        """Compute s = a e₃ - r γ, where γ is `up`."""
        return (-self.radius * up).at[2].add(self.offset)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved for all moments of inertia."""
        return {"energy": self.energy(t, q, v)}

    def integrals_of_routh(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Compute Jellett's and Routh's integral, conserved if I₁ = I₂."""
        s, moments = self._contact(q), self.moments.astype(v.dtype)
        weighted = moments[0] * moments[2] + self.mass * (moments @ s**2)
        return self.contact_momentum(q, v) @ s, v[5] * jnp.sqrt(weighted)

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the positions of the centres, the contact and the pole [m].

        The pole is where the third axis leaves the sphere.
        """
        axis = jnp.zeros_like(q[4:]).at[2]
        return {
            "centre_of_mass": q[4:],
            "centre": q[4:] + SO3().Ad(q[:4], axis.set(self.offset)),
            "contact": self.contact_point(q),
            "pole": q[4:] + SO3().Ad(q[:4], axis.set(self.offset + self.radius)),
        }
