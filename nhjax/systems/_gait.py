"""Joints that move as given functions of time, which machines propel themselves by."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._base import coordinates


class Sinusoid(eqx.Module):
    """Joint angles a sin(ωt + β), one or an array of them, as a function of time."""

    amplitude: Array = eqx.field(converter=coordinates)
    rate: Array = eqx.field(converter=coordinates)
    phase: Array = eqx.field(converter=coordinates)

    def __call__(self, t: Array) -> Array:
        """Compute the angles at `t`, in its precision."""
        amplitude, rate, phase = jax.tree.map(
            lambda x: x.astype(t.dtype), (self.amplitude, self.rate, self.phase)
        )
        return amplitude * jnp.sin(rate * t + phase)
