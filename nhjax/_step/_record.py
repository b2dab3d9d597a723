import equinox as eqx
from jaxtyping import Array, Float

from .._system import State


class StepRecord(eqx.Module):
    """The collocation data of one step: all that dense output needs."""

    start: State
    velocity: Float[Array, "s n"]
    force: Float[Array, "s n"]
    multiplier: Float[Array, "s m"]
