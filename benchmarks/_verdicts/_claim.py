"""A claim with what was measured, and the verdict that follows."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    from matplotlib.figure import Figure


CONFIRMED, REFUTED = "confirmed", "not confirmed"
PRINT, DEPENDS = "wrong in print", "depends"
# A claim of ours, not the paper's.
OURS = "ours"
# Belongs to each verdict that rests on runs of SPARK.
RECONSTRUCTED = "SPARK is reconstructed here, without Jay's report"


@dataclasses.dataclass(frozen=True)
class Claim:
    """One line of the table.

    - `claim`: what is said, with the section in brackets.
    - `measured`: the figures.
    - `command`: what measures them.
    - `verdict`: one of the words above; `why` says in plain words what it rests on.
    """

    claim: str
    measured: str
    command: str
    verdict: str
    why: str

    def row(self) -> list[str]:
        """Return the line of the table."""
        return [
            self.claim,
            self.measured,
            f"`{self.command}`",
            f"**{self.verdict}**: {self.why}",
        ]


@dataclasses.dataclass(frozen=True)
class Found:
    """The claims of one experiment, with data for JSON and figures by name."""

    claims: list[Claim]
    data: dict[str, Any]
    figures: "dict[str, Figure]" = dataclasses.field(default_factory=dict)


def command(part: str) -> str:
    """Return the command that measures one part of the table."""
    return f"python -m benchmarks.verdicts --only {part}"


def slope(step_sizes: Sequence[float], errors: Sequence[float]) -> float:
    """Return the order between the last two step sizes, or NaN without errors."""
    if min(errors[-2:]) <= 0:
        return np.nan
    ratio = np.log(errors[-2] / errors[-1])
    return float(ratio / np.log(step_sizes[-2] / step_sizes[-1]))


def near(found: Any, expected: Any, within: float = 0.3) -> bool:
    """Tell whether all orders that could be seen are those expected."""
    difference = np.abs(np.asarray(found) - np.asarray(expected))
    return bool(np.all(difference[np.isfinite(difference)] <= within))


def orders_text(orders: Any) -> str:
    """Write the orders for one number of stages after the other."""
    return ", ".join(f"{x:.2f}" if np.isfinite(x) else "-" for x in orders)


def stages_text(stages: Sequence[int]) -> str:
    """Write which numbers of stages the orders belong to."""
    return "s = " + ", ".join(map(str, stages))
