"""The place that a run with events has come to."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import FloatScalar
from ._sides import Sides


class Progress(eqx.Module):
    """The place that a run with events has come to.

    Derivatives pass through `offset` alone.

    - `node`, `offset`: the time is t_k + offset with k = `node`.
    - `row`: how many rows of output are filled. It is `node` until the run ends, and
        goes on after that.
    - `active`: how many iterations have led to a node or to an event.
    - `num`, `last`: how many events there were, and which the last one was.
    - `is_cut`: whether the next step is to be cut, since there is an event in it.
    - `far`: the conditions at the end of the whole step, if so.
    - `sides`: the sides of zero of the conditions.
    - `pending`: the conditions that the last reset has carried across zero.
    """

    node: Int[Array, ""]
    offset: FloatScalar
    row: Int[Array, ""]
    active: Int[Array, ""]
    num: Int[Array, ""]
    last: Int[Array, ""]
    is_cut: Bool[Array, ""]
    far: Float[Array, " e"]
    sides: Sides
    pending: Bool[Array, " e"]


class Known(NamedTuple):
    """What a step back knows of the iteration: its event, -1 if none, and its size."""

    which: Int[Array, ""]
    size: FloatScalar
