"""The checks that studies make before they compute anything."""

import math
from collections.abc import Iterable, Sequence


class ArgumentError(ValueError):
    """Raised if an argument of a study cannot be right.

    `argument` is its name, so that the command line can name its option.
    """

    def __init__(self, argument: str, problem: str):
        super().__init__(f"`{argument}` {problem}.")
        self.argument = argument
        self.problem = problem


def check_distinct(argument: str, values: Sequence[object]) -> None:
    """Raise unless there is at least one value, and none twice."""
    if len(values) == 0:
        raise ArgumentError(argument, "is empty")
    if len(set(values)) < len(values):
        raise ArgumentError(argument, f"holds a value twice: {list(values)}")


def check_choice(argument: str, value: str, choices: Iterable[str]) -> None:
    """Raise unless `value` is among `choices`."""
    if value not in (known := list(choices)):
        raise ArgumentError(argument, f"must be one of {known}, got {value!r}")


def check_stages(stages: Sequence[int]) -> None:
    """Raise unless every number of stages has a Lobatto pair."""
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
    """Raise an `ArgumentError` for an integer below 1."""
    if value < 1:
        raise ArgumentError(argument, f"must be at least 1, got {value}")


def check_step_sizes(dt: Sequence[float]) -> None:
    """Raise unless there are distinct positive step sizes."""
    check_distinct("dt", dt)
    check_positive("dt", *dt)


def whole_steps(final_time: float, dt: float) -> int:
    """Compute the number of steps to the final time, which `dt` has to divide."""
    ratio = final_time / dt
    num_steps = round(ratio)
    if num_steps < 1 or abs(ratio - num_steps) > 1e-9 * ratio:
        raise ArgumentError(
            "dt", f"{dt:g} does not divide the final time {final_time:g}"
        )
    return num_steps
