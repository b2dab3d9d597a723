"""The function `initial_state`, which makes consistent initial states."""

from ._initial_state import (
    checked_inputs as checked_inputs,
    initial_state as initial_state,
)
