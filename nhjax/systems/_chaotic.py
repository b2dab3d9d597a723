"""A fully chaotic nonholonomic system."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, DTypeLike

from .._custom_types import Args, FloatScalarLike
from ._base import AbstractConstrainedExample, coordinates


class ChaoticSystem(AbstractConstrainedExample):
    """A chaotic system of n = 2m + 1 coupled oscillators, m >= 2.

    With indices that start at 1,

    L = ½ |v|² - ½ (|q|² + q²_{m+2} q²_{m+3} + Σ_{i=1..m} q²_{1+i} q²_{m+1+i}),
    Φ = v_1 + Σ_{i=m+2..n} q_i v_i, in dimensionless units.

    **Parameters:** `m`, static, which sets the number of coordinates. The defaults of
    `q0` and `v0` are the middle row of `ensemble`, with q_1 = v_2 = cos(π/4).

    **Source:** McLachlan and Perlmutter (2006) and Jay (2009), as in Martín de Diego
    and Sato Martín de Almagro, *High-order geometric methods for nonholonomic
    mechanical systems*, third numerical experiment.

    !!! example

        >>> import jax, nhjax
        >>> chaotic = nhjax.systems.ChaoticSystem(m=3)
        >>> q0, v0 = chaotic.ensemble(100)
        >>> start = lambda q, v: nhjax.initial_state(chaotic.system, q, v)
        >>> y0 = jax.vmap(start)(q0, v0)
        >>> y0.multiplier.shape
        (101, 1)
    """

    m: int = eqx.field(static=True)
    q0: Array
    v0: Array

    def __init__(
        self, m: int = 3, q0: ArrayLike | None = None, v0: ArrayLike | None = None
    ):
        if m < 2:
            raise ValueError(f"`m` must be at least 2, got {m}.")
        self.m = m
        middle_q, middle_v = self._member(np.array(0.25 * math.pi))
        self.q0 = coordinates(middle_q if q0 is None else q0)
        self.v0 = coordinates(middle_v if v0 is None else v0)
        for name, value in (("q0", self.q0), ("v0", self.v0)):
            if value.shape != (2 * m + 1,):
                raise ValueError(
                    f"`{name}` must have shape ({2 * m + 1},) for m = {m}, "
                    f"got {value.shape}."
                )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L(t, q, v).

        L = ½ |v|² - ½ (|q|² + q²_{m+2} q²_{m+3} + Σ q²_{1+i} q²_{m+1+i}).
        """
        squares = q**2
        first, second = squares[1 : self.m + 1], squares[self.m + 1 :]
        potential = jnp.sum(squares) + second[0] * second[1] + first @ second
        return 0.5 * (v @ v) - 0.5 * potential

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = v_1 + Σ_{i=m+2..n} q_i v_i."""
        return v[0] + q[self.m + 1 :] @ v[self.m + 1 :]

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def ensemble(
        self, members: int, dtype: DTypeLike | None = None
    ) -> tuple[Array, Array]:
        """Create initial data (q0, v0) of shape (J + 1, n), all with the same energy.

        `members` is the paper's J: row j = 0..J has q_1 = cos(jπ/2J) and
        v_2 = sin(jπ/2J). All rows have q_2..q_{m+1} = m/5..1/5, q_{m+2}..q_n = 1, and
        zero for the other velocities. For m = 3 these are the paper's data, with the
        energy 3.06.
        """
        if members < 1:
            raise ValueError(f"`members` must be at least 1, got {members}.")
        if dtype is None:
            dtype = jnp.result_type(float)
        angles = np.arange(members + 1) * (0.5 * math.pi / members)
        q0, v0 = self._member(angles)
        return jnp.asarray(q0, dtype), jnp.asarray(v0, dtype)

    def _member(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Create initial data at `angles` on the circle q_1² + v_2² = 1."""
        q = np.ones((*angles.shape, 2 * self.m + 1))
        q[..., 0] = np.cos(angles)
        q[..., 1 : self.m + 1] = np.arange(self.m, 0, -1) / 5
        v = np.zeros_like(q)
        v[..., 1] = np.sin(angles)
        return q, v
