"""The time loop: step, save, and go on."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ._checks import known
from ._progress_meter import AbstractProgressMeter
from ._saving import Rows, Saving
from ._stepping import Carry, Stepping


class Loop(eqx.Module):
    """How a run steps, what it saves on the way, and who is told of its progress.

    An adjoint calls `step` for all k in 0..num_steps - 1 in turn, and `write`s the rows
    that it leaves to buffers that start as `empty_rows`.
    """

    stepping: Stepping
    saving: Saving
    meter: AbstractProgressMeter

    @property
    def num_steps(self) -> int | Int[Array, ""]:
        """How many steps there are."""
        return self.saving.num_steps

    def step(self, carry: Carry, k: Int[Array, ""]) -> tuple[Carry, Rows]:
        """Step k: the carry after it, and what it leaves to be saved."""
        carry, taken = self.stepping.advance(carry, k)
        if not self.meter.silent:
            self.meter.report(k, known(self.num_steps))
        t, args = self.stepping.time(k + 1), self.stepping.args
        return carry, self.saving.rows(t, carry.step_state.state, args, taken, k)

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of step k to the buffers of all rows."""
        return self.saving.write(buffers, rows, k)

    def empty_rows(self, carry: Carry) -> Rows:
        """Buffers for all rows that are saved."""
        k = jnp.zeros((), jnp.int32)
        return self.saving.empty(jax.eval_shape(lambda: self.step(carry, k)[1]))
