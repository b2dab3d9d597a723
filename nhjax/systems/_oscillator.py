"""The harmonic oscillator."""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import AbstractExample, coordinates, parameter, require_positive


class HarmonicOscillator(AbstractExample):
    """An isotropic harmonic oscillator in any dimension, without constraints.

    L = m/2 |v|² - k/2 |q|².

    Without constraints, a Lobatto IIIA-IIIB pair is an ordinary symplectic integrator.
    With m = k = 1, the two-stage method returns to the initial point after exactly N
    steps of h = 2 sin(π/N).

    **Parameters:** `mass` m [kg], `stiffness` k [N/m]; the shape of `q0` and `v0`
    sets the dimension.

    **Source:** any textbook.

    !!! example

        >>> from nhjax.systems import HarmonicOscillator
        >>> oscillator = HarmonicOscillator(stiffness=4.0)
        >>> y0, (q, v, _) = oscillator.initial_state(), oscillator.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [-0.189]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    stiffness: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(converter=coordinates, default=(1.0,), kw_only=True)
    v0: Array = eqx.field(converter=coordinates, default=(0.5,), kw_only=True)

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, stiffness=self.stiffness)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 |v|² - k/2 |q|²."""
        return 0.5 * self.mass * (v @ v) - 0.5 * self.stiffness * (q @ q)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at time `t`; λ is empty without constraints."""
        q0 = np.asarray(self.q0, dtype=np.float64)
        v0 = np.asarray(self.v0, dtype=np.float64)
        nu = math.sqrt(float(self.stiffness) / float(self.mass))
        cos, sin = math.cos(nu * t), math.sin(nu * t)
        return q0 * cos + v0 * sin / nu, v0 * cos - nu * q0 * sin, np.zeros(0)
