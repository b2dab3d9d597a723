"""The numbers that a run collects step by step and reports as `Solution.stats`."""

from typing import Any, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array, Int

from .._custom_types import BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._step import estimated_error, StepOutcome


Statistics: TypeAlias = dict[str, Any]


def first_statistics(
    violation: FloatScalar, redundant: Int[Array, ""], is_good: BoolScalar
) -> Statistics:
    """Make the statistics of a run before its first step.

    **Arguments:**

    - `violation`: the largest constraint violation of the initial state.
    - `redundant`: how many constraints follow from others at the initial state.
    - `is_good`: whether the run can start; otherwise step 0 counts as failed.
    """
    zero, none = jnp.zeros_like(violation), jnp.zeros((), jnp.int32)
    return {
        "num_steps": none,
        "num_iterations": none,
        "num_newton_steps": none,
        "num_redundant": redundant,
        "max_residual": zero,
        "max_constraint_violation": violation,
        "max_multiplier_defect": zero,
        "failed_step": jnp.where(is_good, none - 1, none),
        "worst_coordinate": none - 1,
    }


def reported_statistics(stats: Statistics, method: AbstractMethod) -> Statistics:
    """Make the statistics that a solution has, of those that are carried."""
    stats = dict(stats)
    ratios = stats.pop("max_error_ratios", None)
    if ratios is not None:
        stats["max_error_estimate"] = estimated_error(ratios, method)
    return stats


def updated_statistics(
    stats: Statistics,
    outcome: StepOutcome,
    alive: BoolScalar,
    good: BoolScalar,
    k: Int[Array, ""],
) -> Statistics:
    """Update the statistics of a run after its step k.

    **Arguments:**

    - `stats`: the statistics before the step.
    - `outcome`: the outcome of the step.
    - `alive`: whether the run had not failed before, so that the step was taken.
    - `good`: whether the step was taken and solved.
    - `k`: the index of the step.
    """

    def larger(name, value):
        return jnp.where(good, jnp.maximum(stats[name], value), stats[name])

    failed = alive & ~good
    optional = {
        "max_invariant_error": outcome.invariant_error,
        "max_error_ratios": outcome.error_ratios,
    }
    present = {k: x for k, x in optional.items() if x is not None}
    return {name: larger(name, x) for name, x in present.items()} | {
        "num_steps": stats["num_steps"] + good.astype(jnp.int32),
        "num_iterations": stats["num_iterations"]
        + jnp.where(alive, outcome.num_iterations, 0),
        "num_newton_steps": stats["num_newton_steps"]
        + (good & outcome.newton).astype(jnp.int32),
        "num_redundant": stats["num_redundant"],
        "max_residual": larger("max_residual", outcome.residual),
        "max_constraint_violation": larger(
            "max_constraint_violation", outcome.constraint_violation
        ),
        "max_multiplier_defect": larger(
            "max_multiplier_defect", outcome.multiplier_defect
        ),
        "failed_step": jnp.where(failed, k, stats["failed_step"]),
        "worst_coordinate": jnp.where(
            failed, outcome.worst_coordinate, stats["worst_coordinate"]
        ),
    }
