"""The ball in a bowl that turns."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, Euclidean, ProductGroup, SO3
from .._system import LagrangianSystem
from ._base import (
    AbstractConstrainedGroupExample,
    coordinates,
    pair,
    parameter,
    require_not_negative,
    require_positive,
    require_possible,
)


Element = tuple[Array, Array]
Shape = Literal["paraboloid", "sphere"]
Vector3 = Float[Array, "3"]


class BallInBowl(AbstractConstrainedGroupExample):
    """A ball that rolls without slipping in a bowl that turns about the vertical.

    ℓ = m/2 |ẋ|² + k m a²/2 |ω|² - m g z,  Φ = z - κ/2 (x² + y² + ε z²),
    φ = (ẋ - a (R ω) × n - Ω e₃ × (x - a n))₁₂,  n = ∇Φ/|∇Φ|.

    The group is SO(3) x R³. Its element q = (R, (x, y, z)) consists of the attitude
    quaternion and the position of the centre of the ball [m]. This position is the
    vector x in φ. The velocity is v = (ω₁, ω₂, ω₃, ẋ, ẏ, ż), with the body angular
    velocity ω [1/s]. The centre moves on Φ = 0. This surface is a paraboloid (ε = 0) or
    a sphere of radius 1/κ (ε = 1), with its lowest point at the origin. The bowl is
    parallel to this surface, at the distance a below it; n is the normal of both. The
    index ₁₂ selects the horizontal components. The constraints φ are affine. They mean
    that the ball does not slip at the contact x - a n. With the multipliers
    (λ₁, λ₂, μ) the force of the bowl is (λ₁, λ₂, 0) + μ ∇Φ [N].

    The energy E is not conserved, but the moving energy
    E - Ω (m (x ẏ - y ẋ) + k m a² (R ω)₃) is conserved. For a flat bowl, κ = 0, the
    system is the `TurntableBall`.

    **Parameters:** `mass` m [kg]; `radius` a of the ball [m]; `inertia_ratio` k, its
    moment of inertia over m a² [1], 2/5 for a solid ball; `curvature` κ [1/m] of the
    surface on which the centre moves, at its lowest point; `rate` Ω of the bowl [1/s];
    `gravity` g [m/s²]; `shape`, "paraboloid" or "sphere"; `retraction`, the
    retraction of SO(3).

    **Source:** Routh, *Advanced Rigid Dynamics*; Borisov, Mamaev and Kilin, *The
    rolling motion of a ball on a surface* (2002); Dalla Via, Fassò and Sansonetto, *On
    the dynamics of a heavy symmetric ball that rolls without sliding on a uniformly
    rotating surface of revolution*, arXiv:2109.00236.

    !!! example

        >>> from nhjax.systems import BallInBowl
        >>> ball = BallInBowl.rolling((0.5, 0.0), (0.0, 1.2), shape="sphere")
        >>> system, y0 = ball.system, ball.initial_state()
        >>> round(float(y0.multiplier[2]), 3)
        10.737
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    radius: Array = eqx.field(converter=parameter, default=0.1)
    inertia_ratio: Array = eqx.field(converter=parameter, default=0.4)
    curvature: Array = eqx.field(converter=parameter, default=1.5)
    rate: Array = eqx.field(converter=parameter, default=1.0)
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    shape: Shape = eqx.field(static=True, default="paraboloid", kw_only=True)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Element = eqx.field(
        converter=pair,
        default=((1.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.1875)),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(1.3, 2.5, 1.6, 0.2, 0.36, 0.15),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_positive(
            mass=self.mass,
            radius=self.radius,
            inertia_ratio=self.inertia_ratio,
            gravity=self.gravity,
        )
        require_not_negative(curvature=self.curvature)
        if self.shape not in ("paraboloid", "sphere"):
            raise ValueError(
                f'`shape` must be "paraboloid" or "sphere", got {self.shape!r}.'
            )

    @property
    def manifold(self) -> ProductGroup:
        """Return the group SO(3) x R³ with the retraction of the example."""
        return ProductGroup(SO3(self.retraction), Euclidean(3))

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian,
            nonholonomic=self.constraint,
            holonomic=self.holonomic,
            manifold=self.manifold,
        )

    @property
    def bowl(self) -> "Bowl":
        """Return the surface on which the centre of the ball moves."""
        return Bowl(self.curvature, self.shape)

    @classmethod
    def rolling(
        cls,
        position: tuple[float, float] | Array,
        velocity: tuple[float, float] | Array,
        spin: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "BallInBowl":
        """Create a rolling ball with its centre at `position` (x, y).

        `velocity` (ẋ, ẏ) is the velocity of the centre. `spin` is the component of the
        angular velocity along the normal n. `parameters` are the parameters of the
        class. In a sphere the ball is placed in the lower half.
        """
        ball = cls(**parameters)
        x, y = coordinates(position)
        centre = jnp.stack([x, y, ball.bowl.height(x**2 + y**2)])
        slope, normal = ball.bowl.slope(centre), ball.bowl.normal(centre)
        dx, dy = coordinates(velocity)
        moving = jnp.stack([dx, dy, -(slope[0] * dx + slope[1] * dy) / slope[2]])
        drag = ball.rate * _about_axis(centre - ball.radius * normal) - moving
        omega = parameter(spin) * normal + jnp.cross(drag, normal) / ball.radius
        q0 = (ball.q0[0], centre)
        v0 = jnp.concatenate([SO3().Ad_dual(ball.q0[0], omega), moving])
        return cls(**(parameters | {"q0": q0, "v0": v0}))

    @classmethod
    def circling(
        cls, radius_of_path: ArrayLike, path_rate: ArrayLike, **parameters: Any
    ) -> "BallInBowl":
        """Create a ball that moves steadily on a horizontal circle about the axis.

        The centre of the ball moves on a circle of radius `radius_of_path` [m] at the
        rate `path_rate` [1/s]; the balance of moments determines the spin. `parameters`
        are the parameters of the class.
        """
        path, rate = parameter(radius_of_path), parameter(path_rate)
        require_positive(radius_of_path=path)
        require_possible(
            rate != 0, "`path_rate` must be nonzero: nothing determines the spin."
        )
        place = jnp.stack([path, jnp.zeros_like(path)])
        velocity = jnp.stack([jnp.zeros_like(path), rate * path])
        ball = cls.rolling(place, velocity, **parameters)
        require_possible(
            ball.curvature != 0,
            "`curvature` must be nonzero: nothing determines the spin.",
        )
        return cls.rolling(place, velocity, _steady_spin(ball, rate), **parameters)

    def lagrangian(self, t: FloatScalarLike, q: Element, v: Array, args: Args) -> Array:
        """Compute the Lagrangian ℓ = m/2 |ẋ|² + k m a²/2 |ω|² - m g z."""
        rotation = self.inertia_ratio * self.radius**2 * (v[:3] @ v[:3])
        kinetic = 0.5 * self.mass * (v[3:] @ v[3:] + rotation)
        return kinetic - self.mass * self.gravity * q[1][2]

    def constraint(self, t: FloatScalarLike, q: Element, v: Array, args: Args) -> Array:
        """Compute the constraints φ: the horizontal velocity of slip at the contact."""
        arm = -self.radius * self.bowl.normal(q[1])
        surface = self.rate * _about_axis(q[1] + arm)
        return (v[3:] + jnp.cross(SO3().Ad(q[0], v[:3]), arm) - surface)[:2]

    def holonomic(self, t: FloatScalarLike, q: Element, args: Args) -> Array:
        """Compute the constraint Φ = z - κ/2 (x² + y² + ε z²)."""
        return self.bowl.value(q[1])

    def invariants(self, t: FloatScalarLike, q: Element, v: Array) -> dict[str, Array]:
        """Compute the moving energy, and in a sphere two more conserved quantities.

        These are `normal_spin` = κ a (R ω)·n - Ω (1 + κ a) n₃ and `vertical_momentum` =
        k m a² (R ω)₃ - κ a m (x ẏ - y ẋ).
        """
        omega, normal = SO3().Ad(q[0], v[:3]), self.bowl.normal(q[1])
        spin = self.inertia_ratio * self.mass * self.radius**2 * omega[2]
        orbital = self.mass * (q[1][0] * v[4] - q[1][1] * v[3])
        moving = self.energy(t, q, v) - self.rate * (orbital + spin)
        if self.shape == "paraboloid":
            return {"moving_energy": moving}
        ratio = self.curvature * self.radius
        return {
            "moving_energy": moving,
            "normal_spin": ratio * (omega @ normal)
            - self.rate * (1 + ratio) * normal[2],
            "vertical_momentum": spin - ratio * orbital,
        }

    def points(self, t: FloatScalarLike, q: Element) -> dict[str, Array]:
        """Compute the positions of the centre, contact and pole of the ball [m].

        The pole is where the third body axis leaves the ball.
        """
        axis = jnp.zeros_like(q[1]).at[2].set(self.radius)
        return {
            "centre": q[1],
            "contact": q[1] - self.radius * self.bowl.normal(q[1]),
            "pole": q[1] + SO3().Ad(q[0], axis),
        }


def _steady_spin(ball: BallInBowl, rate: Array) -> Array:
    """Compute the spin that keeps a moving ball on its circle.

    On the circle, ω turns about the vertical at the given rate, so that ω' is along the
    path. The balance of moments about the centre, I ω' = -a n × F with the force F of
    the bowl, therefore determines the radial component of ω. `ball` is on the first
    axis and has no spin; the spin must supply the missing part of this component.
    """
    normal, path = ball.bowl.normal(ball.q0[1]), ball.q0[1][0]
    moment = normal[0] * ball.gravity + normal[2] * rate**2 * path
    across = moment / (ball.inertia_ratio * ball.radius * rate)
    return (across - SO3().Ad(ball.q0[0], ball.v0[:3])[0]) / normal[0]


def _about_axis(x: Vector3) -> Vector3:
    """Compute e₃ × x."""
    return jnp.stack([-x[1], x[0], jnp.zeros_like(x[0])])


class Bowl(eqx.Module):
    """A paraboloid or a sphere of revolution, with its lowest point at the origin.

    Φ = z - κ/2 (x² + y² + ε z²) with the curvature κ at the lowest point, and ε = 0 for
    the paraboloid, 1 for the sphere.
    """

    curvature: Array
    shape: Shape = eqx.field(static=True)

    def value(self, x: Vector3) -> Array:
        """Compute the function Φ at a point; Φ is zero on the surface."""
        round_part = x if self.shape == "sphere" else x[:2]
        return x[2] - 0.5 * self.curvature * (round_part @ round_part)

    def slope(self, x: Vector3) -> Vector3:
        """Compute the gradient ∇Φ at a point."""
        inward = -self.curvature * x
        if self.shape == "paraboloid":
            inward = inward.at[2].set(0.0)
        return inward.at[2].add(1.0)

    def normal(self, x: Vector3) -> Vector3:
        """Compute the normal ∇Φ/|∇Φ| at a point; this vector points into the bowl."""
        slope = self.slope(x)
        return slope / jnp.sqrt(slope @ slope)

    def height(self, square: Array) -> Array:
        """Compute z where Φ = 0 and x² + y² = `square`, in the lower half."""
        if self.shape == "paraboloid":
            return 0.5 * self.curvature * square
        root = 1 - self.curvature**2 * square
        require_possible(
            root > 0,
            "`position` must be nearer to the axis than the radius "
            f"{1 / self.curvature} of the sphere, got {jnp.sqrt(square)}.",
        )
        return self.curvature * square / (1 + jnp.sqrt(root))
