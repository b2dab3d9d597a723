"""The body of the time loop: it takes a step and saves what is to be saved of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._numerics import moving_with
from ._checks import known
from ._progress_meter import AbstractProgressMeter
from ._saving import Rows, Saving
from ._stepping import Carry, Stepping, Taken


class Loop(eqx.Module):
    """The time loop of a run: its steps, what it saves of them, and its progress meter.

    An adjoint calls `step` for k = 0, ..., num_steps - 1 in turn, and calls `write` to
    put the rows that each step returns into buffers that start as `empty_rows`.
    """

    stepping: Stepping
    saving: Saving
    meter: AbstractProgressMeter

    @property
    def num_steps(self) -> int | Int[Array, ""]:
        """Return the number of steps of the run."""
        return self.saving.num_steps

    def step(self, carry: Carry, k: Int[Array, ""]) -> tuple[Carry, Rows]:
        """Take step k; return the carry after it and the rows that it saves."""
        carry, taken = self.stepping.advance(carry, k)
        if not self.meter.silent:
            self.meter.report(k, known(self.num_steps))
        return carry, self._rows(carry, taken, k)

    def _rows(self, carry: Carry, taken: Taken, k: Int[Array, ""]) -> Rows:
        t, args = self.stepping.time(k + 1), self.stepping.args
        return self.saving.rows(t, carry.step_state.state, args, taken, k)

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of step k to the buffers of all rows."""
        return self.saving.write(buffers, rows, k)

    def row_shapes(self, carry: Carry) -> Rows:
        """Find the shapes of the rows that a step saves."""
        k = jnp.zeros((), jnp.int32)

        def rows() -> Rows:
            # No step is taken for this, since a step is dear to trace.
            return self._rows(carry, self.stepping.nothing_taken(carry), k)

        return jax.eval_shape(rows)

    def moving(self, carry: Carry) -> Carry:
        """Return the same carry, its state differentiated wherever the run is."""
        state = moving_with(carry.step_state.state, self.stepping)
        return eqx.tree_at(lambda x: x.step_state.state, carry, state)

    def empty_rows(self, carry: Carry) -> Rows:
        """Make buffers of zeros for all rows that the run saves."""
        rows = self.saving.empty(self.row_shapes(carry))
        return moving_with(rows, (self.stepping, carry))
