"""Orders of convergence on the unicycle, on the group SE(2)."""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

from ..systems import Unicycle
from ._arguments import check_choice
from ._order_study import AbstractOrderStudy, order_study
from ._retractions import RETRACTIONS


@dataclasses.dataclass(frozen=True)
class UnicycleOrder(AbstractOrderStudy):
    """The errors of the unicycle on SE(2) at the final time, by stages and step size.

    - `errors`: relative ones, of shape (stages, step sizes, 5), for g = (x, y, θ), the
        body velocity v and momentum p, the multiplier λ that the method reports and the
        continuous one λ_c(g, p).
    - `timings`: one for each number of stages.
    """

    name: ClassVar[str] = "unicycle-order"
    quantities: ClassVar[tuple[str, ...]] = (
        "g",
        "v",
        "p",
        "multiplier",
        "continuous_multiplier",
    )


def unicycle_order(
    *,
    stages: Sequence[int] = (2, 3, 4, 5),
    dt: Sequence[float] = (0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625),
    final_time: float = 3.0,
    closure: str = "propagated",
    retraction: str = "cayley",
    progress: bool = False,
) -> UnicycleOrder:
    """Measure the orders of g, v, p and the multiplier on the unicycle, on SE(2).

    The paper's fourth experiment. The paper takes the errors against its own method
    with h = 1e-4; here they are taken against the exact solution.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: when the errors are taken.
    - `closure`: of the multipliers, as for `nhjax.LobattoIIIAB`; the paper's by
        default.
    - `retraction`: `"cayley"`, the paper's, or `"exponential"`.
    - `progress`: show a bar on the standard error stream.

    **Returns:** a `UnicycleOrder`.

    **Raises:** `ArgumentError` for arguments that cannot be right, and
    `nhjax.IntegrationError` if a step cannot be solved.
    """
    check_choice("retraction", retraction, RETRACTIONS)
    return order_study(
        UnicycleOrder,
        Unicycle(retraction=RETRACTIONS[retraction]),
        stages=stages,
        dt=dt,
        final_time=final_time,
        closure=closure,
        progress=progress,
    )
