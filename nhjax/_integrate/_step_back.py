"""A step back: the state that a step started from, found from its end."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._custom_types import FloatScalar
from .._numerics import iterate, max_norm, Sizes
from .._step import StepState
from .._system import State
from ._stepping import Stepping


class AbstractStepInterval(eqx.Module):
    """The time interval of a step that is to be retraced."""

    @property
    @abstractmethod
    def start(self) -> FloatScalar:
        """Return the time at which the step started."""

    @property
    @abstractmethod
    def end(self) -> FloatScalar:
        """Return the time at which the step ended."""

    @property
    @abstractmethod
    def size(self) -> FloatScalar:
        """Return the size of the step."""


class WholeStep(AbstractStepInterval):
    """The time interval of step k of a run without events."""

    stepping: Stepping
    k: Int[Array, ""]

    @property
    def start(self) -> FloatScalar:
        """Return the time t_k at which the step started."""
        return self.stepping.time(self.k)

    @property
    def end(self) -> FloatScalar:
        """Return the time t_{k+1} at which the step ended."""
        return self.stepping.time(self.k + 1)

    @property
    def size(self) -> FloatScalar:
        """Return the step size dt."""
        return self.stepping.dt


class PartOfStep(AbstractStepInterval):
    """The time interval of a part of a step, from a time `since`, of some `length`."""

    since: FloatScalar
    length: FloatScalar

    @property
    def start(self) -> FloatScalar:
        """Return the time at which the step started."""
        return self.since

    @property
    def end(self) -> FloatScalar:
        """Return the time at which the step ended."""
        return self.since + self.length

    @property
    def size(self) -> FloatScalar:
        """Return the size of the step."""
        return self.length


def step_back(
    stepping: Stepping, step_state: StepState, interval: AbstractStepInterval
) -> StepState:
    """Compute the state that a step started from, given the one that it led to."""
    go_on = jnp.asarray(False)

    def back_from(step_state: StepState) -> StepState:
        t, h = interval.end, -interval.size
        return stepping.one_step(step_state, t, h, go_on).step_state

    if _retraces(stepping, step_state):
        return back_from(step_state)

    # Let y be the end of a step back from z. Each sweep moves z by the difference
    # between `step_state` and the end of the step forward from y. The two steps undo
    # each other up to a small error, so that this iteration contracts far faster than
    # one that moves y would.
    target = step_state.state
    manifold = stepping.system.manifold_of(target.q)
    propagated = stepping.method.closure == "propagated"

    def sweep(z: State):
        y = back_from(eqx.tree_at(lambda x: x.state, step_state, z))
        t, h = interval.start, interval.size
        reached = stepping.one_step(y, t, h, go_on).step_state.state
        to_reached = manifold.inverse(reached.q)
        xi = manifold.local(manifold.compose(to_reached, target.q))
        misses = [xi, target.p - reached.p]
        multiplier = z.multiplier
        if propagated:
            miss = target.multiplier - reached.multiplier
            misses.append(interval.size * miss)
            multiplier = multiplier + miss
        size = max_norm(*misses)
        z = State(manifold.act(z.q, xi), z.v, z.p + misses[1], multiplier)
        return z, Sizes(size), y

    scale = 1 + max_norm(target.p)
    limit = stepping.stage_solver.max_iterations
    return iterate(sweep, target, scale, max_iterations=limit).aux


def _retraces(stepping: Stepping, step_state: StepState) -> bool:
    """Tell whether a step of -h undoes a step of h, up to round-off."""
    system, method = stepping.system, stepping.method
    is_flat = system.manifold_of(step_state.state.q).is_flat
    if not is_flat and method.chart != "middle":
        return False
    if system.nonholonomic is not None and method.closure == "consistent":
        return False
    return method.is_symmetric
