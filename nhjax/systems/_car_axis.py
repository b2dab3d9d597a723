"""The car axis on a bumpy road."""

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
    require_possible,
    require_shape,
)


class CarAxis(AbstractExample):
    """An axle on two springs over two wheels; the right wheel is on a bumpy road.

    L = ε²M/4 (|ṙ_l|² + |ṙ_r|²) - ½ (|r_l| - l₀)² - ½ (|r_r - b| - l₀)²
    - ε²Mg/2 (y_l + y_r),

    Φ = (b · r_l, |r_l - r_r|² - l²),  b(t) = (√(l² - y_b²), y_b),  y_b = r sin ωt.

    Here q = (x_l, y_l, x_r, y_r) [m]: the positions r_l and r_r of the ends of the
    axle. Each end has half of the mass of the chassis. The left wheel stays at the
    origin, and the right wheel is at b. Both constraints are holonomic. The first
    depends on time, and keeps the left spring perpendicular to the line through the
    wheels. The stiffness of the springs is 1/ε², and L is multiplied by ε².

    **Parameters:** `mass` M [kg] of the chassis; `epsilon` ε, whose inverse square is
    the stiffness of the springs; `length` l of the axle, `rest_length` l₀ of the
    springs, `amplitude` r of the road [m]; `rate` ω of the bumps [1/s]; `gravity` g
    [m/s²].

    **Source:** Schneider, *Integration mechanischer Mehrkörpersysteme*, TU Munich
    (1994); Mazzia and Magherini, *Test Set for Initial Value Problem Solvers* (2008),
    problem "caraxis".

    !!! example

        >>> from nhjax.systems import CarAxis
        >>> axis = CarAxis.level(amplitude=0.05)
        >>> system, y0 = axis.system, axis.initial_state()
        >>> [round(x, 3) for x in y0.v.tolist()]
        [-0.25, 0.0, -0.25, 0.0]
    """

    mass: Array = eqx.field(converter=parameter, default=10.0)
    epsilon: Array = eqx.field(converter=parameter, default=1e-2)
    length: Array = eqx.field(converter=parameter, default=1.0)
    rest_length: Array = eqx.field(converter=parameter, default=0.5)
    amplitude: Array = eqx.field(converter=parameter, default=0.1)
    rate: Array = eqx.field(converter=parameter, default=10.0)
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(
        converter=coordinates, default=(0.0, 0.5, 1.0, 0.5), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(-0.5, 0.0, -0.5, 0.0), kw_only=True
    )

    def __check_init__(self) -> None:
        require_positive(
            mass=self.mass,
            epsilon=self.epsilon,
            length=self.length,
            rest_length=self.rest_length,
        )
        require_shape((4,), q0=self.q0, v0=self.v0)
        amplitude, length = self.amplitude, self.length
        require_possible(
            abs(amplitude) < length,
            f"`amplitude` must be less than `length` {length}, got {amplitude}.",
        )

    @classmethod
    def level(cls, **parameters: ArrayLike) -> "CarAxis":
        """Create a level axle on springs at their rest length, as in the source.

        The axle moves sideways, with the velocity that the first constraint requires at
        t = 0. `parameters` are the parameters of the class.
        """
        axis = cls(**parameters)
        height, zero = axis.rest_length, jnp.zeros_like(axis.rest_length)
        speed = -axis.amplitude * axis.rate * height / axis.length
        q0 = jnp.stack([zero, height, axis.length, height])
        return cls(**parameters, q0=q0, v0=jnp.stack([speed, zero, speed, zero]))

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, holonomic=self.holonomic)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, kinetic minus potential energy, times ε²."""
        mass = 0.5 * self.epsilon**2 * self.mass
        left, right = q[:2], q[2:] - self._wheel(t, q)
        stretches = jnp.stack([left @ left, right @ right])
        stretches = jnp.sqrt(stretches) - self.rest_length
        kinetic = 0.5 * mass * (v @ v)
        return (
            kinetic - 0.5 * stretches @ stretches - mass * self.gravity * (q[1] + q[3])
        )

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ = (b · r_l, |r_l - r_r|² - l²)."""
        axle = q[:2] - q[2:]
        return jnp.stack([self._wheel(t, q) @ q[:2], axle @ axle - self.length**2])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Return an empty dictionary: the road does work on the system."""
        return {}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of both wheels and both axle ends, each of shape (2,)."""
        wheel = self._wheel(t, q)
        wheels = {"left_wheel": jnp.zeros_like(wheel), "right_wheel": wheel}
        return wheels | {"left_end": q[:2], "right_end": q[2:]}

    def _wheel(self, t: FloatScalarLike, q: Array) -> Array:
        """Compute the place b of the right wheel."""
        height = self.amplitude * jnp.sin(self.rate * jnp.asarray(t, q.dtype))
        return jnp.stack([jnp.sqrt(self.length**2 - height**2), height])
