"""The time loop of a run: each iteration advances the stepper and saves its result."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._numerics import with_zero_tangents
from .._step import RoundOff
from ._progress_meter import AbstractProgressMeter
from ._saving import Rows, Saving, static_length
from ._stepper import AbstractCarry, AbstractStepper, StepResult


class Loop(eqx.Module):
    """The time loop of a run: its stepper, its output, and its progress meter.

    An adjoint calls `step` for k = 0, ..., num_iterations - 1 in order, and calls
    `write` to put the rows that each iteration returns into buffers, which start as
    `empty_rows`.
    """

    stepper: AbstractStepper[Any, Any]
    saving: Saving
    meter: AbstractProgressMeter

    @property
    def num_iterations(self) -> int | Int[Array, ""]:
        """Return the number of iterations of the loop."""
        return self.stepper.num_iterations

    def with_round_off(self, round_off: RoundOff) -> "Loop":
        """Return the same loop with the measured round-off of the system."""
        return replace(self, stepper=self.stepper.with_round_off(round_off))

    def step(
        self, carry: AbstractCarry, k: Int[Array, ""], replay: Any = None
    ) -> tuple[AbstractCarry, Rows]:
        """Perform iteration k; return the carry after it and the rows that it saves."""
        carry, result = self.stepper.advance(carry, k, replay)
        if not self.meter.silent:
            self._report(k)
        return carry, self._rows(carry, result, k)

    def _report(self, k: Int[Array, ""]) -> None:
        """Report the steps that are certain to be complete after iteration k.

        A stepper may need more iterations than there are steps. Their largest number is
        known, so that all members of a batch report the same, and report once.
        """
        length = static_length(self.stepper.plain.num_steps)
        surplus = static_length(self.num_iterations) - length
        if not surplus:
            return self.meter.report(k, length)
        done = k - np.int32(surplus)
        return jax.lax.cond(
            done >= 0, lambda: self.meter.report(done, length), lambda: None
        )

    def _rows(
        self, carry: AbstractCarry, result: StepResult, k: Int[Array, ""]
    ) -> Rows:
        args, row = self.stepper.plain.args, k if result.row is None else result.row
        return Rows(
            saved=self.saving.row_of_state(result.t, carry.step_state.state, args, row),
            record=self.saving.row_of_record(result.record, result.is_good),
            log=result.log_entry,
            row=result.row,
            log_slot=result.log_slot,
        )

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of iteration k to the buffers of all rows."""
        return self.saving.write(buffers, rows, k)

    def row_shapes(self, carry: AbstractCarry) -> Rows:
        """Return the shapes of the rows that an iteration saves.

        No step is taken for this, because tracing a step is expensive.
        """

        def rows() -> Rows:
            result = self.stepper.blank_result(carry)
            return self._rows(carry, result, jnp.zeros((), jnp.int32))

        return jax.eval_shape(rows)

    def moving(self, carry: AbstractCarry) -> AbstractCarry:
        """Return the same carry; its state gets zero tangents if the run has any."""
        state = with_zero_tangents(carry.step_state.state, self.stepper)
        return eqx.tree_at(lambda x: x.step_state.state, carry, state)

    def no_rows(self, carry: AbstractCarry) -> Rows:
        """Return the rows of an iteration after the end: zeros, which `write` drops."""
        rows = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), self.row_shapes(carry)
        )
        if rows.row is not None:
            end = jnp.full_like(rows.row, self.stepper.plain.num_steps)
            rows = rows._replace(row=end)
        if rows.log_slot is not None:
            end = jnp.full_like(rows.log_slot, self.saving.log_length)
            rows = rows._replace(log_slot=end)
        return rows

    def empty_rows(self, carry: AbstractCarry) -> Rows:
        """Return buffers of zeros for all rows that the run saves."""
        rows = self.saving.empty(self.row_shapes(carry))
        return with_zero_tangents(rows, (self.stepper, carry))
