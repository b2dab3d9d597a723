"""Consistent initial states."""

from ._initial_state import initial_state as initial_state
