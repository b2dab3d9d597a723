"""The rolling torus; if its tube has the radius zero, it is Euler's rolling disc."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from ._base import (
    coordinates,
    parameter,
    require_not_negative,
    require_positive,
    require_possible,
)
from ._rolling_body import AbstractRollingBody


class RollingTorus(AbstractRollingBody):
    """A torus (a wheel, a hoop or a disc) that rolls and tilts on a plane.

    ℓ = m/2 |v|² + ½ (I (ω₁² + ω₂²) + J ω₃²) - m g z,  Φ = z + e₃·(R s),
    φ = (R (v + ω × s))₁₂,  s = -r γ - a (γ₁, γ₂, 0)/√(γ₁² + γ₂²),  γ = Rᵀ e₃.

    Here q = (R, x): the attitude quaternion and the position of the centre [m]; v and ω
    are the linear and angular velocity in body axes [m/s, 1/s], and the third body axis
    is the axle. The vector from the centre to the lowest point is s; Φ is the height of
    this point, and φ the horizontal velocity there. The multipliers are the components,
    along the axes of space, of the force that the plane exerts on the body [N]. e₃ is
    (0, 0, 1), and γ the upward vertical in body axes. With r = 0, the default, the body
    is a disc of zero thickness: Euler's disc without slip.

    The axle must not be vertical, because the lowest point is then not unique. In a
    steady motion the tilt is constant, and the centre moves on a circle or rests;
    `steady` and `circling` create steady motions.

    **Parameters:** `mass` m [kg]; `radius` a of the circle in the middle of the tube,
    and `tube_radius` r [m]; `diametral_inertia` I and `axial_inertia` J about the
    centre [kg m²]; `gravity` g [m/s²]; `retraction`, the retraction of SE(3).

    **Source:** Routh, *Advanced Rigid Dynamics*, article 244; McDonald and
    McDonald, *The rolling motion of a disk on a horizontal plane* (2001); Moffatt,
    *Euler's disk and its finite-time singularity*, Nature 404 (2000).

    !!! example

        >>> from nhjax.systems import RollingTorus
        >>> disc = RollingTorus.circling(tilt=1.0, radius_of_path=0.3, radius=0.1)
        >>> system, y0 = disc.system, disc.initial_state()
        >>> round(float(y0.multiplier[2]), 3)
        9.81
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    radius: Array = eqx.field(converter=parameter, default=0.5)
    tube_radius: Array = eqx.field(converter=parameter, default=0.0)
    diametral_inertia: Array = eqx.field(converter=parameter, default=0.0625)
    axial_inertia: Array = eqx.field(converter=parameter, default=0.125)
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(0.8, 0.6, 0.0, 0.0, 0.0, 0.14, 0.48),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(-2.0, 0.0, 0.1, 0.2, 0.5, 4.0),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_positive(
            mass=self.mass,
            radius=self.radius,
            diametral_inertia=self.diametral_inertia,
            axial_inertia=self.axial_inertia,
            gravity=self.gravity,
        )
        require_not_negative(tube_radius=self.tube_radius)

    @classmethod
    def steady(
        cls, tilt: ArrayLike, turn_rate: ArrayLike, **parameters: Any
    ) -> "RollingTorus":
        """Create a torus that turns steadily at the rate Ω = `turn_rate` [1/s].

        `tilt` θ [rad] is the angle of the axle to the vertical. The angular velocity is
        (0, Ω sin θ, ω₃) along the axes (horizontal, upward in the plane of the disc,
        axle), and the balance of moments about the contact determines ω₃.
        `parameters` are the parameters of the class.
        """
        angle, rate = parameter(tilt), parameter(turn_rate)
        require_possible(
            rate != 0, "`turn_rate` must be nonzero: nothing determines ω₃."
        )
        _require_between("tilt", angle, jnp.pi, "π")
        body = cls(**parameters)
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        height = body.radius * sin + body.tube_radius
        below, aside = body.radius + body.tube_radius * sin, body.tube_radius * cos
        turn = (
            rate**2 * sin * (body.diametral_inertia * cos + body.mass * height * aside)
        )
        share = body.axial_inertia * sin + body.mass * height * below
        spin = (turn - body.weight * body.radius * cos) / (rate * share)
        zero = jnp.zeros_like(angle)
        attitude = jnp.stack([jnp.cos(0.5 * angle), jnp.sin(0.5 * angle), zero, zero])
        return body.rolling(attitude, jnp.stack([zero, rate * sin, spin]))

    @classmethod
    def circling(
        cls, tilt: ArrayLike, radius_of_path: ArrayLike, **parameters: Any
    ) -> "RollingTorus":
        """Create a torus whose centre moves steadily on a circle, or rests.

        `tilt` [rad] is the angle of the axle to the vertical, below π/2.
        `radius_of_path` [m] is the radius of the circle on which the centre moves, or 0
        if the centre rests. The torus leans towards the middle of the circle.
        `parameters` are the parameters of the class.
        """
        angle, path = parameter(tilt), parameter(radius_of_path)
        _require_between("tilt", angle, 0.5 * jnp.pi, "π/2")
        require_not_negative(radius_of_path=path)
        body = cls(**parameters)
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        height = body.radius * sin + body.tube_radius
        # The value of -ω₃ / Ω, from the velocity of the centre.
        roll = path - body.tube_radius * sin * cos
        roll = roll / (body.radius + body.tube_radius * sin)
        momentum = body.diametral_inertia * cos + body.axial_inertia * roll
        moment = body.weight * body.radius * cos
        rate = jnp.sqrt(moment / (body.mass * path * height + sin * momentum))
        require_possible(
            jnp.isfinite(rate),
            f"There is no steady motion with `tilt` = {angle} and `radius_of_path` = "
            f"{path} of this torus: the square of its rate would not be positive.",
        )
        return cls.steady(angle, rate, **parameters)

    @property
    def weight(self) -> Array:
        """Return the weight m g."""
        return self.mass * self.gravity

    @property
    def inertia(self) -> Float[Array, "3 3"]:
        """Return the matrix diag(I, I, J) of inertia about the centre."""
        diametral, axial = self.diametral_inertia, self.axial_inertia
        return jnp.diag(jnp.stack([diametral, diametral, axial]))

    def lowest_point(self, up: Array) -> Array:
        """Compute s = -r γ - a (γ₁, γ₂, 0)/√(γ₁² + γ₂²), where γ is `up`."""
        across = up.at[2].set(0.0)
        return -self.tube_radius * up - self.radius * across / jnp.sqrt(across @ across)

    def symmetry(self, q: Array) -> Float[Array, "4 6"]:
        """Compute the generators of all symmetries, as body velocities.

        The symmetries are the motions of the plane, and the rotation of the torus about
        its axle.
        """
        spin = jnp.zeros((1, 6), q.dtype).at[0, 5].set(1)
        return jnp.concatenate([self.plane_symmetry(q), spin])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved quantities: the energy."""
        return {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the positions of the centre, contact and a point of the rim [m].

        The point of the rim is on the first body axis, in the middle of the tube.
        """
        rim = jnp.zeros_like(q[4:]).at[0].set(self.radius.astype(q.dtype))
        return {
            "centre": q[4:],
            "contact": self.contact_point(q),
            "rim": q[4:] + SO3().Ad(q[:4], rim),
        }


def _require_between(name: str, angle: Array, bound: float, text: str) -> None:
    require_possible(
        (angle > 0) & (angle < bound),
        f"`{name}` must lie between 0 and {text}, got {angle}.",
    )
