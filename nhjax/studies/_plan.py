"""What a study is about to do, and about how long that takes."""

import inspect
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any


# The arguments of a study in its small form.
QUICK: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "particle-order": {"stages": (2, 3), "dt": (0.25, 0.125)},
        "cvt-energy": {"final_time": 200.0, "dt": (0.1,)},
        "chaotic-energy": {"stages": (2,), "final_time": 40.0, "members": 20},
        "unicycle-order": {"stages": (2, 3), "dt": (0.25, 0.125)},
        # A fifth of it is as long as the ball takes for a circle.
        "ball-invariants": {"stages": (3,), "dt": (0.2, 0.1), "num_steps": 1000},
    }
)

# Seconds to compile a program, seconds a step of a trajectory, both as measured on two
# cores of 2 GHz, and whether there is a program for each s and h or one for each s.
_COSTS: Mapping[str, tuple[float, float, bool]] = MappingProxyType(
    {
        "particle-order": (4.0, 1e-5, False),
        "cvt-energy": (4.0, 2e-5, True),
        "chaotic-energy": (3.5, 4e-6, True),
        "unicycle-order": (6.5, 2e-5, False),
        "ball-invariants": (12.0, 1e-4, False),
    }
)
_START = 4.0


def plan(name: str, function: Any, options: Mapping[str, Any]) -> str:
    """Write what a study does with these options, and about how long it takes.

    The time is a rough one: it is that of two cores of 2 GHz, on which nothing else
    runs.
    """
    headline = (inspect.getdoc(function) or "").partition("\n")[0]
    defaults = {
        key: parameter.default
        for key, parameter in inspect.signature(function).parameters.items()
        if key != "progress" and parameter.default is not None
    }
    chosen = defaults | dict(options)
    listed = ", ".join(f"{key} {shown(value)}" for key, value in chosen.items())
    seconds = _seconds(name, chosen)
    return f"{headline}\nWith {listed}.\nAbout {seconds} on two cores."


def shown(value: Any) -> str:
    """Write the value of an option as the command line takes it."""
    if isinstance(value, tuple | list):
        return " ".join(map(shown, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _seconds(name: str, chosen: Mapping[str, Any]) -> str:
    compile_seconds, step_seconds, for_each_dt = _COSTS[name]
    stages, dt = chosen["stages"], chosen["dt"]
    programs = len(stages) * (len(dt) if for_each_dt else 1)
    length = chosen.get("final_time", math.nan)
    steps = [chosen.get("num_steps", length / h if h > 0 else 0) for h in dt]
    trajectories = chosen.get("members", 0) + 1
    trajectories *= len(chosen.get("regimes", ("",)))
    # Iterations of a step cost as s does.
    runs = step_seconds * sum(steps) * trajectories * sum(stages) / 2
    seconds = _START + compile_seconds * programs + runs
    if not math.isfinite(seconds):
        return "an unknown time"
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} seconds"
    return f"{round(seconds / 60)} minutes"
