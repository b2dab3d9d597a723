import equinox as eqx
from jaxtyping import Array, Float

from .._system import State


class StepRecord(eqx.Module):
    """The data of one step that dense output needs to make its polynomials.

    - `start`: the state at the start of the step.
    - `velocity`, `force`, `multiplier`: the values at the s stages.
    """

    start: State
    velocity: Float[Array, "s n"]
    force: Float[Array, "s n"]
    multiplier: Float[Array, "s m"]
