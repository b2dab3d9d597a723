"""The heavy top, on SO(3) and as a constrained body on SE(3)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SE3, SO3
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    parameter,
    require_positive,
    require_shape,
)


class HeavyTop(AbstractExample):
    """A rigid body under gravity that turns about a fixed pivot, the origin, on SO(3).

    ℓ = m/2 |ω × X|² + ½ (J₁ω₁² + J₂ω₂² + J₃ω₃²) - m g e₃·(R X).

    Here q is the attitude quaternion of the rotation R, ω is the body angular velocity
    along the principal axes, and X is the vector from the pivot to the centre of mass
    in body axes. If J₁ = J₂ and X lies on the third axis, as by default, the body is
    Lagrange's top.

    **Parameters:** `mass` m [kg], `moments` (J₁, J₂, J₃) about the centre of mass
    [kg m²], `centre` X [m], `gravity` g [m/s²]; `retraction`, the retraction of SO(3).

    **Source:** Lagrange (1788); Arnold, *Mathematical Methods of Classical Mechanics*,
    section 30.

    !!! example

        >>> from nhjax.systems import HeavyTop
        >>> top = HeavyTop(gravity=9.81)
        >>> y0, on_se3 = top.initial_state(), top.on_se3()
        >>> [round(x, 3) for x in y0.p.tolist()]
        [0.11, -0.055, 1.2]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    moments: Array = eqx.field(converter=coordinates, default=(0.3, 0.3, 0.4))
    centre: Array = eqx.field(converter=coordinates, default=(0.0, 0.0, 0.5))
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates, default=(0.96, 0.28, 0.0, 0.0), kw_only=True
    )
    v0: Array = eqx.field(converter=coordinates, default=(0.2, -0.1, 3.0), kw_only=True)

    def __check_init__(self) -> None:
        _check_body(self.mass, self.moments, self.centre)

    @property
    def manifold(self) -> SO3:
        """Return the group SO(3) with the retraction of the example."""
        return SO3(self.retraction)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, manifold=self.manifold)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the left-trivialised Lagrangian.

        ℓ = m/2 |ω × X|² + ½ (J₁ω₁² + J₂ω₂² + J₃ω₃²) - m g e₃·(R X).
        """
        centre = self.centre.astype(v.dtype)
        velocity = jnp.cross(v, centre)
        translation = 0.5 * self.mass * (velocity @ velocity)
        height = self.manifold.Ad(q, centre)[2]
        rotation = 0.5 * (self.moments.astype(v.dtype) @ v**2)
        return translation + rotation - self.mass * self.gravity * height

    def body_momentum(self, v: Array) -> Array:
        """Compute the body angular momentum about the pivot."""
        centre = self.centre.astype(v.dtype)
        orbital = self.mass * jnp.cross(centre, jnp.cross(v, centre))
        return orbital + self.moments.astype(v.dtype) * v

    def axis_momentum(self, v: Array) -> Array:
        """Compute J₃ω₃, which is conserved for Lagrange's top."""
        return self.moments.astype(v.dtype)[2] * v[2]

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy and the vertical angular momentum in space."""
        return {
            "energy": self.energy(t, q, v),
            "vertical_momentum": self.manifold.Ad(q, self.body_momentum(v))[2],
        }

    def on_se3(self) -> "HeavyTopSE3":
        """Return the same top, with the same motion, on SE(3)."""
        position = self.manifold.Ad(self.q0, self.centre)
        velocity = jnp.cross(self.v0, self.centre)
        return HeavyTopSE3(
            self.mass,
            self.moments,
            self.centre,
            self.gravity,
            retraction=self.retraction,
            q0=jnp.concatenate([self.q0, position]),
            v0=jnp.concatenate([velocity, self.v0]),
        )


class HeavyTopSE3(AbstractExample):
    """The heavy top as a body in space whose pivot is held by constraints, on SE(3).

    ℓ = m/2 |v|² + ½ (J₁ω₁² + J₂ω₂² + J₃ω₃²) - m g e₃·x,  Φ = x - R X.

    Here q = (R, x): the attitude quaternion and the position of the centre of mass; v
    and ω are the linear and angular velocity in body axes. X is the vector from the
    pivot to the centre of mass in body axes. The three constraints are holonomic, and
    their multipliers are the components, along the axes of space, of the force of the
    pivot on the body. The body moves like `HeavyTop` with the same parameters.

    **Parameters:** the parameters of `HeavyTop`; `retraction`, the retraction of SE(3).

    **Source:** as for `HeavyTop`; Brüls and Cardona, *On the use of Lie group time
    integrators in multibody dynamics* (2010), for the formulation.

    !!! example

        >>> from nhjax.systems import HeavyTop
        >>> top = HeavyTop(gravity=9.81).on_se3()
        >>> y0 = top.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [0.218, -2.1, 8.442]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    moments: Array = eqx.field(converter=coordinates, default=(0.3, 0.3, 0.4))
    centre: Array = eqx.field(converter=coordinates, default=(0.0, 0.0, 0.5))
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(0.96, 0.28, 0.0, 0.0, 0.0, -0.2688, 0.4216),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(-0.05, -0.1, 0.0, 0.2, -0.1, 3.0), kw_only=True
    )

    def __check_init__(self) -> None:
        _check_body(self.mass, self.moments, self.centre)

    @property
    def manifold(self) -> SE3:
        """Return the group SE(3) with the retraction of the example."""
        return SE3(self.retraction)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, holonomic=self.holonomic, manifold=self.manifold
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the left-trivialised Lagrangian.

        ℓ = m/2 |v|² + ½ (J₁ω₁² + J₂ω₂² + J₃ω₃²) - m g e₃·x.
        """
        translation = 0.5 * self.mass * (v[:3] @ v[:3])
        rotation = 0.5 * (self.moments.astype(v.dtype) @ v[3:] ** 2)
        return translation + rotation - self.mass * self.gravity * q[6]

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraint Φ = x - R X."""
        return q[4:] - SO3().Ad(q[:4], self.centre.astype(q.dtype))

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy and the vertical angular momentum in space."""
        velocity = SO3().Ad(q[:4], v[:3])
        orbital = self.mass * (q[4] * velocity[1] - q[5] * velocity[0])
        spin = SO3().Ad(q[:4], self.moments.astype(v.dtype) * v[3:])
        return {
            "energy": self.energy(t, q, v),
            "vertical_momentum": orbital + spin[2],
        }

    def axis_momentum(self, v: Array) -> Array:
        """Compute J₃ω₃, which is conserved for Lagrange's top."""
        return self.moments.astype(v.dtype)[2] * v[5]


def _check_body(mass: Array, moments: Array, centre: Array) -> None:
    require_shape((3,), moments=moments, centre=centre)
    require_positive(mass=mass, moments=moments)
