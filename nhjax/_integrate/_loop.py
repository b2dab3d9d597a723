"""The time loop: its state, what a step does to it, and what is saved on the way."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
    first_step_state,
    largest_violation,
    Parameters,
    primitive_step,
    StepOutcome,
    StepRecord,
    StepState,
)
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    position_scale,
    State,
    violation_scale,
)
from ._checks import known
from ._progress_meter import AbstractProgressMeter


class Carry(NamedTuple):
    """What goes from step to step; of it the node alone has derivatives."""

    step_state: StepState
    result: RESULTS
    stats: dict[str, Any]


class Rows(NamedTuple):
    """What a step leaves to be saved, or the buffers of all that was."""

    saved: PyTree[Array] | None
    record: StepRecord | None


class Loop(eqx.Module):
    """The time loop's constants, what it does with a step's outcome, and what it saves.

    `fn` of the state after every `stride`-th step (0: of none) is saved, and the record
    of step k in row `record_slots[k]` of `num_records`, if any. What is not saved is
    written to one row more than there are.
    """

    system: AbstractMechanicalSystem
    method: AbstractMethod = eqx.field(static=True)
    stage_solver: AbstractStageSolver
    t0: FloatScalar
    dt: FloatScalar
    num_steps: int | Int[Array, ""]
    args: Args
    meter: AbstractProgressMeter
    fn: Callable[[FloatScalar, State, Args], PyTree[Array]]
    stride: int = eqx.field(static=True)
    num_records: int = eqx.field(static=True)
    record_slots: Int[Array, " num_steps+1"] | None

    def time(self, k: Int[Array, ""] | int) -> FloatScalar:
        """t_k by a product: a running sum of dt would drift."""
        return self.t0 + jnp.asarray(k, self.dt.dtype) * self.dt

    def start(self, y0: State) -> Carry:
        """The carry before the first step."""
        step_state = first_step_state(self.system, self.method, self.t0, y0, self.args)
        result = RESULTS.where(
            self._is_consistent(step_state),
            RESULTS.successful,
            RESULTS.inconsistent_start,
        )
        result = RESULTS.where(all_finite(y0), result, RESULTS.nonfinite_state)
        zero, none = jnp.zeros((), self.dt.dtype), jnp.zeros((), jnp.int32)
        stats = {
            "num_steps": none,
            "num_iterations": none,
            "num_newton_steps": none,
            "max_residual": zero,
            "max_constraint_violation": largest_violation(
                self.system, self.t0, step_state, self.args
            ),
            "max_multiplier_defect": zero,
            "failed_step": jnp.where(result == RESULTS.successful, none - 1, none),
        }
        return Carry(step_state, result, stats)

    def _is_consistent(self, step_state: StepState) -> BoolScalar:
        """Whether Φ = 0 and v, p belong together at the start, but for small errors.

        The bound is to find a state of another system, or one changed by hand in one
        part; it lets pass the perturbations by which derivatives are approximated.
        """
        y, lin, system = step_state.state, step_state.lin, self.system
        small = float(jnp.finfo(y.p.dtype).eps) ** 0.25
        u = system.fibre_coordinate(y)
        conjugate = system.fibre_derivative(self.t0, y.q, u, self.args)
        given = y.p if system.fibre_coordinate_name == "v" else y.v
        size = max_norm(conjugate) + max_norm(given)
        scale = violation_scale(system, lin, self.t0, y.q, u, self.args)
        positions = system.position_constraint(self.t0, y.q, self.args)
        allowed = position_scale(system, self.t0, y.q, self.args)
        return (
            jnp.all(jnp.abs(lin.violation) <= small * scale)
            & jnp.all(jnp.abs(positions) <= small * allowed)
            & (system.manifold_of(y.q).distance_to_group(y.q) <= small)
            & (max_norm(conjugate - given) <= small * size)
        )

    def step(self, carry: Carry, k: Int[Array, ""]) -> tuple[Carry, Rows]:
        """Step k; a failed trajectory keeps its last good node."""
        alive = carry.result == RESULTS.successful
        start = carry.step_state.state
        outcome = primitive_step(
            Parameters(self.system, self.time(k), self.dt, start, self.args),
            self.method,
            self.stage_solver,
            jax.lax.stop_gradient(carry.step_state),
            ~alive,
        )
        good = alive & (outcome.result == RESULTS.successful)
        step_state = jax.tree.map(
            lambda new, old: jnp.where(good, new, old),
            outcome.step_state,
            carry.step_state,
        )
        result = RESULTS.where(alive, outcome.result, carry.result)
        stats = self._updated(carry.stats, outcome, alive, good, k)
        if not self.meter.silent:
            self.meter.report(k, known(self.num_steps))
        carry = Carry(step_state, result, jax.lax.stop_gradient(stats))
        return carry, self._rows(carry, outcome.record, good, k)

    def _rows(self, carry: Carry, record: StepRecord, good, k) -> Rows:
        def save():
            return self.saved(self.time(k + 1), carry.step_state.state)

        saved = None
        if self.stride == 1:
            saved = save()
        elif self.stride:
            nothing = jax.tree.map(
                lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(save)
            )
            saved = jax.lax.cond(self._slot(k) < self._num_saved, save, lambda: nothing)
        if not self.num_records:
            return Rows(saved, None)
        # At rest after a failure, so that dense output stays where it was.
        record = StepRecord(
            record.start,
            jnp.where(good, record.velocity, 0),
            jnp.where(good, record.force, 0),
            jnp.where(good, record.multiplier, record.start.multiplier),
        )
        return Rows(saved, record)

    def saved(self, t: FloatScalar, y: State) -> PyTree[Array]:
        """What is saved of a state: its time and `fn` of it."""
        return t, jax.tree.map(jnp.asarray, self.fn(t, y, self.args))

    @property
    def _num_saved(self) -> int:
        return known(self.num_steps) // self.stride if self.stride else 0

    def _slot(self, k: Int[Array, ""]) -> Int[Array, ""]:
        kept = ((k + 1) % self.stride == 0) & (k < self.num_steps)
        return jnp.where(kept, (k + 1) // self.stride - 1, self._num_saved)

    def empty_rows(self, carry: Carry) -> Rows:
        """Buffers for all rows that are saved, and one more."""
        k = jnp.zeros((), jnp.int32)
        row = jax.eval_shape(lambda: self.step(carry, k)[1])

        def empty(length, tree):
            return jax.tree.map(
                lambda x: jnp.zeros((length + 1, *x.shape), x.dtype), tree
            )

        return Rows(
            empty(self._num_saved, row.saved), empty(self.num_records, row.record)
        )

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of step k where they belong; k >= num_steps saves nothing."""

        def put(buffer, row, slot):
            return jax.tree.map(
                lambda x, new: jax.lax.dynamic_update_index_in_dim(x, new, slot, 0),
                buffer,
                row,
            )

        saved, records = buffers
        if self.stride:
            saved = put(saved, rows.saved, self._slot(k))
        if self.record_slots is not None:
            slot = self.record_slots[jnp.minimum(k, self.num_steps)]
            records = put(records, rows.record, slot)
        return Rows(saved, records)

    def read(self, buffers: Rows, k: Int[Array, ""]) -> Rows:
        """The rows of step k in buffers of all rows, where `write` puts them."""

        def get(buffer, slot):
            return jax.tree.map(lambda x: x[slot], buffer)

        saved, records = buffers
        if self.stride:
            saved = get(saved, self._slot(k))
        if self.record_slots is not None:
            records = get(records, self.record_slots[k])
        return Rows(saved, records)

    def _updated(self, stats, outcome: StepOutcome, alive, good, k) -> dict[str, Any]:
        def larger(name, value):
            return jnp.where(good, jnp.maximum(stats[name], value), stats[name])

        return {
            "num_steps": stats["num_steps"] + good.astype(jnp.int32),
            "num_iterations": stats["num_iterations"]
            + jnp.where(alive, outcome.num_iterations, 0),
            "num_newton_steps": stats["num_newton_steps"]
            + (good & outcome.newton).astype(jnp.int32),
            "max_residual": larger("max_residual", outcome.residual),
            "max_constraint_violation": larger(
                "max_constraint_violation", outcome.constraint_violation
            ),
            "max_multiplier_defect": larger(
                "max_multiplier_defect", outcome.multiplier_defect
            ),
            "failed_step": jnp.where(alive & ~good, k, stats["failed_step"]),
        }
