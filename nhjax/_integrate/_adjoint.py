"""Adjoints: how a run is differentiated in reverse mode, and which data it stores."""

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ._loop import Loop
from ._saving import Rows
from ._stepper import AbstractCarry


_Run: TypeAlias = tuple[AbstractCarry, Rows]
_Advance: TypeAlias = Callable[[Int[Array, ""], _Run], _Run]


class AbstractAdjoint(eqx.Module):
    """The way in which `integrate` is differentiated in reverse mode.

    An adjoint decides which data of the steps are stored for the reverse pass, and
    which are computed again.
    """

    @abstractmethod
    def run(self, loop: Loop, carry: AbstractCarry) -> _Run:
        """Run all steps of the loop from `carry`; return its end and all saved rows."""


def _advance(loop: Loop, k: Int[Array, ""], state: _Run) -> _Run:
    carry, buffers = state
    carry, rows = loop.step(carry, k)
    return carry, loop.write(buffers, rows, k)


def count(num_steps: int | Int[Array, ""]) -> Any:
    """Convert a number of steps to int32 for a loop. A Python int stays static."""
    return np.int32(num_steps) if isinstance(num_steps, int) else num_steps


class DirectAdjoint(AbstractAdjoint):
    """Store the stages of every step: memory O(num_steps), the shortest time.

    Forward mode (`jax.jvp`, `jax.jacfwd`, `jax.linearize`) and second derivatives
    (`jax.hessian`, and either mode over either) work as well. If `num_steps` is an
    array, only forward mode works.

    !!! note

        This differs from the `DirectAdjoint` of diffrax, which nests scans and
        checkpoints up to a maximum number of steps, and which diffrax advises against.
        In nhjax the number of steps is known, a plain loop runs all steps, and this
        adjoint is the default.

    !!! example

        >>> import jax, nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> def end(dt):
        ...     return nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...         disc.initial_state(), dt=dt, num_steps=10).ys.q[-1, 3]
        >>> round(float(jax.grad(end)(0.1)), 6)
        7.0
    """

    def run(self, loop: Loop, carry: AbstractCarry) -> _Run:
        """Run all steps of the loop from `carry`; return its end and all saved rows."""
        state = (carry, loop.empty_rows(carry))
        end = count(loop.num_iterations)
        return jax.lax.fori_loop(np.int32(0), end, partial(_advance, loop), state)


class RecursiveCheckpointAdjoint(AbstractAdjoint):
    """Store some states on the way, recompute the rest: memory O(sqrt(num_steps)).

    The steps are divided into `checkpoints` blocks, and each block again, until a block
    has at most `checkpoints` steps. The reverse pass works in one block of each
    level at a time. It stores the states at the starts of the smaller blocks inside,
    and the stages of the current block of the last level. By default there are two
    levels. Each level beyond the first costs another forward run. With L levels and
    num_steps = checkpoints^L the memory is O(L checkpoints).

    Forward mode, second derivatives and an array `num_steps` work as with
    `DirectAdjoint`.

    !!! note

        This differs from the `RecursiveCheckpointAdjoint` of diffrax. In diffrax a
        binomial scheme places checkpoints while the number of steps is not yet known,
        takes log(max_steps) checkpoints by default, and allows reverse mode only. In
        nhjax the number of steps is known and blocks have equal length. `checkpoints`
        is the number of blocks on one level, and the default is faster and needs more
        memory.

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

    def __check_init__(self):
        number = self.checkpoints
        if number is not None and (not isinstance(number, int) or number < 2):
            raise ValueError(
                "RecursiveCheckpointAdjoint: `checkpoints` must be an int >= 2 or "
                f"None, got {number!r}."
            )

    def run(self, loop: Loop, carry: AbstractCarry) -> _Run:
        """Run all steps of the loop from `carry`; return its end and all saved rows."""
        if not isinstance(loop.num_iterations, int):
            # Blocks are useful in reverse mode only, which needs a static length.
            return DirectAdjoint().run(loop, carry)
        lengths = self._block_lengths(loop.num_iterations)
        advance: _Advance = partial(_advance, loop)
        if math.prod(lengths) > loop.num_iterations:
            advance = _idle_after_the_end(loop)
        for level, length in enumerate(reversed(lengths)):
            stride = math.prod(lengths[len(lengths) - level :])
            advance = _block(advance, length, stride, keep_all=level == 0)
        state = (carry, loop.empty_rows(carry))
        return advance(jnp.zeros((), jnp.int32), state)

    def _block_lengths(self, num_steps: int) -> list[int]:
        """List the number of blocks on each level, the outermost level first."""
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
    """Return a function that calls `advance` `length` times, `stride` steps apart."""
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
    """Return a variant of `_advance` that is a no-op after the end of the run.

    It is needed if the last block extends beyond the end of the run.
    """

    def advance_or_idle(k, state):
        # The buffers are written outside of `jax.lax.cond`, whose branches would copy
        # them.
        carry, buffers = state
        no_rows = loop.no_rows(carry)
        carry, rows = jax.lax.cond(
            k < loop.num_iterations,
            lambda carry: loop.step(carry, k),
            lambda carry: (carry, no_rows),
            carry,
        )
        return carry, loop.write(buffers, rows, k)

    return advance_or_idle
