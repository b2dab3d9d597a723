"""A run of the chaotic ensemble, in chunks of members."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._ensemble import ensemble, EnsembleOutcome, Maximum, Mean, Variance
from .._errors import IntegrationError
from .._initial import initial_state
from .._integrate import integrate, SaveAt
from .._method import LobattoIIIAB
from ..systems import ChaoticSystem
from ._result import Timing
from ._run import meter


# Means are taken over an interval of this length to either side of a time: μ(E, k) of
# one step fluctuates with the fast motion of the system.
WINDOW = 5.0
# So many members run at a time, if the energies that are saved of all fit in so many
# bytes: memory does not grow with the number of members.
CHUNK, CHUNK_BYTES = 1000, 2**26


@dataclasses.dataclass(frozen=True)
class ChaoticRun:
    """The ensemble with one method and one step size.

    - `mu`, `mu_error`: the mean squared energy error μ(E, k) at the saved times, and
        its standard error σ/√N over the N members.
    - `windows`, `windows_error`: the same of averages over windows in time.
    """

    stages: int
    dt: float
    times: np.ndarray
    mu: np.ndarray
    mu_error: np.ndarray
    windows: np.ndarray
    windows_error: np.ndarray
    mean_iterations: float
    max_constraint_violation: float
    timing: Timing


class Case(NamedTuple):
    """The method, step size, length and output of one run of the ensemble."""

    method: LobattoIIIAB
    h: float
    num_steps: int
    save_every: int


def _program(
    case: Case, members: int, every: int, weights: np.ndarray
) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Make the run of a member, and the member of an index."""
    chaotic = ChaoticSystem()

    def member(j: Array) -> tuple[Array, Array]:
        angle = j.astype(float) * (0.5 * math.pi / members)
        return (
            chaotic.q0.at[0].set(jnp.cos(angle)),
            chaotic.v0.at[1].set(jnp.sin(angle)),
        )

    def run(start: tuple[Array, Array]) -> dict[str, Any]:
        sol = integrate(
            chaotic.system,
            case.method,
            initial_state(chaotic.system, *start),
            dt=case.h,
            num_steps=case.num_steps,
            saveat=SaveAt(t0=True, steps=every, fn=chaotic.system.energy),
            throw=False,
        )
        squares = (sol.ys - sol.ys[0]) ** 2
        windows = jnp.asarray(weights) @ squares
        return {"sol": sol, "μ": {"each": squares, "windows": windows}}

    return run, member


def chaotic_run(
    case: Case, members: int, times: Sequence[float], progress: bool
) -> ChaoticRun:
    """Run the ensemble, and average over windows around each of `times`."""
    every = min(case.save_every, case.num_steps)
    # As the times of `integrate`, which are products.
    ts = case.h * np.arange(0, case.num_steps + 1, every)
    weights = np.abs(ts - np.asarray(times)[:, None]) <= WINDOW + 1e-9
    weights = weights / np.sum(weights, axis=1, keepdims=True)
    run, member = _program(case, members, every, weights)
    size = max(1, min(members + 1, CHUNK, CHUNK_BYTES // ts.nbytes))
    name = f"s = {case.method.stages}, h = {case.h:.4g}"

    def outcome(count: int, shown: bool) -> EnsembleOutcome:
        return ensemble(
            run,
            member,
            num_members=count,
            chunk_size=size,
            reduce=_REDUCTIONS,
            progress_meter=meter(shown, name, "member"),
        )

    start = time.perf_counter()
    # Compiles, and runs a chunk.
    outcome(size, False)
    compiled = time.perf_counter()
    whole = outcome(members + 1, progress)
    timing = Timing(compiled - start, time.perf_counter() - compiled)
    failures = whole.failures()
    if failures:
        j, k, reason = failures[0]
        raise IntegrationError(
            f"Integration failed in {len(failures)} of {members + 1} members, first in "
            f"member {j}, step {k}: {reason}"
        )
    found = jax.tree.map(np.asarray, whole.statistics)
    errors = jax.tree.map(lambda x: np.sqrt(x / (members + 1)), found["variance"])
    return ChaoticRun(
        stages=case.method.stages,
        dt=case.h,
        times=ts,
        mu=found["mean"]["each"],
        mu_error=errors["each"],
        windows=found["mean"]["windows"],
        windows_error=errors["windows"],
        mean_iterations=float(found["iterations"]) / case.num_steps,
        max_constraint_violation=float(found["violation"]),
        timing=timing,
    )


_REDUCTIONS = {
    "mean": Mean(of=lambda value: value["μ"]),
    "variance": Variance(of=lambda value: value["μ"]),
    "iterations": Mean(of=lambda value: value["sol"].stats["num_iterations"]),
    "violation": Maximum(
        of=lambda value: value["sol"].stats["max_constraint_violation"]
    ),
}
