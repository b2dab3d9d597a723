"""The members that have failed."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._results import RESULTS
from ._outcome import EnsembleOutcome
from ._verdict import is_good


class Failed:
    """The list of failed members, as (index, step, code), in the order of chunks."""

    def __init__(self, rows: list[list[int]] | None = None):
        self.rows = [] if rows is None else rows

    def add(self, rows: list[list[int]]) -> None:
        """Append the failed members of a chunk to the table."""
        self.rows += rows

    def to_bytes(self) -> bytes:
        """Write the rows as integers of 64 bits."""
        return np.array(self.rows, np.int64).tobytes()

    def add_bytes(self, data: bytes) -> None:
        """Append rows that `to_bytes` has written."""
        self.rows += np.frombuffer(data, np.int64).reshape(-1, 3).tolist()

    def outcome(self, count: int, **parts: Any) -> EnsembleOutcome:
        """Make the outcome of an ensemble, without what is not given."""
        table = np.array(sorted(self.rows), np.int64).reshape(-1, 3)
        codes = jnp.asarray(table[:, 2].astype(np.int32))
        made = {"values": None, "statistics": None, "path": None} | parts
        return EnsembleOutcome(
            num_members=count,
            failed=table[:, 0],
            failed_step=table[:, 1],
            failed_result=eqx.tree_at(
                lambda result: result._value, RESULTS.successful, codes
            ),
            **made,
        )


def failed_rows(start: int, codes: np.ndarray, steps: np.ndarray) -> list[list[int]]:
    """List the members of a chunk that failed; `start` is the index of the first."""
    bad = np.flatnonzero(~is_good(codes))
    return [[int(start + i), int(steps[i]), int(codes[i])] for i in bad]
