"""The time loop of a run, and the adjoints, which decide how it is differentiated.

Each iteration of the loop advances the stepper and saves its result. An adjoint runs
the loop, and decides which data reverse mode stores.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._custom_types import FloatScalar
from .._numerics import with_zero_tangents
from ._progress_meter import AbstractProgressMeter
from ._saving import Rows, Saving, static_length
from ._stepper import AbstractCarry, AbstractStepper, StepResult


class Loop(eqx.Module):
    """The time loop of a run: its stepper, its output, and its progress meter.

    An adjoint calls `step` for k = 0, ..., num_iterations - 1 in order, or until the
    run ends. After each iteration it calls `write` to put the returned rows into
    buffers, which start as `empty_rows`.
    """

    stepper: AbstractStepper[Any, Any]
    saving: Saving
    meter: AbstractProgressMeter

    @property
    def num_iterations(self) -> int | Int[Array, ""]:
        """Return the number of iterations of the loop."""
        return self.stepper.num_iterations

    def step(
        self, carry: AbstractCarry, k: Int[Array, ""], replay: Any = None
    ) -> tuple[AbstractCarry, Rows]:
        """Perform iteration k; return the carry after it and the rows that it saves."""
        before = carry
        carry, result = self.stepper.advance(carry, k, replay)
        if not self.meter.silent:
            if self.stepper.may_end_early:
                self.meter.report_part(self._part(before), self._part(carry))
            else:
                self._report(k)
        return carry, self._rows(carry, result, k)

    def _part(self, carry: AbstractCarry) -> FloatScalar:
        """Return the part of the run that is done, which is 1 if the run has ended."""
        part = self.stepper.progress(carry)
        return jnp.where(self.stepper.is_over(carry), jnp.ones_like(part), part)

    def _report(self, k: Int[Array, ""]) -> None:
        """Report the steps that are certain to be complete after iteration k.

        A stepper may need more iterations than there are steps. The report subtracts
        this surplus from k. All members of a batch then report the same number of
        steps, and the meter is called once for all members.
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

        This does not trace a step, because tracing a step is expensive.
        """

        def rows() -> Rows:
            result = self.stepper.blank_result(carry)
            return self._rows(carry, result, jnp.zeros((), jnp.int32))

        return jax.eval_shape(rows)

    def moving(self, carry: AbstractCarry) -> AbstractCarry:
        """Return the same carry; in a differentiated run, its state has tangents.

        With these tangents, which may be zero, JAX traces the loop's body only once.
        """
        state = with_zero_tangents(carry.step_state.state, self.stepper)
        return eqx.tree_at(lambda x: x.step_state.state, carry, state)

    def no_rows(self, carry: AbstractCarry) -> Rows:
        """Return rows of zeros, which `write` puts into an extra row of the buffers."""
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


_Run: TypeAlias = tuple[AbstractCarry, Rows]
_Advance: TypeAlias = Callable[[Int[Array, ""], _Run], _Run]


class AbstractAdjoint(eqx.Module):
    """The way in which `integrate` is differentiated in reverse mode.

    An adjoint decides which data of the steps are stored for the reverse pass, and
    which are computed again. If it `needs_log`, a run with a step size controller and
    without events saves the start and the size of each step.
    """

    needs_log: eqx.AbstractClassVar[bool]

    @abstractmethod
    def run(self, loop: Loop, carry: AbstractCarry) -> _Run:
        """Run the loop from `carry`; return the last carry and all saved rows."""


def advance(loop: Loop, k: Int[Array, ""], state: _Run) -> _Run:
    """Perform iteration k; the state is the carry and the buffers of all rows."""
    carry, buffers = state
    carry, rows = loop.step(carry, k)
    return carry, loop.write(buffers, rows, k)


def iterate_steps(loop: Loop, start: Any, end: Any, state: _Run) -> _Run:
    """Perform iterations `start` to `end` - 1, or fewer if the run ends before.

    This loop cannot be differentiated in reverse mode if the run may end early.
    """
    if not loop.stepper.may_end_early:
        return jax.lax.fori_loop(start, end, partial(advance, loop), state)

    def goes_on(counted):
        k, (carry, _) = counted
        return (k < end) & ~loop.stepper.is_over(carry)

    def body(counted):
        k, state = counted
        return k + np.int32(1), advance(loop, k, state)

    return jax.lax.while_loop(goes_on, body, (start, state))[1]


def count(num_steps: int | Int[Array, ""]) -> Any:
    """Return the bound of a loop: an int as a static int32, an array unchanged."""
    return np.int32(num_steps) if isinstance(num_steps, int) else num_steps


class DirectAdjoint(AbstractAdjoint):
    """Store the stages of every step: memory O(num_steps), the shortest run time.

    Forward mode (`jax.jvp`, `jax.jacfwd`, `jax.linearize`) and second derivatives
    (`jax.hessian`, and every other combination of the two modes) work as well. If
    `num_steps` is an array, only forward mode works.

    !!! note

        This differs from the `DirectAdjoint` of diffrax, which nests scans and
        checkpoints up to a maximum number of steps; diffrax advises against using it.
        In nhjax the number of steps (with a controller, a limit for it) is known before
        the run. A plain loop therefore runs all steps, and this adjoint is the default.

    !!! example

        >>> import jax, nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> def end(dt):
        ...     return nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...         disc.initial_state(), dt=dt, num_steps=10).ys.q[-1, 3]
        >>> round(float(jax.grad(end)(0.1)), 6)
        7.0
    """

    needs_log: ClassVar[bool] = False

    def run(self, loop: Loop, carry: AbstractCarry) -> _Run:
        """Run the loop from `carry`; return the last carry and all saved rows."""
        state = (carry, loop.empty_rows(carry))
        if loop.stepper.may_end_early:
            return _run_until_over((loop, state), self)
        return iterate_steps(loop, np.int32(0), count(loop.num_iterations), state)


class RecursiveCheckpointAdjoint(AbstractAdjoint):
    """Store some states on the way, recompute the rest: memory O(sqrt(num_steps)).

    The steps are divided into `checkpoints` blocks, and each block is divided in the
    same way, until a block has at most `checkpoints` steps. The reverse pass works in
    one block of each level at a time. For this block it stores the states at the starts
    of the smaller blocks in it. In one of the smallest blocks, it stores the stages of
    all steps. The default is two levels. Each level beyond the first costs another
    forward run. With L levels and num_steps = checkpoints^L the memory is
    O(L checkpoints).

    Forward mode, second derivatives and an array `num_steps` work as with
    `DirectAdjoint`.

    !!! note

        This differs from the `RecursiveCheckpointAdjoint` of diffrax. In diffrax a
        binomial scheme places checkpoints while the number of steps is not yet known,
        takes log(max_steps) checkpoints by default, and allows reverse mode only. In
        nhjax the number of steps (with a controller, a limit for it) is known, and
        blocks have equal length. `checkpoints` is the number of blocks on one level.
        The default is faster than the default of diffrax, and needs more memory.

    **Arguments:**

    - `checkpoints`: the number of states to store on each level, an int >= 2. The
        default is sqrt(num_steps).

    !!! example

        >>> import jax, nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> def end(dt):
        ...     return nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...         disc.initial_state(), dt=dt, num_steps=10,
        ...         adjoint=nhjax.RecursiveCheckpointAdjoint(checkpoints=4)).ys.q[-1, 3]
        >>> round(float(jax.grad(end)(0.1)), 6)
        7.0
    """

    checkpoints: int | None = eqx.field(static=True, default=None)
    needs_log: ClassVar[bool] = False

    def __check_init__(self):
        number = self.checkpoints
        if number is not None and (not isinstance(number, int) or number < 2):
            raise ValueError(
                "RecursiveCheckpointAdjoint: `checkpoints` must be an int >= 2 or "
                f"None, got {number!r}."
            )

    def run(self, loop: Loop, carry: AbstractCarry) -> _Run:
        """Run the loop from `carry`; return the last carry and all saved rows."""
        if not isinstance(loop.num_iterations, int):
            # Blocks serve only reverse mode, which needs a static number of iterations.
            return DirectAdjoint().run(loop, carry)
        if loop.stepper.may_end_early:
            return _run_until_over((loop, (carry, loop.empty_rows(carry))), self)
        return self.run_blocks(loop, (carry, loop.empty_rows(carry)))

    def run_blocks(self, loop: Loop, state: _Run) -> _Run:
        """Run a static number of iterations in nested blocks."""
        assert isinstance(loop.num_iterations, int)
        lengths = self._block_lengths(loop.num_iterations)
        steps: _Advance = partial(advance, loop)
        if loop.stepper.may_end_early or math.prod(lengths) > loop.num_iterations:
            steps = _idle_after_the_end(loop)
        for level, length in enumerate(reversed(lengths)):
            stride = math.prod(lengths[len(lengths) - level :])
            steps = _block(steps, length, stride, keep_all=level == 0)
        return steps(jnp.zeros((), jnp.int32), state)

    def _block_lengths(self, num_steps: int) -> list[int]:
        """List the number of iterations of each nested loop, the outermost first."""
        number = self.checkpoints
        number = math.isqrt(num_steps - 1) + 1 if number is None else number
        lengths, steps = [], num_steps
        while steps > max(number, 1):
            steps = -(-steps // number)
            lengths.append(number)
        lengths.append(steps)
        # Because the lengths were rounded up, whole blocks could lie beyond the end of
        # the run. The outermost level leaves these out.
        lengths[0] = -(-num_steps // math.prod(lengths[1:]))
        return lengths


def _block(advance: _Advance, length: int, stride: int, *, keep_all: bool) -> _Advance:
    """Return a function that calls `advance` `length` times, `stride` steps apart.

    Unless `keep_all`, the reverse pass stores only the states before these calls.
    """
    one = advance if keep_all else jax.checkpoint(advance, prevent_cse=False)

    def block(k, state):
        return jax.lax.fori_loop(
            np.int32(0),
            count(length),
            lambda i, state: one(k + np.int32(stride) * i, state),
            state,
        )

    return block


def _idle_after_the_end(loop: Loop) -> _Advance:
    """Return a variant of `advance` that is a no-op after the end of the run.

    This variant is needed if the loop or its last block extends beyond the end of the
    run.
    """

    def advance_or_idle(k, state):
        # The buffers are written outside of `jax.lax.cond`, whose branches would copy
        # them.
        carry, buffers = state
        no_rows = loop.no_rows(carry)
        is_within = k < loop.num_iterations
        if loop.stepper.may_end_early:
            is_within = is_within & ~loop.stepper.is_over(carry)
        carry, rows = jax.lax.cond(
            is_within,
            lambda carry: loop.step(carry, k),
            lambda carry: (carry, no_rows),
            carry,
        )
        return carry, loop.write(buffers, rows, k)

    return advance_or_idle


@eqx.filter_custom_jvp
def _run_until_over(arguments: tuple[Loop, _Run], adjoint: AbstractAdjoint) -> _Run:
    """Iterate until the run is over, at most `loop.num_iterations` times."""
    del adjoint
    loop, state = arguments
    start = jnp.zeros((), jnp.int32)
    return iterate_steps(loop, start, count(loop.num_iterations), state)


@_run_until_over.def_jvp
def _run_until_over_jvp(primals, tangents):
    # Reverse mode needs a loop of known length. Iterations after the end are no-ops.
    arguments, adjoint = primals
    rates, _ = tangents

    def run(arguments):
        loop, state = arguments
        if isinstance(adjoint, RecursiveCheckpointAdjoint):
            return adjoint.run_blocks(loop, state)
        end, steps = count(loop.num_iterations), _idle_after_the_end(loop)
        return jax.lax.fori_loop(np.int32(0), end, steps, state)

    return eqx.filter_jvp(run, (arguments,), (rates,))
