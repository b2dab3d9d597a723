"""One run of a cvt-energy study."""

import dataclasses

import numpy as np

from ._result import Timing
from ._table import largest_by_fifths


ENERGIES = ("total", "driver", "passenger")


@dataclasses.dataclass(frozen=True)
class CVTRun:
    """The energies of one run, at every step.

    - `energies`: shape (k + 1, 3): total, driver and passenger.
    - `timing`: of the program that runs all regimes with this s and h side by side.
    """

    regime: str
    stages: int
    dt: float
    times: np.ndarray
    energies: np.ndarray
    max_multiplier_defect: float
    timing: Timing

    @property
    def key(self) -> str:
        """Return the name of the run for files and arrays."""
        return f"{self.regime}_s{self.stages}_h{self.dt:.6g}"

    def deviations(self) -> np.ndarray:
        """Return the energies less their initial values."""
        return self.energies - self.energies[0]

    def by_fifths(self) -> list[float]:
        """Return max |E - E0| of the total energy over each fifth of the run."""
        return largest_by_fifths(self.deviations()[1:, 0])

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Return the least and the greatest deviation of each energy."""
        low, high = self.deviations().min(axis=0), self.deviations().max(axis=0)
        return {
            name: (float(low[i]), float(high[i])) for i, name in enumerate(ENERGIES)
        }


def cvt_verdict(runs: list[CVTRun]) -> str:
    """Say in a line in which runs the energy error grows."""
    grown = []
    for run in runs:
        fifths = run.by_fifths()
        if (growth := max(fifths) / fifths[0]) > 1.2:
            name = f"{run.regime}, s = {run.stages}, h = {run.dt:.4g}"
            grown.append(f"{name} ({growth:.1f}-fold)")
    if not grown:
        return "the energy error of no run grows after its first fifth"
    return f"the energy error grows after the first fifth in: {'; '.join(grown)}"
