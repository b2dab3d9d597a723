"""The rattleback, or Celtic stone, which reverses its spin."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from .._system import LagrangianSystem
from ._base import (
    coordinates,
    parameter,
    require_not_negative,
    require_positive,
    require_possible,
    require_shape,
)
from ._rolling_body import AbstractRollingBody


class Rattleback(AbstractRollingBody):
    """A stone, an ellipsoid with skew axes of inertia, that rolls on a plane.

    ℓ = m/2 |v|² + ½ ω·(J ω) - m g z,  Φ = z + e₃·(R s),  φ = (R (v + ω × s))₁₂,
    s = h e₃ - A γ / √(γ·(A γ)),  A = diag(a², b², c²),  γ = Rᵀ e₃.

    Here q = (R, x): the attitude quaternion and the position of the centre of mass [m];
    v and ω are the linear and angular velocity in body axes [m/s, 1/s]. The body axes
    are the axes of the ellipsoid; at rest, the third axis points upward. The vector
    from the centre of mass to the lowest point is s. Φ is the height of this point, and
    φ the horizontal velocity there. The multipliers are the components, along the axes
    of space, of the force that the plane exerts on the body [N]. e₃ is (0, 0, 1), and γ
    the upward vertical in body axes. The third axis is a principal axis of inertia, but
    the other two axes are not. Therefore a spin in one sense turns into rocking, and
    the rocking into a spin in the other sense.

    With `damping` σ the air exerts the torque -σω, and energy is not conserved.

    **Parameters:** `mass` m [kg]; `semiaxes` (a, b, c) of the ellipsoid and `depth` h
    of the centre of mass below the centre of the ellipsoid [m]; `moments` (J₁₁, J₂₂,
    J₃₃) and `product` J₁₂ of inertia about the centre of mass [kg m²]; `gravity` g
    [m/s²]; `damping` σ [N m s] or None; `retraction`, the retraction of SE(3).

    **Source:** Kane and Levinson, *Realistic mathematical modeling of the rattleback*,
    International Journal of Non-Linear Mechanics 17 (1982), whose parameters are the
    default. Kane and Levinson's third axis points downward, so that their product D is
    -J₁₂. Their σ is 1e-4.

    !!! example

        >>> from nhjax.systems import Rattleback
        >>> stone = Rattleback.spinning(5.0, (0.5, 0.5), damping=1e-4)
        >>> system, y0 = stone.system, stone.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [0.453, 0.378, 8.305]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    semiaxes: Array = eqx.field(converter=coordinates, default=(0.2, 0.03, 0.02))
    depth: Array = eqx.field(converter=parameter, default=0.01)
    moments: Array = eqx.field(converter=coordinates, default=(2e-4, 1.6e-3, 1.7e-3))
    product: Array = eqx.field(converter=parameter, default=2e-5)
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    damping: Array | None = eqx.field(
        converter=lambda x: None if x is None else parameter(x), default=None
    )
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(0.002, -0.001, 0.0, 0.1, 0.2, 5.0),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_shape((3,), semiaxes=self.semiaxes, moments=self.moments)
        require_positive(
            mass=self.mass,
            semiaxes=self.semiaxes,
            moments=self.moments,
            gravity=self.gravity,
        )
        if self.damping is not None:
            require_not_negative(damping=self.damping)
        require_possible(
            self.product**2 < self.moments[0] * self.moments[1],
            "`product` must be smaller than the geometric mean of its `moments`, "
            f"√(J₁₁ J₂₂), got {self.product}.",
        )
        principal = jnp.linalg.eigvalsh(self.inertia)
        require_possible(
            principal[2] <= principal[0] + principal[1],
            "No body has `moments` and `product` of inertia of which the largest "
            f"principal one exceeds the sum of the others, got {principal}.",
        )

    @classmethod
    def spinning(
        cls,
        spin: ArrayLike,
        tilts: tuple[float, float] | Array = (0.0, 0.0),
        **parameters: Any,
    ) -> "Rattleback":
        """Create a stone that spins at the rate ω₃ = `spin` about its own third axis.

        `tilts` are the angles (α, β) of Kane and Levinson in degrees: the stone is
        turned about its first axis, which is horizontal, by α, and then about its
        second axis by -β. `parameters` are the parameters of the class.
        """
        lean, pitch = 0.5 * jnp.deg2rad(coordinates(tilts))
        zero = jnp.zeros_like(lean)
        first = jnp.stack([jnp.cos(lean), jnp.sin(lean), zero, zero])
        second = jnp.stack([jnp.cos(pitch), zero, -jnp.sin(pitch), zero])
        omega = jnp.stack([zero, zero, jnp.asarray(spin, lean.dtype)])
        return cls(**parameters).rolling(SO3().compose(first, second), omega)

    @property
    def weight(self) -> Array:
        """Return the weight m g."""
        return self.mass * self.gravity

    @property
    def inertia(self) -> Float[Array, "3 3"]:
        """Return the matrix J of inertia about the centre of mass, in body axes."""
        principal = jnp.diag(self.moments)
        return principal.at[0, 1].set(self.product).at[1, 0].set(self.product)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian,
            nonholonomic=self.constraint,
            holonomic=self.holonomic,
            force=None if self.damping is None else self.force,
            manifold=self.manifold,
        )

    def lowest_point(self, up: Array) -> Array:
        """Compute s = h e₃ - A γ / √(γ·(A γ)), where γ is `up`, in body axes."""
        scaled = self.semiaxes.astype(up.dtype) ** 2 * up
        return (-scaled / jnp.sqrt(up @ scaled)).at[2].add(self.depth)

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the generalised force (0, -σω), with the torque -σω of the air."""
        damping = 0.0 if self.damping is None else self.damping
        return jnp.concatenate([jnp.zeros_like(v[:3]), -damping * v[3:]])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved quantities: the energy, or none with damping."""
        if self.damping is not None:
            return {}
        return {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the positions of the centre of mass, contact and both ends [m]."""
        middle = jnp.zeros_like(q[4:]).at[2].set(self.depth)
        tip = jnp.zeros_like(middle).at[0].set(self.semiaxes[0].astype(q.dtype))
        return {
            "centre_of_mass": q[4:],
            "contact": self.contact_point(q),
            "front": q[4:] + SO3().Ad(q[:4], middle + tip),
            "back": q[4:] + SO3().Ad(q[:4], middle - tip),
        }
