"""One run of a ball-invariants study."""

import dataclasses

import numpy as np

from ._result import Timing
from ._table import largest_by_fifths


# Where the moving energy is round-off.
ENERGY_FLOOR = 4e-15


@dataclasses.dataclass(frozen=True)
class BallRun:
    """What is measured of one run, with an entry for every step.

    - `integrals`: shape (k + 1, 4), the three linear first integrals and the moving
        energy.
    - `positions`: (x, y), shape (k + 1, 2).
    - `circle_deviation`: the distance from the exact position at the final time that
        all step sizes have in common.
    - `timing`: of the program that runs all step sizes with this s side by side.
    """

    stages: int
    dt: float
    times: np.ndarray
    integrals: np.ndarray
    positions: np.ndarray
    circle_deviation: float
    mean_iterations: float
    max_constraint_violation: float
    timing: Timing

    def deviations(self) -> np.ndarray:
        """Return the first integrals less their initial values."""
        return self.integrals - self.integrals[0]

    def largest_linear_errors(self) -> np.ndarray:
        """Return the largest deviation of each linear integral, of shape (3,)."""
        return np.max(np.abs(self.deviations()[:, :3]), axis=0)

    def energy_by_fifths(self) -> list[float]:
        """Return the moving energy's largest deviation in each fifth of the run."""
        return largest_by_fifths(self.deviations()[1:, 3])


def ball_verdict(runs: list[BallRun]) -> str:
    """Say in a line how well the linear integrals and the moving energy are kept."""
    linear = max(float(np.max(run.largest_linear_errors())) for run in runs)
    fifths = [run.energy_by_fifths() for run in runs]
    growth = max(max(x) / max(x[0], ENERGY_FLOOR) for x in fifths)
    energy = f"grows {growth:.1f}-fold" if growth > 1.2 else "does not drift"
    return f"the linear integrals are kept to {linear:.0e}; the moving energy {energy}"
