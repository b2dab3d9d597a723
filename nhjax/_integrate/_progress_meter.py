"""Progress meters, which show on the host how many steps of a run are done."""

import sys
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import tqdm
from jaxtyping import Array, Int

from .._custom_types import FloatScalar


class AbstractProgressMeter(eqx.Module):
    """A progress meter, which shows how many steps of a run are done.

    Outside of transformations, `integrate` calls the meter between chunks of steps.
    Inside transformations, the compiled time loop calls it on the host. For your own
    meter, write a subclass with a method `update`.
    """

    @abstractmethod
    def update(self, done: int, total: int) -> None:
        """Show that `done` of `total` steps are complete.

        The loop calls this method on the host about a hundred times a run, and with
        done = total at the end.
        """

    def update_part(self, percent: int) -> None:
        """Show the percentage of the run that is done.

        In a run with variable steps, the loop calls this method, not `update`, each
        time the percentage has increased.
        """
        self.update(percent, 100)

    def close(self) -> None:
        """Close open resources, such as the bar of a run that was interrupted."""
        return

    @property
    def silent(self) -> bool:
        """Return whether the meter has no display; the loop then does not call it."""
        return False

    def report(self, k: Int[Array, ""], num_steps: int) -> None:
        """Report from inside a traced loop that step `k` is complete."""
        if self.silent:
            return
        # Each call leaves the compiled program. This is expensive, so there are only
        # about a hundred calls per run.
        every = max(1, num_steps // 100)
        done = k + 1

        def callback(done):
            self.update(int(done), num_steps)

        jax.lax.cond(
            (done % every == 0) | (done == num_steps) | (k == 0),
            lambda: jax.debug.callback(callback, done),
            lambda: None,
        )

    def report_part(self, before: FloatScalar, after: FloatScalar) -> None:
        """Report from inside a traced loop the percentage done, if it has increased.

        `before` and `after` are the parts of the run that are done before and after a
        step, from 0 to 1. For a batch, the part of its slowest member is reported.
        """
        if self.silent:
            return
        # The members of a batch differ in progress, but are reported as one run.
        old, new = (_least((100 * x).astype(jnp.int32)) for x in (before, after))

        def callback(percent):
            self.update_part(int(percent))

        jax.lax.cond(new > old, lambda: jax.debug.callback(callback, new), lambda: None)


@jax.custom_batching.custom_vmap
def _least(x: Int[Array, ""]) -> Int[Array, ""]:
    """Return x, or in a batch the least x of all members."""
    return x


@_least.def_vmap
def _least_of_batch(
    size: int, is_batched: list[bool], x: Int[Array, " k"]
) -> tuple[Int[Array, ""], bool]:
    del size
    return _least(jnp.min(x, axis=0)) if is_batched[0] else _least(x), False


class NoProgressMeter(AbstractProgressMeter):
    """A progress meter without a display, the default of `integrate`.

    !!! example

        >>> import nhjax
        >>> nhjax.NoProgressMeter().update(50, 100)
    """

    @property
    def silent(self) -> bool:
        """Return True: this meter has no display."""
        return True

    def update(self, done: int, total: int) -> None:
        """Do nothing."""


class TextProgressMeter(AbstractProgressMeter):
    """A progress meter that prints a line for every tenth of the run.

    !!! example

        >>> import nhjax
        >>> nhjax.TextProgressMeter().update(50, 100)
        50 of 100 steps
    """

    _printed: "_Printed" = eqx.field(static=True, init=False, repr=False)

    def __init__(self):
        self._printed = _Printed()

    def update(self, done: int, total: int) -> None:
        """Print the number of complete steps, after each tenth of the run."""
        # `done` grows by a hundredth of the run, and may skip the exact tenths.
        tenth, apart = max(1, total // 10), max(1, total // 100)
        if done == total or (done >= tenth and done % tenth < apart):
            print(f"{done} of {total} steps", flush=True)

    def update_part(self, percent: int) -> None:
        """Print the percentage of the run that is done, after about each tenth."""
        if percent // 10 > self._printed.tenth or percent < 10 * self._printed.tenth:
            print(f"{percent} % of the run", flush=True)
        self._printed.tenth = percent // 10


class TqdmProgressMeter(AbstractProgressMeter):
    """A progress meter that shows a tqdm bar on the standard error stream.

    **Arguments:**

    - `description`: the text before the bar.
    - `unit`: the unit of the count, in the singular: `"member"` for `nhjax.ensemble`.

    !!! example

        >>> import nhjax
        >>> meter = nhjax.TqdmProgressMeter("pendulum")
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=100, progress_meter=meter)
    """

    description: str = eqx.field(static=True, default="")
    unit: str = eqx.field(static=True, default="step")
    _open: "_Open" = eqx.field(static=True, init=False, repr=False)

    def __init__(self, description: str = "", unit: str = "step"):
        self.description = description
        self.unit = unit
        self._open = _Open()

    def update(self, done: int, total: int) -> None:
        """Move the bar to `done` steps, and close it at the end of the run."""
        bar = self._open.bars.get(total)
        if bar is None:
            # The speed that the bar shows must not count steps before the bar opened.
            bar = self._open.bars[total] = tqdm.tqdm(
                total=total,
                initial=done,
                desc=self.description,
                unit=self.unit,
                file=sys.stderr,
            )
        bar.n = max(bar.n, done)
        bar.refresh()
        if done == total:
            bar.close()
            del self._open.bars[total]

    def close(self) -> None:
        """Close all open bars at their current values."""
        for bar in self._open.bars.values():
            bar.close()
        self._open.bars.clear()


class _Printed:
    """The tenth of a run that was printed last.

    All instances are equal, so that `jax.jit` does not recompile for each instance.
    """

    def __init__(self):
        self.tenth = 0

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Printed)


class _Open:
    """The open bars of a meter; the keys are the numbers of steps of their runs.

    The bars are state on the host. All instances are equal and have the same hash, so
    that `jax.jit` does not recompile a program for each instance.
    """

    def __init__(self):
        self.bars: dict[int, Any] = {}

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Open)
