"""The arguments of studies: checks, values for `--quick`, and the plan of a run."""

import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from .._manifold import AbstractRetraction, Cayley, Exponential


# The retractions that studies on groups accept, by name.
RETRACTIONS: Mapping[str, AbstractRetraction] = MappingProxyType(
    {"cayley": Cayley(), "exponential": Exponential()}
)
# The arguments of each study with `nhjax run --quick`.
QUICK: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "particle-order": {"stages": (2, 3), "dt": (0.25, 0.125)},
        "cvt-energy": {"final_time": 200.0, "dt": (0.1,)},
        "chaotic-energy": {"stages": (2,), "final_time": 40.0, "members": 20},
        "unicycle-order": {"stages": (2, 3), "dt": (0.25, 0.125)},
        # The study compares the errors in the fifths of a run. In each fifth of these
        # runs the ball moves at least once around its circle.
        "ball-invariants": {"stages": (3,), "dt": (0.2, 0.1), "num_steps": 1000},
    }
)
# For each study: the seconds to compile a program, the seconds per step of a trajectory
# (both measured on two cores of 2 GHz), and whether the study compiles one program for
# each pair of a number of stages s and a step size. Otherwise it compiles one for each
# s.
_COSTS: Mapping[str, tuple[float, float, bool]] = MappingProxyType(
    {
        "particle-order": (2.4, 1e-5, False),
        "cvt-energy": (2.2, 2e-5, True),
        "chaotic-energy": (1.6, 4e-6, True),
        "unicycle-order": (4.5, 2e-5, False),
        "ball-invariants": (6.0, 1e-4, False),
    }
)
_START_SECONDS = 3.0


class ArgumentError(ValueError):
    """Raised if an argument of a study is invalid.

    `argument` is the name of the argument. The command line uses it to find the option.
    """

    def __init__(self, argument: str, problem: str):
        super().__init__(f"`{argument}` {problem}.")
        self.argument = argument
        self.problem = problem


def check_distinct(argument: str, values: Sequence[object]) -> None:
    """Raise unless there is at least one value, and all values are different."""
    if len(values) == 0:
        raise ArgumentError(argument, "is empty")
    if len(set(values)) < len(values):
        raise ArgumentError(argument, f"holds a value twice: {list(values)}")


def check_choice(argument: str, value: str, choices: Iterable[str]) -> None:
    """Raise unless `value` is among `choices`."""
    if value not in (known := list(choices)):
        raise ArgumentError(argument, f"must be one of {known}, got {value!r}")


def check_stages(stages: Sequence[int]) -> None:
    """Raise unless `stages` has distinct numbers for which Lobatto pairs exist."""
    check_distinct("stages", stages)
    for s in stages:
        if s < 2:
            raise ArgumentError(
                "stages", f"must be at least 2 for the Lobatto pairs, got {s}"
            )


def check_positive(argument: str, *values: float) -> None:
    """Raise unless all values are positive and finite."""
    for x in values:
        if not (math.isfinite(x) and x > 0):
            raise ArgumentError(argument, f"must be positive and finite, got {x:g}")


def check_at_least_one(argument: str, value: int) -> None:
    """Raise if an integer is less than 1."""
    if value < 1:
        raise ArgumentError(argument, f"must be at least 1, got {value}")


def check_step_sizes(dt: Sequence[float]) -> None:
    """Raise unless the step sizes are distinct and positive."""
    check_distinct("dt", dt)
    check_positive("dt", *dt)


def whole_steps(final_time: float, dt: float) -> int:
    """Compute the number of steps to the final time; raise unless it is an integer."""
    ratio = final_time / dt
    num_steps = round(ratio)
    if num_steps < 1 or abs(ratio - num_steps) > 1e-9 * ratio:
        raise ArgumentError(
            "dt", f"{dt:g} does not divide the final time {final_time:g}"
        )
    return num_steps


def plan(name: str, function: Any, options: Mapping[str, Any]) -> str:
    """Describe what a study does with these options, and estimate its time.

    The estimate is rough: it holds for two cores of 2 GHz without other load.
    """
    headline = (inspect.getdoc(function) or "").partition("\n")[0]
    defaults = {
        key: parameter.default
        for key, parameter in inspect.signature(function).parameters.items()
        if key != "progress" and parameter.default is not None
    }
    chosen = defaults | dict(options)
    listed = ", ".join(f"{key} {shown(value)}" for key, value in chosen.items())
    seconds = _estimated_time(name, chosen)
    return f"{headline}\nWith {listed}.\nAbout {seconds} on two cores."


def shown(value: Any) -> str:
    """Format the value of an option as the command line accepts it."""
    if isinstance(value, tuple | list):
        return " ".join(map(shown, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _estimated_time(name: str, chosen: Mapping[str, Any]) -> str:
    compile_seconds, step_seconds, for_each_dt = _COSTS[name]
    stages, dt = chosen["stages"], chosen["dt"]
    programs = len(stages) * (len(dt) if for_each_dt else 1)
    length = chosen.get("final_time", math.nan)
    steps = [chosen.get("num_steps", length / h if h > 0 else 0) for h in dt]
    trajectories = chosen.get("members", 0) + 1
    trajectories *= len(chosen.get("regimes", ("",)))
    # The time of a step is proportional to s, and `step_seconds` holds for s = 2.
    runs = step_seconds * sum(steps) * trajectories * sum(stages) / 2
    seconds = _START_SECONDS + compile_seconds * programs + runs
    if not math.isfinite(seconds):
        return "an unknown time"
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} seconds"
    return f"{round(seconds / 60)} minutes"
