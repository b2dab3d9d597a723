"""Suslov's problem."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from ._base import (
    AbstractConstrainedGroupExample,
    coordinates,
    require_positive,
    require_possible,
    require_shape,
)
from ._linear_flow import attitude
from ._sleigh import _sech as sech


class Suslov(AbstractConstrainedGroupExample):
    """A rigid body that cannot turn about an axis fixed in the body, on SO(3).

    ℓ = ½ ω·Iω,  φ = ω₃.

    Here q is the attitude quaternion, and ω is the body angular velocity. The body axes
    are chosen so that I₁₂ = 0. If the fixed axis, e₃, is not a principal axis, every
    motion tends to a steady rotation about an axis in the plane of e₁ and e₂, although
    energy is conserved.

    **Parameters:** `moments` (I₁₁, I₂₂, I₃₃) and `products` (I₁₃, I₂₃) of inertia
    [kg m²]; `retraction`, the retraction of SO(3).

    **Source:** Suslov (1902); Bloch, *Nonholonomic Mechanics and Control* (2003),
    chapter 8.

    !!! example

        >>> from nhjax.systems import Suslov
        >>> suslov = Suslov(products=(0.2, 0.1))
        >>> y0, (q, v, multiplier) = suslov.initial_state(), suslov.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.883, 0.157, 0.441, 0.006]
    """

    moments: Array = eqx.field(converter=coordinates, default=(1.0, 1.5, 2.0))
    products: Array = eqx.field(converter=coordinates, default=(0.3, -0.2))
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates, default=(1.0, 0.0, 0.0, 0.0), kw_only=True
    )
    v0: Array = eqx.field(converter=coordinates, default=(0.4, 0.9, 0.0), kw_only=True)

    def __check_init__(self) -> None:
        require_shape((3,), moments=self.moments)
        require_shape((2,), products=self.products)
        require_positive(moments=self.moments)
        # The determinant of the inertia matrix, divided by I₁₁ I₂₂.
        determinant = self.moments[2] - jnp.sum(self.products**2 / self.moments[:2])
        require_possible(
            determinant > 0,
            f"`products` are too large for `moments`, got {self.products} and "
            f"{self.moments}: the inertia matrix must be positive definite.",
        )

    @property
    def manifold(self) -> SO3:
        """Return the group SO(3) with the retraction of the example."""
        return SO3(self.retraction)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian ℓ = ½ ω·Iω."""
        products = self.products.astype(v.dtype) @ v[:2]
        return 0.5 * (self.moments.astype(v.dtype) @ v**2) + products * v[2]

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint φ = ω₃."""
        return v[2]

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent data and `products` != 0.

        With the energy E, let √I₁₁ ω₁ = √(2E) cos α and √I₂₂ ω₂ = √(2E) sin α. Then α
        satisfies α̇ = κ cos(α - α*) with constants κ and α*, so that the components of
        ω are combinations of tanh and sech. The attitude satisfies a linear
        differential equation, which is solved to round-off.
        """
        quaternion, v0 = self._consistent_data()
        I1, I2, _ = np.asarray(self.moments, dtype=np.float64)
        I13, I23 = np.asarray(self.products, dtype=np.float64)
        if I13 == I23 == 0:
            raise ValueError("`products` must not both be 0: the motion is steady.")
        root1, root2 = math.sqrt(I1), math.sqrt(I2)
        speed = math.hypot(root1 * v0[0], root2 * v0[1])
        kappa = speed * math.hypot(I13 / root1, I23 / root2) / (root1 * root2)
        attractor = math.atan2(I23 / root2, I13 / root1)
        beta = math.atan2(root2 * v0[1], root1 * v0[0]) - attractor
        # sin β = tanh τ and cos β = ±sech τ, with β = α - α* and τ = κt + c.
        side = math.copysign(1.0, math.cos(beta))
        start = math.asinh(side * math.tan(beta))

        def angular_velocity(times):
            tau = kappa * times + start
            alpha = attractor + np.arctan2(np.tanh(tau), side * sech(tau))
            omega1, omega2 = np.cos(alpha) / root1, np.sin(alpha) / root2
            return speed * np.stack([omega1, omega2, np.zeros_like(alpha)])

        decay = sech(kappa * t + start)
        omega = angular_velocity(np.float64(t))
        alpha_rate = kappa * side * decay
        # d/dt (√I₁ ω₁) = -α̇ √I₂ ω₂ and d/dt (√I₂ ω₂) = α̇ √I₁ ω₁.
        slope1 = -alpha_rate * root2 * omega[1] / root1
        slope2 = alpha_rate * root1 * omega[0] / root2
        multiplier = I13 * slope1 + I23 * slope2 - (I1 - I2) * omega[0] * omega[1]
        rate = kappa + speed / min(root1, root2)
        return (
            attitude(quaternion, angular_velocity, t, rate),
            omega,
            np.array([multiplier]),
        )
