"""The function `initial_state`, which makes consistent initial states."""

from ._initial_state import initial_state as initial_state
