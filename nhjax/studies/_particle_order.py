"""Orders of convergence on the nonholonomic particle and on Chaplygin's sleigh."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

from ..systems import ChaplyginSleigh, NonholonomicParticle
from ._arguments import check_choice
from ._order_study import AbstractOrderStudy, order_study


# The sleigh's mass matrix depends on position.
EXAMPLES = {"particle": NonholonomicParticle, "sleigh": ChaplyginSleigh}


@dataclasses.dataclass(frozen=True)
class ParticleOrder(AbstractOrderStudy):
    """The errors of the nonholonomic particle at the final time, by stages and step.

    - `errors`: relative ones, of shape (stages, step sizes, 4), for q, p, the
        multiplier λ that the method reports and the continuous one λ_c(q, p).
    - `timings`: one for each number of stages.
    """

    name: ClassVar[str] = "particle-order"
    quantities: ClassVar[tuple[str, ...]] = (
        "q",
        "p",
        "multiplier",
        "continuous_multiplier",
    )


def particle_order(
    *,
    stages: Sequence[int] = (2, 3, 4, 5, 6),
    dt: Sequence[float] = (0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625),
    final_time: float = 3.0,
    closure: str = "propagated",
    system: str = "particle",
    progress: bool = False,
) -> ParticleOrder:
    """Measure the orders of q, p and the multiplier on the nonholonomic particle.

    The paper's first experiment, against the exact solution; the same for Chaplygin's
    sleigh, whose mass matrix depends on position.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: when the errors are taken.
    - `closure`: of the multipliers, as for `nhjax.LobattoIIIAB`; the paper's by
        default.
    - `system`: `"particle"`, or `"sleigh"` for Chaplygin's sleigh.
    - `progress`: show a bar on the standard error stream.

    **Returns:** a `ParticleOrder`.

    **Raises:** `ArgumentError` for arguments that cannot be right, and
    `nhjax.IntegrationError` if a step cannot be solved.
    """
    check_choice("system", system, EXAMPLES)
    return order_study(
        ParticleOrder,
        EXAMPLES[system](),
        stages=stages,
        dt=dt,
        final_time=final_time,
        closure=closure,
        progress=progress,
    )
