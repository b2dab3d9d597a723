"""The free rigid body."""

import math
from collections.abc import Callable

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SO3
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    on_host,
    require_positive,
    require_shape,
)
from ._linear_flow import attitude


class FreeRigidBody(AbstractExample):
    """A rigid body that turns freely about its centre of mass, on SO(3).

    ℓ = ½ (I₁ω₁² + I₂ω₂² + I₃ω₃²).

    Here q is the attitude quaternion, and ω is the body angular velocity along the
    principal axes.

    **Parameters:** `moments` (I₁, I₂, I₃), the principal moments of inertia [kg m²];
    `retraction`, the retraction of SO(3).

    **Source:** Euler; Landau and Lifshitz, *Mechanics*, section 37.

    !!! example

        >>> from nhjax.systems import FreeRigidBody
        >>> body = FreeRigidBody(moments=(1.0, 1.0, 2.0))
        >>> y0, (q, v, _) = body.initial_state(), body.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.862, 0.031, 0.437, 0.256]
    """

    moments: Array = eqx.field(converter=coordinates, default=(1.0, 2.0, 2.5))
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(
        converter=coordinates, default=(1.0, 0.0, 0.0, 0.0), kw_only=True
    )
    v0: Array = eqx.field(converter=coordinates, default=(0.3, 0.9, 0.5), kw_only=True)

    def __check_init__(self) -> None:
        require_shape((3,), moments=self.moments)
        require_positive(moments=self.moments)

    @property
    def manifold(self) -> SO3:
        """Return the group SO(3) with the retraction of the example."""
        return SO3(self.retraction)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, manifold=self.manifold)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian ℓ = ½ (I₁ω₁² + I₂ω₂² + I₃ω₃²)."""
        return 0.5 * (self.moments.astype(v.dtype) @ v**2)

    def spatial_momentum(self, q: Array, v: Array) -> Array:
        """Compute the angular momentum in space, R Iω."""
        return self.manifold.Ad(q, self.moments.astype(v.dtype) * v)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, and the spatial angular momentum."""
        x, y, z = self.spatial_momentum(q, v)
        return {
            "energy": self.energy(t, q, v),
            "spatial_momentum_x": x,
            "spatial_momentum_y": y,
            "spatial_momentum_z": z,
        }

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at time `t`; λ is empty, because there are no constraints.

        ω is given by Jacobi's elliptic functions. The attitude then satisfies a linear
        differential equation, which is solved to round-off.
        """
        quaternion, omega0, moments = on_host((self.q0, self.v0, self.moments))
        angular_velocity, rate = _euler_solution(moments, omega0)
        return (
            attitude(quaternion, angular_velocity, t, rate),
            angular_velocity(np.asarray(t)),
            np.zeros(0),
        )


def _euler_solution(
    moments: np.ndarray, omega0: np.ndarray
) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Find the solution ω(t) of Euler's equations, and a bound on its rate.

    The bound holds for |ω| and for the inverse of the time scale of ω. The caller
    passes it to `attitude` as `rate`.

    Let 2 be the principal axis with the middle moment, and 3 the principal axis around
    which ω moves in the body; axis 3 has the largest or the smallest moment. Then ω₁,
    ω₂, ω₃ are multiples of cn, sn, dn.
    """
    size = float(np.linalg.norm(omega0))
    gaps = np.roll(moments, -1) - np.roll(moments, 1)
    if not np.any(gaps * np.roll(omega0, -1) * np.roll(omega0, 1)):
        return lambda times: np.multiply.outer(omega0, np.ones_like(times)), size
    one, two, three = order = _cn_sn_dn_axes(moments, omega0)
    (I1, I2, I3), (w1, w2, w3) = moments[order], omega0[order]
    ratio21 = I2 * (I2 - I3) / (I1 * (I1 - I3))
    ratio23 = I2 * (I2 - I1) / (I3 * (I3 - I1))
    amplitude1 = math.sqrt(w1**2 + ratio21 * w2**2)
    amplitude2 = amplitude1 / math.sqrt(ratio21)
    amplitude3 = math.sqrt(w3**2 + ratio23 * w2**2)
    sigma = math.sqrt((I3 - I2) * (I3 - I1) / (I1 * I2)) * amplitude3
    modulus = min(ratio23 * (amplitude2 / amplitude3) ** 2, 1.0)
    # cn and dn start non-negative, so that their factors have the signs of w1 and w3.
    # The sign of the factor of sn follows from Euler's equations.
    side1, side3 = math.copysign(1.0, w1), math.copysign(1.0, w3)
    parity = 1.0 if (two - one) % 3 == 1 else -1.0
    side2 = parity * side1 * side3 * math.copysign(1.0, I3 - I1)
    phase = math.atan2(side2 * w2 * math.sqrt(ratio21), side1 * w1)
    start = scipy.special.ellipkinc(phase, modulus)

    def angular_velocity(times):
        sn, cn, dn, _ = scipy.special.ellipj(sigma * times + start, modulus)
        omega = np.empty((3, *np.shape(times)))
        omega[one] = side1 * amplitude1 * cn
        omega[two] = side2 * amplitude2 * sn
        omega[three] = side3 * amplitude3 * dn
        return omega

    return angular_velocity, size * math.sqrt(max(moments) / min(moments)) + sigma


def _cn_sn_dn_axes(moments: np.ndarray, omega0: np.ndarray) -> list[int]:
    """Find the axes along which ω is a multiple of cn, sn and dn, in this order."""
    low, middle, high = np.argsort(moments)
    # With the angular momentum L, the energy E and the middle moment I₂, the sign of
    # L² - 2E I₂ gives the side of the separatrix on which ω is.
    excess = moments * (moments - moments[middle]) * omega0**2
    around_high = excess[high] + excess[low] > 0
    if around_high:
        return [low, middle, high]
    return [high, middle, low]
