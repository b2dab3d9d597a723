"""Helpers of studies, which compile and run a program and time both separately."""

import time
from collections.abc import Callable
from typing import Any

import jax

from .._integrate import AbstractProgressMeter, NoProgressMeter, TqdmProgressMeter
from ._result import Timing


def compile_and_run(function: Callable[..., Any], *args: Any) -> tuple[Any, Timing]:
    """Compile and run `function(*args)` as one program; return its value and times."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    compiled = time.perf_counter()
    value = jax.block_until_ready(program(*args))
    # Callbacks of progress meters may outlast the program.
    jax.effects_barrier()
    return value, Timing(compiled - start, time.perf_counter() - compiled)


def meter(
    progress: bool, description: str, unit: str = "step"
) -> AbstractProgressMeter:
    """Make a progress meter: a bar on the standard error stream, or none."""
    return TqdmProgressMeter(description, unit) if progress else NoProgressMeter()
