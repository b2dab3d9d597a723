"""Chaplygin's sphere: balanced, but with three different moments of inertia."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from ._base import coordinates, parameter, require_positive, require_shape
from ._rolling_body import AbstractRollingBody


class ChaplyginSphere(AbstractRollingBody):
    """A balanced sphere with three different moments of inertia that rolls on a plane.

    ℓ = m/2 |v|² + ½ (I₁ω₁² + I₂ω₂² + I₃ω₃²) - m g z,  Φ = z - r,
    φ = (R (v - r ω × γ))₁₂,  γ = Rᵀ e₃.

    Here q = (R, x): the attitude quaternion and the position of the centre, which is
    also the centre of mass [m]; v and ω are the linear and angular velocity along the
    principal axes [m/s, 1/s]. Φ is the height of the contact, and φ the horizontal
    velocity (components 1 and 2) there. The multipliers are the components, along the
    axes of space, of the force that the plane exerts on the sphere [N].

    The angular momentum about the contact, R K with K = I ω + m r² (ω - (ω·γ) γ), is
    constant in space, so that |K|² and K·γ are constant too, and the system is
    integrable.

    **Parameters:** `mass` m [kg]; `radius` r [m]; `moments` (I₁, I₂, I₃) about the
    centre [kg m²]; `gravity` g [m/s²], which affects only the normal force;
    `retraction`, the retraction of SE(3).

    **Source:** Chaplygin, *On a ball's rolling on a horizontal plane* (1903), in
    English in Regular and Chaotic Dynamics 7 (2002).

    !!! example

        >>> from nhjax.systems import ChaplyginSphere
        >>> sphere = ChaplyginSphere(moments=(0.2, 0.3, 0.45))
        >>> system, y0 = sphere.system, sphere.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [-0.038, -0.25, 9.81]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    radius: Array = eqx.field(converter=parameter, default=1.0)
    moments: Array = eqx.field(converter=coordinates, default=(0.3, 0.4, 0.5))
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(0.8, 0.6, 0.0, 0.0, 0.0, 0.0, 1.0),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(2.2, -0.14, 0.48, 0.5, 1.0, -2.0),
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

    @property
    def weight(self) -> Array:
        """Return the weight m g."""
        return self.mass * self.gravity

    @property
    def inertia(self) -> Float[Array, "3 3"]:
        """Return the matrix of inertia about the centre, along the principal axes."""
        return jnp.diag(self.moments)

    def lowest_point(self, up: Array) -> Array:
        """Compute the vector -r γ from centre to contact, where γ is `up`."""
        return -self.radius * up

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved energy, and the conserved contact momentum R K."""
        x, y, z = SO3().Ad(q[:4], self.contact_momentum(q, v))
        return {
            "energy": self.energy(t, q, v),
            "contact_momentum_x": x,
            "contact_momentum_y": y,
            "contact_momentum_z": z,
        }

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the positions of the centre, contact and three poles [m].

        The poles are where the principal axes leave the sphere.
        """
        poles = self.radius * jnp.eye(3, dtype=q.dtype)
        return {
            "centre": q[4:],
            "contact": self.contact_point(q),
            "pole_1": q[4:] + SO3().Ad(q[:4], poles[0]),
            "pole_2": q[4:] + SO3().Ad(q[:4], poles[1]),
            "pole_3": q[4:] + SO3().Ad(q[:4], poles[2]),
        }
