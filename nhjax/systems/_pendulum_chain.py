"""A chain of pendula in Cartesian coordinates."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    parameter,
    require_positive,
    require_shape,
)


class PendulumChain(AbstractExample):
    """Point masses on rods in a vertical plane; each rod hangs from the previous mass.

    L = Σ m_k (½ |ṙ_k|² - g y_k),  Φ_k = |r_k - r_{k-1}|² - l_k²,  k = 1, ..., n.

    Here q = (x₁, y₁, ..., x_n, y_n) [m], y upwards, and the pivot is r₀ = 0. There are
    n holonomic constraints on 2n coordinates. A chain with many links is a discrete
    rope.

    **Parameters:** `num_links` n, static; `masses` m_k [kg] and `lengths` l_k [m], each
    one number for all links or an array of shape (n,); `gravity` g [m/s²]. By default
    all rods lie on one line, at half a radian from the vertical and at rest.

    **Source:** Daniel Bernoulli (1738); Hairer, Lubich and Wanner, *Geometric Numerical
    Integration*, section VII.1, for the formulation. With two links the chain is
    the `DoublePendulum`.

    !!! example

        >>> from nhjax.systems import PendulumChain
        >>> chain = PendulumChain.swinging(angles=(0.5, -0.3, 1.0), gravity=9.81)
        >>> system, y0 = chain.system, PendulumChain(num_links=5).initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [-21.523, -17.218, -12.914, -8.609, -4.305]
    """

    num_links: int = eqx.field(static=True)
    masses: Float[Array, " n"]
    lengths: Float[Array, " n"]
    gravity: Float[Array, ""]
    q0: Float[Array, " 2*n"]
    v0: Float[Array, " 2*n"]

    def __init__(
        self,
        num_links: int = 3,
        masses: ArrayLike | tuple[float, ...] = 1.0,
        lengths: ArrayLike | tuple[float, ...] = 1.0,
        gravity: ArrayLike = 9.81,
        *,
        q0: ArrayLike | tuple[float, ...] | None = None,
        v0: ArrayLike | tuple[float, ...] | None = None,
    ):
        if num_links < 1:
            raise ValueError(f"`num_links` must be at least 1, got {num_links}.")
        self.num_links = num_links
        self.masses = _one_each(num_links, "masses", masses)
        self.lengths = _one_each(num_links, "lengths", lengths)
        self.gravity = parameter(gravity)
        reach = jnp.cumsum(self.lengths)
        line = jnp.stack([math.sin(0.5) * reach, -math.cos(0.5) * reach], axis=1)
        self.q0 = line.reshape(-1) if q0 is None else coordinates(q0)
        self.v0 = jnp.zeros_like(self.q0) if v0 is None else coordinates(v0)

    def __check_init__(self) -> None:
        require_positive(masses=self.masses, lengths=self.lengths)
        require_shape((2 * self.num_links,), q0=self.q0, v0=self.v0)

    @classmethod
    def swinging(
        cls,
        angles: ArrayLike | tuple[float, ...],
        rates: ArrayLike | tuple[float, ...] = 0.0,
        *,
        masses: ArrayLike | tuple[float, ...] = 1.0,
        lengths: ArrayLike | tuple[float, ...] = 1.0,
        gravity: ArrayLike = 9.81,
    ) -> "PendulumChain":
        """Create a chain whose rods form `angles` with the downward vertical."""
        angle = jnp.atleast_1d(coordinates(angles))
        rate = _one_each(angle.size, "rates", rates)
        length = _one_each(angle.size, "lengths", lengths)
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        rods = length[:, None] * jnp.stack([sin, -cos], axis=1)
        swings = (length * rate)[:, None] * jnp.stack([cos, sin], axis=1)
        q0, v0 = jnp.cumsum(rods, axis=0), jnp.cumsum(swings, axis=0)
        return cls(
            angle.size, masses, length, gravity, q0=q0.reshape(-1), v0=v0.reshape(-1)
        )

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, holonomic=self.holonomic)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = Σ m_k (½ |ṙ_k|² - g y_k)."""
        masses = self.masses.astype(v.dtype)
        kinetic = 0.5 * (masses @ jnp.sum(v.reshape(-1, 2) ** 2, axis=1))
        return kinetic - self.gravity * (masses @ q[1::2])

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ_k = |r_k - r_{k-1}|² - l_k²."""
        places = q.reshape(-1, 2)
        rods = jnp.diff(places, axis=0, prepend=jnp.zeros_like(places[:1]))
        return jnp.sum(rods**2, axis=1) - self.lengths.astype(q.dtype) ** 2

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of the pivot and of all masses, each of shape (2,)."""
        places = q.reshape(-1, 2)
        masses = {f"mass_{k + 1}": places[k] for k in range(self.num_links)}
        return {"pivot": jnp.zeros_like(places[0])} | masses


def _one_each(number: int, name: str, value: ArrayLike | tuple[float, ...]) -> Array:
    """Convert one value for all links, or an array, to one value for each link."""
    array = coordinates(value)
    if array.shape == ():
        return jnp.full((number,), array)
    require_shape((number,), **{name: array})
    return array
