"""The double pendulum in Cartesian coordinates."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    parameter,
    require_positive,
    require_shape,
)


class DoublePendulum(AbstractExample):
    """Two point masses on two rods in a vertical plane, with two holonomic constraints.

    L = m₁/2 |ṙ₁|² + m₂/2 |ṙ₂|² - m₁ g y₁ - m₂ g y₂,
    Φ = (|r₁|² - l₁², |r₂ - r₁|² - l₂²),  q = (x₁, y₁, x₂, y₂), y upwards.

    At large angles the motion is chaotic.

    **Parameters:** `masses` (m₁, m₂) [kg], `lengths` (l₁, l₂) [m], `gravity` g [m/s²].

    **Source:** Landau and Lifshitz, *Mechanics*, section 5; Hairer, Lubich and Wanner,
    *Geometric Numerical Integration*, section VII.1, for the formulation.

    !!! example

        >>> from nhjax.systems import DoublePendulum
        >>> pendulum = DoublePendulum.swinging(angles=(0.5, -0.3), lengths=(1.0, 0.7))
        >>> y0 = pendulum.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [-0.579, -0.288]
    """

    masses: Array = eqx.field(converter=coordinates, default=(1.0, 1.0))
    lengths: Array = eqx.field(converter=coordinates, default=(1.0, 1.0))
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(
        converter=coordinates, default=(0.6, -0.8, 1.4, -1.4), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(0.4, 0.3, 0.1, -0.1), kw_only=True
    )

    def __check_init__(self) -> None:
        require_shape((2,), masses=self.masses, lengths=self.lengths)
        require_positive(masses=self.masses, lengths=self.lengths)

    @classmethod
    def swinging(
        cls,
        angles: ArrayLike | tuple[float, float],
        rates: ArrayLike | tuple[float, float] = (0.0, 0.0),
        *,
        masses: ArrayLike | tuple[float, float] = (1.0, 1.0),
        lengths: ArrayLike | tuple[float, float] = (1.0, 1.0),
        gravity: ArrayLike = 1.0,
    ) -> "DoublePendulum":
        """Create a pendulum whose rods form `angles` with the downward vertical."""
        angle, rate = coordinates(angles), coordinates(rates)
        length = coordinates(lengths)
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        rods = length[:, None] * jnp.stack([sin, -cos], axis=1)
        swings = (length * rate)[:, None] * jnp.stack([cos, sin], axis=1)
        q0, v0 = jnp.cumsum(rods, axis=0), jnp.cumsum(swings, axis=0)
        return cls(masses, length, gravity, q0=q0.reshape(4), v0=v0.reshape(4))

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, holonomic=self.holonomic)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m₁/2 |ṙ₁|² + m₂/2 |ṙ₂|² - m₁ g y₁ - m₂ g y₂."""
        masses = self.masses.astype(v.dtype)
        kinetic = 0.5 * (masses @ jnp.sum(v.reshape(2, 2) ** 2, axis=1))
        return kinetic - self.gravity * (masses @ q[1::2])

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ = (|r₁|² - l₁², |r₂ - r₁|² - l₂²)."""
        first, second = q[:2], q[2:] - q[:2]
        squares = jnp.stack([first @ first, second @ second])
        return squares - self.lengths.astype(q.dtype) ** 2

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}
