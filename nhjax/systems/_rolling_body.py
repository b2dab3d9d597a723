"""The common base of all rigid bodies that roll on a horizontal plane."""

import abc
import dataclasses
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, SE3, SO3
from .._system import LagrangianSystem
from ._base import AbstractConstrainedGroupExample, coordinates


Vector3 = Float[Array, "3"]
Pose = Float[Array, "7"]
Twist = Float[Array, "6"]


class AbstractRollingBody(AbstractConstrainedGroupExample):
    """A rigid body that rolls without slipping on the plane z = 0, on SE(3).

    ℓ = m/2 |v|² + ½ ω·(J ω) - m g z,  Φ = z + e₃·(R s),  φ = (R (v + ω × s))₁₂.

    Here q = (R, x): the attitude quaternion and the position of the centre of mass [m];
    v and ω are the linear and angular velocity in body axes [m/s, 1/s]. The vector from
    the centre of mass to the lowest point is s, in body axes. Φ is the height of this
    point, and φ the horizontal velocity (components 1 and 2) there. The multipliers are
    the two horizontal components and the normal component of the plane's force [N].
    """

    mass: eqx.AbstractVar[Array]
    retraction: eqx.AbstractVar[AbstractRetraction]

    # The weight is a property, because an abstract field `gravity` would become the
    # second argument of all subclasses.
    @property
    @abc.abstractmethod
    def weight(self) -> Array:
        """Return the weight m g."""

    @property
    @abc.abstractmethod
    def inertia(self) -> Float[Array, "3 3"]:
        """Return the matrix J of inertia about the centre of mass, in body axes."""

    @abc.abstractmethod
    def lowest_point(self, up: Vector3) -> Vector3:
        """Compute s, the vector from centre of mass to lowest point, in body axes.

        `up` is the upward vertical in body axes.
        """

    @property
    def manifold(self) -> SE3:
        """Return the group SE(3) with the retraction of the example."""
        return SE3(self.retraction)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian,
            nonholonomic=self.constraint,
            holonomic=self.holonomic,
            manifold=self.manifold,
        )

    def lagrangian(self, t: FloatScalarLike, q: Pose, v: Twist, args: Args) -> Array:
        """Compute the Lagrangian ℓ = m/2 |v|² + ½ ω·(J ω) - m g z."""
        translation = 0.5 * self.mass * (v[:3] @ v[:3])
        rotation = 0.5 * (v[3:] @ (self.inertia.astype(v.dtype) @ v[3:]))
        return translation + rotation - self.weight * q[6]

    def constraint(self, t: FloatScalarLike, q: Pose, v: Twist, args: Args) -> Array:
        """Compute the constraints φ: the horizontal velocity at the contact."""
        slip = v[:3] + jnp.cross(v[3:], self._contact(q))
        return SO3().Ad(q[:4], slip)[:2]

    def holonomic(self, t: FloatScalarLike, q: Pose, args: Args) -> Array:
        """Compute the constraint Φ, the height of the lowest point."""
        return self.contact_point(q)[2]

    def contact_point(self, q: Pose) -> Vector3:
        """Compute the lowest point of the body, in space."""
        return q[4:] + SO3().Ad(q[:4], self._contact(q))

    def plane_symmetry(self, q: Pose) -> Float[Array, "3 6"]:
        """Compute the generators of the motions of the plane, as body velocities.

        The motions are the translations along x and y and the rotation about z. They
        are symmetries of the system for every shape of the body.
        """
        motions = jnp.eye(6, dtype=q.dtype)[jnp.array([0, 1, 5])]
        back = self.manifold.inverse(q)
        return jax.vmap(lambda xi: self.manifold.Ad(back, xi))(motions)

    def contact_momentum(self, q: Pose, v: Twist) -> Vector3:
        """Compute the angular momentum about the point of contact, in body axes."""
        orbital = self.mass * jnp.cross(v[:3], self._contact(q))
        return orbital + self.inertia.astype(v.dtype) @ v[3:]

    def rolling(
        self,
        attitude: tuple[float, ...] | Array,
        angular_velocity: tuple[float, ...] | Array,
        contact: tuple[float, float] | Array = (0.0, 0.0),
    ) -> Self:
        """Create the same body with other, consistent initial data.

        `attitude` is a quaternion, `angular_velocity` ω is in body axes, and `contact`
        is the point of the plane where the body touches it.
        """
        quaternion = coordinates(attitude)
        quaternion = quaternion / jnp.sqrt(quaternion @ quaternion)
        omega = coordinates(angular_velocity)
        lowest = self.lowest_point(up_in_body(quaternion)).astype(omega.dtype)
        place = jnp.pad(coordinates(contact), (0, 1))
        q0 = jnp.concatenate([quaternion, place - SO3().Ad(quaternion, lowest)])
        v0 = jnp.concatenate([-jnp.cross(omega, lowest), omega])
        return dataclasses.replace(self, q0=q0, v0=v0)

    def _contact(self, q: Pose) -> Vector3:
        return self.lowest_point(up_in_body(q[:4])).astype(q.dtype)


def up_in_body(quaternion: Float[Array, "4"]) -> Vector3:
    """Compute the upward vertical Rᵀ e₃ in body axes."""
    return SO3().Ad_dual(quaternion, jnp.zeros_like(quaternion[1:]).at[2].set(1.0))
