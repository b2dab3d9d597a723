"""The ball on a turntable."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, Euclidean, ProductGroup, SO3
from ._base import (
    AbstractConstrainedGroupExample,
    coordinates,
    pair,
    parameter,
    require_nonzero,
    require_positive,
    require_shape,
)
from ._linear_flow import attitude, attitude_in_space, rotation


class TurntableBall(AbstractConstrainedGroupExample):
    """A ball that rolls without slipping on a turning horizontal table.

    ℓ = ½ (v_x² + v_y²) + r²/2 (a ω₁² + b ω₂² + c ω₃²),
    φ = (v_x + Ωy - r ω_η, v_y - Ωx + r ω_ξ).

    The group is SO(3) x R². Its element q = (R, (x, y)) consists of the attitude
    quaternion and the position of the centre of the ball; v = (ω₁, ω₂, ω₃, v_x, v_y)
    with the body angular velocity ω. The centre of mass is the centre of the ball, and
    the mass of the ball is one. The constraints are affine, so that the energy E is not
    conserved, but the moving energy E - Ω(x v_y - y v_x) is conserved.

    The constraints contain an angular velocity (ω_ξ, ω_η, ω_ζ), which `frame` selects:

    - `frame="space"` (the default) selects the spatial angular velocity Rω, as for a
        physical ball.
    - `frame="body"` selects ω itself along the principal axes ξ, η, ζ, as in the
        constraints that the paper prints. For a homogeneous ball, a = b = c, the motion
        of (x, y) and of (ω_ξ, ω_η, ω_ζ) is the same as with `frame="space"`. For
        unequal moments, the system is not the physical ball.

    A homogeneous ball moves on a circle, at the rate κ = Ωa/(1 + a).

    **Parameters:** `radius` r [m]; `moments` (a, b, c), the principal moments of
    inertia over (mass times r²) [1], 2/5 for a solid ball; `rate` Ω of the table
    [1/s]; `frame`; `retraction`, the retraction of SO(3).

    **Source:** Martín de Diego and Sato Martín de Almagro, *High-order geometric
    methods for nonholonomic mechanical systems*, fifth numerical experiment; Fassò and
    Sansonetto, *Conservation of 'moving' energy in nonholonomic systems with affine
    constraints* (2016).

    !!! example

        >>> from nhjax.systems import TurntableBall
        >>> ball = TurntableBall(moments=(0.4, 0.4, 0.4))
        >>> y0, (q, v, multiplier) = ball.initial_state(), ball.exact(1.0)
        >>> [round(x, 3) for x in v.tolist()]
        [0.791, -0.057, 0.533, 0.108, 0.145]
    """

    radius: Array = eqx.field(converter=parameter, default=0.5)
    moments: Array = eqx.field(converter=coordinates, default=(0.4, 0.4, 0.4))
    rate: Array = eqx.field(converter=parameter, default=1.2)
    frame: Literal["space", "body"] = eqx.field(
        static=True, default="space", kw_only=True
    )
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: tuple[Array, Array] = eqx.field(
        converter=pair, default=((1.0, 0.0, 0.0, 0.0), (0.3, -0.2)), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(0.52, -0.18, 0.6, 0.15, 0.1), kw_only=True
    )

    def __check_init__(self) -> None:
        require_shape((3,), moments=self.moments)
        require_positive(radius=self.radius, moments=self.moments)
        if self.frame not in ("space", "body"):
            raise ValueError(f'`frame` must be "space" or "body", got {self.frame!r}.')

    @property
    def manifold(self) -> ProductGroup:
        """Return the group SO(3) x R² with the retraction of the example."""
        return ProductGroup(SO3(self.retraction), Euclidean(2))

    @classmethod
    def rolling(
        cls,
        position: tuple[float, float] | Array,
        velocity: tuple[float, float] | Array,
        spin: float | Array = 0.0,
        **parameters: Any,
    ) -> "TurntableBall":
        """Create a rolling ball at `position` (x, y) with `velocity` (v_x, v_y).

        `spin` is ω_ζ; `parameters` are the parameters of the class.
        """
        ball = cls(**parameters)
        x, y = coordinates(position)
        dx, dy = coordinates(velocity)
        omega = jnp.stack(
            [
                (ball.rate * x - dy) / ball.radius,
                (ball.rate * y + dx) / ball.radius,
                jnp.asarray(spin, x.dtype),
            ]
        )
        if ball.frame == "space":
            omega = SO3().Ad_dual(ball.q0[0], omega)
        q0 = (ball.q0[0], jnp.stack([x, y]))
        v0 = jnp.concatenate([omega, jnp.stack([dx, dy])])
        return cls(**(parameters | {"q0": q0, "v0": v0}))

    def lagrangian(
        self, t: FloatScalarLike, q: tuple[Array, Array], v: Array, args: Args
    ) -> Array:
        """Compute the Lagrangian ℓ = ½ (v_x² + v_y²) + r²/2 (a ω₁² + b ω₂² + c ω₃²)."""
        rotation_energy = 0.5 * self.radius**2 * (self._moments(v) @ v[:3] ** 2)
        return 0.5 * (v[3:] @ v[3:]) + rotation_energy

    def constraint(
        self, t: FloatScalarLike, q: tuple[Array, Array], v: Array, args: Args
    ) -> Array:
        """Compute the constraints φ = (v_x + Ωy - r ω_η, v_y - Ωx + r ω_ξ)."""
        x, y = q[1]
        omega = self.rolling_velocity(q, v)
        return jnp.stack(
            [
                v[3] + self.rate * y - self.radius * omega[1],
                v[4] - self.rate * x + self.radius * omega[0],
            ]
        )

    def rolling_velocity(self, q: tuple[Array, Array], v: Array) -> Array:
        """Compute (ω_ξ, ω_η, ω_ζ), the angular velocity in the constraints."""
        return self._in_frame(q, v[:3])

    def invariants(
        self, t: FloatScalarLike, q: tuple[Array, Array], v: Array
    ) -> dict[str, Array]:
        """Compute the moving energy and, if `frame="space"`, the contact momentum.

        The contact momentum is the angular momentum about the contact point, in the
        axes of space. For a homogeneous ball, its horizontal components are r(1 + a)
        times the second and the third value of `first_integrals`, and its vertical
        component is r²a times the first value.
        """
        x, y = q[1]
        energy = self.energy(t, q, v)
        invariants = {"moving_energy": energy - self.rate * (x * v[4] - y * v[3])}
        if self.frame == "body":
            return invariants
        spin = self._in_frame(q, self.radius**2 * self._moments(v) * v[:3])
        return invariants | {
            "contact_momentum_x": spin[0] - self.radius * v[4],
            "contact_momentum_y": spin[1] + self.radius * v[3],
            "contact_momentum_z": spin[2],
        }

    def first_integrals(self, q: tuple[Array, Array], v: Array) -> Array:
        """Compute the conserved quantities of a homogeneous ball, a = b = c.

        They are (ω_ζ, r ω_ξ - Ωx/(1 + a), r ω_η - Ωy/(1 + a)).
        """
        omega = self.rolling_velocity(q, v)
        share = self.rate / (1.0 + self._moments(v)[0])
        return jnp.stack(
            [
                omega[2],
                self.radius * omega[0] - share * q[1][0],
                self.radius * omega[1] - share * q[1][1],
            ]
        )

    def exact(
        self, t: float
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent data and a = b = c.

        The attitude satisfies a linear differential equation, which is solved to
        round-off. All other values have closed formulas.
        """
        (quaternion, (x0, y0)), v0 = self._consistent_data()
        a, b, c = np.asarray(self.moments, dtype=np.float64)
        if not a == b == c:
            raise ValueError(
                f"`moments` must be equal for the exact solution, got {self.moments}."
            )
        require_nonzero("rate", float(self.rate), "the ball moves uniformly")
        radius, rate = float(self.radius), float(self.rate)
        kappa = a * rate / (1 + a)
        speed0 = complex(v0[3], v0[4])
        spatial = self.frame == "space"
        spin = (rotation(quaternion) @ v0[:3] if spatial else v0[:3])[2]

        def rolling(times):
            velocity = speed0 * np.exp(1j * kappa * times)
            position = complex(x0, y0) + (velocity - speed0) / (1j * kappa)
            omega = (rate * position + 1j * velocity) / radius
            spins = np.full_like(omega.real, spin)
            return position, velocity, np.stack([omega.real, omega.imag, spins])

        def angular_velocity(times):
            return rolling(times)[2]

        position, velocity, omega = rolling(np.float64(t))
        bound = (abs(rate) * (abs(complex(x0, y0)) + 2 * abs(speed0 / kappa))) / radius
        fastest = abs(kappa) + abs(spin) + bound + abs(speed0) / radius
        transport = attitude_in_space if spatial else attitude
        quaternion = transport(quaternion, angular_velocity, t, fastest)
        if spatial:
            omega = rotation(quaternion).T @ omega
        return (
            (quaternion, np.array([position.real, position.imag])),
            np.array([*omega, velocity.real, velocity.imag]),
            kappa * np.array([-velocity.imag, velocity.real]),
        )

    def _moments(self, v: Array) -> Array:
        return self.moments.astype(v.dtype)

    def _in_frame(self, q: tuple[Array, Array], body_vector: Array) -> Array:
        if self.frame == "body":
            return body_vector
        return SO3().Ad(q[0], body_vector)
