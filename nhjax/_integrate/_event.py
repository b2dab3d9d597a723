"""Events: zeros of functions along a trajectory, and the actions taken there."""

import reprlib
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Args, BoolScalar, FloatScalar
from .._errors import DTypeError, naming, ShapeError
from .._method import AbstractMethod
from .._numerics import ClosureConverted, NOISE_DEVIATIONS, tree_where
from .._results import RESULTS
from .._step import first_step_state, StepState
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    check_flag,
    check_type,
    configuration,
    floating,
    linearise,
    noise_near,
    State,
)
from ._progress import Progress, Sides
from ._saving import SaveAt
from ._stepper import is_consistent, Stepping


class Event(eqx.Module):
    """A zero of a function along a trajectory, and what happens there.

    `integrate(..., event=...)` finds the zeros of `cond_fn(t, y, args)` by its sign at
    the ends of the steps. The step in which the sign changes is repeated with the size
    θ dt, 0 < θ <= 1, at whose end the function vanishes to round-off, so that the state
    at the event is the end of a step of the method. The size is differentiated by the
    implicit function theorem. Then the run ends, or goes on with the rest of the step,
    after a `reset` of the state if there is one.

    At `t0` and right after an event a function that is zero has the sign of its rate
    along the motion: what starts on a surface and leaves it does not meet it there. A
    function that touches zero within a step and has the same sign at both ends is not
    seen.

    **Arguments:**

    - `cond_fn`: a function (t, y, args) of a `State` that returns a real scalar. The
        multiplier of y is the continuous one, as of `nhjax.continuous_multiplier`.
    - `direction`: meet zeros where the function increases along the run (True), where
        it decreases (False), or both (None).
    - `reset`: a function (t, y, args) of the state at the event that returns the state
        to go on with: a pair (q, v), for a Hamiltonian system (q, p), or a `State`. It
        must satisfy the constraints.
    - `terminate`: end the run at the event, after its reset; by default True without a
        `reset`, and False with one. With False and no `reset` zeros are found and
        reported alone.
    - `max_events`: how many events a run has room for, an int >= 1; of several events
        the sum counts. One more ends the run with `RESULTS.too_many_events`. With
        `terminate` it is 1.

    **Raises:** `TypeError` or `ValueError` for arguments of a wrong type or value.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> ball = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - q[0])
        >>> bounce = nhjax.Event(lambda t, y, args: y.q[0], direction=False,
        ...     reset=lambda t, y, args: (y.q, -0.5 * y.v))
        >>> y0 = nhjax.initial_state(ball, jnp.array([0.5]), jnp.array([0.0]))
        >>> sol = nhjax.integrate(ball, nhjax.LobattoIIIAB(2), y0, dt=0.3, num_steps=5,
        ...     event=bounce)
        >>> int(sol.events.num), round(float(sol.events.ts[0]), 6)
        (1, 1.0)
    """

    cond_fn: Callable[[Any, Any, Any], Any]
    direction: bool | None = eqx.field(static=True)
    reset: Callable[[Any, Any, Any], Any] | None
    terminate: bool = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    def __init__(
        self,
        cond_fn: Callable[[Any, Any, Any], Any],
        *,
        direction: bool | None = None,
        reset: Callable[[Any, Any, Any], Any] | None = None,
        terminate: bool | None = None,
        max_events: int = 32,
    ):
        for name, function in (("cond_fn", cond_fn), ("reset", reset)):
            if not callable(function) and (name == "cond_fn" or function is not None):
                raise TypeError(
                    f"Event: `{name}` must be a function (t, y, args), got "
                    f"{function!r}."
                )
        if direction is not None:
            direction = check_flag("direction", direction)
        if terminate is None:
            terminate = reset is None
        if not isinstance(max_events, int | np.integer) or max_events < 1:
            raise ValueError(
                f"Event: `max_events` must be an int >= 1, got {max_events!r}."
            )
        self.cond_fn, self.reset, self.direction = cond_fn, reset, direction
        self.terminate = check_flag("terminate", terminate)
        self.max_events = 1 if self.terminate else int(max_events)


def _as_events(event: Any) -> tuple[Event, ...] | None:
    """Return the events of a run as a tuple, or None if there are none."""
    if event is None:
        return None
    events = tuple(event) if isinstance(event, list | tuple) else event
    if not isinstance(events, tuple):
        events = (events,)
    advice = "Such as nhjax.Event(cond_fn), or a sequence of them."
    for one in events:
        check_type("event", one, Event, advice)
    return events or None


def checked_events(
    event: Event | Sequence[Event] | None, saveat: SaveAt, invariants: object
) -> tuple[Event, ...] | None:
    """Return the events of a run, or raise if something asked for goes without them."""
    events = _as_events(event)
    if events is not None and saveat.checkpoint:
        raise ValueError(
            "SaveAt: `checkpoint=True` is not available together with `event`, since "
            "the run may end between two nodes. Go on from its last state with the "
            "`t0` that is `sol.t1`."
        )
    if events is not None and invariants is not None:
        raise ValueError(
            "`invariants` are not available together with `event`, since a reset "
            "changes them. Leave out one of the two."
        )
    if events is not None and (saveat.dense or saveat.ts is not None):
        option = "dense=True" if saveat.dense else "ts=..."
        raise ValueError(
            f"SaveAt: `{option}` is not available together with `event`, since a step "
            "that is cut has two polynomials. Save at `steps`; `Solution.events` has "
            "the times and states of the events, and runs from one to the next have "
            "dense output."
        )
    return events


class Conditions(eqx.Module):
    """The functions whose zeros are the events of a run, of e events.

    `directions` are 1 for events where a function increases, -1 where it decreases, and
    0 for both.
    """

    functions: tuple[ClosureConverted, ...]
    directions: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: FloatScalar, y: State, args: Args) -> Float[Array, " e"]:
        """Compute all conditions at a state with the continuous multiplier."""
        return jnp.stack([function(t, y, args) for function in self.functions])

    def crossed(
        self, sign: Float[Array, " e"], values: Float[Array, " e"]
    ) -> Bool[Array, " e"]:
        """Tell which conditions went from `sign` to zero or beyond, as is asked."""
        directions = jnp.asarray(self.directions, sign.dtype)
        return (sign != 0) & (sign * values <= 0) & (sign * directions <= 0)


def conditions_of(
    events: tuple[Event, ...], t: FloatScalar, y: State, args: Args
) -> Conditions:
    """Make the conditions of events, or raise for a function of a wrong kind."""
    for i, event in enumerate(events):
        _check(i, event, t, y, args)
    directions = {None: 0, True: 1, False: -1}
    return Conditions(
        tuple(ClosureConverted(event.cond_fn, t, y, args) for event in events),
        tuple(directions[event.direction] for event in events),
    )


def _check(i: int, event: Event, t: FloatScalar, y: State, args: Args) -> None:
    """Raise unless the condition of an event returns a scalar of the state's dtype."""
    called = "cond_fn(t, y, args)"
    with naming(f"Event {i}: {called}", event.cond_fn, args):
        out = eqx.filter_eval_shape(event.cond_fn, t, y, args)
    name = f"Event {i}: `{called}`"
    shape, dtype = getattr(out, "shape", None), getattr(out, "dtype", None)
    if shape is None or dtype is None:
        raise ShapeError(
            f"{name} must return an array of shape (), a scalar, got "
            f"{reprlib.repr(out)} of type {type(out).__name__}."
        )
    if shape != ():
        raise ShapeError(
            f"{name} must return shape (), a scalar, got shape {shape}; for several "
            "conditions give `event` a sequence of events."
        )
    if dtype != y.p.dtype:
        advice = "constants of another precision inside it?"
        if dtype == jnp.bool_:
            advice = "return a real number whose zero is the event."
        raise DTypeError(
            f"{name} returns dtype {dtype}, but the state has {y.p.dtype}: {advice}"
        )


def with_continuous_multiplier(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalar,
    y: State,
    args: Args,
) -> State:
    """Return the state with the multiplier λ_c, which most closures give it anyway."""
    if method.closure != "propagated":
        return y
    u = system.fibre_coordinate(y)
    lin = linearise(system, t, y.q, u, args, may_be_sparse=True)
    return State(y.q, y.v, y.p, lin.multiplier)


def sides_at(
    conditions: Conditions,
    stepping: Stepping,
    t: FloatScalar,
    step_state: StepState,
    round_off: Float[Array, " e"] | None = None,
) -> tuple[Sides, BoolScalar]:
    """Find the sides of all conditions at a state, and whether all are finite.

    A condition that the motion would bring to zero, or has left zero, within a small
    part of a step counts as zero; so does one that is not larger than its `round_off`,
    which is measured unless it is given.
    """
    step_state = jax.lax.stop_gradient(step_state)
    system, dt, args = stepping.system, stepping.dt, stepping.args
    y, lin = step_state.state, step_state.lin
    u = system.fibre_coordinate(y)
    manifold = system.manifold_of(y.q)

    def values_at(t, q, u):
        v, p = system.velocity(t, q, u, args), system.momentum(t, q, u, args)
        lin = linearise(system, t, q, u, args, may_be_sparse=True)
        return conditions(t, State(q, v, p, lin.multiplier), args)

    rates = jnp.ones_like(t), y.v, lin.acceleration
    _, rate = jax.jvp(
        lambda t, xi, u: values_at(t, manifold.act(y.q, xi), u),
        (t, jnp.zeros_like(u), u),
        rates,
    )
    bound = round_off
    if bound is None:
        bound = NOISE_DEVIATIONS * noise_near(values_at, manifold, t, y.q, u, rate)
    y = with_continuous_multiplier(system, stepping.method, t, y, args)
    values = conditions(t, y, args)
    small = float(jnp.finfo(values.dtype).eps) ** 0.5
    # A rate that is infinite, as that of a root, makes nothing zero that is not.
    near = jnp.isfinite(rate) & (jnp.abs(values) <= small * jnp.abs(rate * dt))
    at_zero = near | ((jnp.abs(values) <= bound) & ~jnp.isnan(rate))
    value = jnp.where(at_zero, rate * jnp.sign(dt), values)
    sides = Sides(jnp.sign(value), value, at_zero)
    return jax.lax.stop_gradient((sides, jnp.all(jnp.isfinite(values))))


class AfterEvent(NamedTuple):
    """What follows from an event: the state to go on with, and what is known there."""

    step_state: StepState
    sides: Sides
    pending: Bool[Array, " e"]
    result: RESULTS


class Consequences(eqx.Module):
    """What follows from each of the events of a run.

    `max_events` is the number of events that the run has room for.
    """

    resets: tuple[ClosureConverted | None, ...]
    terminates: tuple[bool, ...] = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    @property
    def ends_only(self) -> bool:
        """Tell whether every event ends the run, and none resets the state.

        Then there is no log to be kept on the way.
        """
        return all(self.terminates) and not any(self.resets)

    def after_event(
        self,
        conditions: Conditions,
        stepping: Stepping,
        fires: BoolScalar,
        which: Int[Array, ""],
        t: FloatScalar,
        step_state: StepState,
        value: FloatScalar,
        before: Progress,
    ) -> AfterEvent:
        """Find what follows from an event; nothing follows unless it `fires`.

        Its condition has this `value`, zero up to round-off.
        """
        ends = jnp.asarray(self.terminates)[which]
        result = RESULTS.where(ends, RESULTS.event_occurred, RESULTS.successful)
        nothing = AfterEvent(step_state, before.sides, before.pending, result)
        if self.ends_only:
            return nothing

        def reset() -> AfterEvent:
            resets = [partial(_reset, stepping, x, t, step_state) for x in self.resets]
            after, consistent = jax.lax.switch(which, resets)
            others = jnp.arange(len(self.resets), dtype=jnp.int32) != which
            round_off = jnp.where(others, 0, jnp.abs(value))
            sides, known = sides_at(conditions, stepping, t, after, round_off)
            turned = conditions.crossed(before.sides.sign, sides.sign)
            pending = (before.pending | (turned & (sides.sign != 0))) & others
            found = RESULTS.where(known, result, RESULTS.nonfinite_event)
            found = RESULTS.where(consistent, found, RESULTS.inconsistent_reset)
            after = tree_where(consistent, after, step_state)
            return AfterEvent(after.differentiated_in_state(), sides, pending, found)

        return jax.lax.cond(fires, reset, lambda: nothing)


def consequences_of(
    events: tuple[Event, ...],
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
) -> Consequences:
    """Make the consequences of events, or raise for a reset of a wrong kind."""
    resets = [
        ClosureConverted(partial(completed, system, i, event.reset), t, y, args)
        if event.reset is not None
        else None
        for i, event in enumerate(events)
    ]
    terminates = tuple(event.terminate for event in events)
    room = sum(event.max_events for event in events)
    # A run of which all events are the end has at most one.
    return Consequences(tuple(resets), terminates, 1 if all(terminates) else room)


def _reset(
    stepping: Stepping,
    reset: ClosureConverted | None,
    t: FloatScalar,
    step_state: StepState,
) -> tuple[StepState, BoolScalar]:
    """Reset the state at an event; tell whether the result is consistent."""
    system, method, args = stepping.system, stepping.method, stepping.args
    if reset is None:
        return step_state, jnp.ones((), bool)
    y = with_continuous_multiplier(system, method, t, step_state.state, args)
    y = with_continuous_multiplier(system, method, t, reset(t, y, args), args)
    after = first_step_state(system, method, t, y, args)
    assert stepping.round_off is not None
    violations = stepping.round_off.violations
    return after, all_finite(y) & is_consistent(system, t, after, args, violations)


def completed(
    system: AbstractMechanicalSystem,
    i: int,
    reset: Callable[[Any, Any, Any], Any],
    t: FloatScalar,
    y: State,
    args: Args,
) -> State:
    """Make a state of what a reset returns, a pair (q, u) or a state."""
    name = system.fibre_coordinate_name
    called = f"Event {i}: `reset(t, y, args)`"
    with naming(f"Event {i}: reset(t, y, args)", reset, args):
        out = reset(t, y, args)
    if isinstance(out, tuple | list) and len(out) == 2:
        q, u = configuration(out[0]), floating(name, out[1])
        _check_part(called, "q", q, y.q)
        _check_part(called, name, u, y.p)
        v, p = system.velocity(t, q, u, args), system.momentum(t, q, u, args)
        return State(q, v, p, y.multiplier)
    if not isinstance(out, State):
        raise TypeError(
            f"{called} must return a pair (q, {name}) or an nhjax.State, got "
            f"{reprlib.repr(out)} of type {type(out).__name__}."
        )
    for part in ("q", "v", "p", "multiplier"):
        _check_part(called, part, getattr(out, part), getattr(y, part))
    return out


def _check_part(called: str, name: str, got: Any, like: Any) -> None:
    """Raise unless a part of what a reset returned has the arrays of a state's."""

    def tree(x: Any) -> Any:
        return jax.tree.structure(x)

    if tree(got) != tree(like) or not all(map(eqx.is_array, jax.tree.leaves(got))):
        raise TypeError(
            f"{called} returned the `{name}` {reprlib.repr(got)} of type "
            f"{type(got).__name__}, but it must be as in the state that it is given: "
            f"{reprlib.repr(like)}."
        )
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(like), strict=True):
        if x.shape != y.shape:
            raise ShapeError(
                f"{called} returned a `{name}` with an array of shape {x.shape}, but "
                f"the state that it is given has shape {y.shape} there."
            )
        if x.dtype != y.dtype:
            raise DTypeError(
                f"{called} returned a `{name}` of dtype {x.dtype}, but the state that "
                f"it is given has {y.dtype}: constants of another precision inside it?"
            )
