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

from ..._custom_types import Args, BoolScalar, FloatScalar
from ..._errors import DTypeError, naming, ShapeError
from ..._method import AbstractMethod
from ..._numerics import ClosureConverted, NOISE_DEVIATIONS, tree_where
from ..._results import RESULTS
from ..._step import first_step_state, StepState
from ..._system import (
    AbstractMechanicalSystem,
    all_finite,
    check_flag,
    check_signature,
    check_type,
    configuration,
    dtype_advice,
    floating,
    linearise,
    no_array,
    noise_near,
    State,
)
from .._saving import SaveAt
from .._stepper import is_consistent, PlainStepper


class Event(eqx.Module):
    """An event: a zero of a function along a trajectory, and the action taken there.

    `integrate(..., event=...)` finds the zeros of `cond_fn(t, y, args)` from its signs
    at the ends of the steps. If the sign changes in a step, the step is repeated with a
    size θ dt, 0 < θ <= 1, such that the function is zero, up to round-off, at the end
    of the step. So the state at the event is the end of a step of the method. The size
    θ dt is differentiated by the implicit function theorem. If there is a `reset`, it
    resets the state at the event. Then the run ends, or continues with the rest of the
    step.

    If the function is zero at `t0` or right after an event, the sign of its rate along
    the motion is used instead. So a trajectory that starts at a zero and leaves it does
    not trigger the event at the start. If the function touches zero within a step and
    has the same sign at both ends, the event is not detected.

    **Arguments:**

    - `cond_fn`: a function (t, y, args) of a `State` that returns a real scalar. The
        multiplier of y is the continuous multiplier, the value of
        `nhjax.continuous_multiplier`.
    - `direction`: detect zeros where the function increases along the run (True), where
        it decreases (False), or both (None).
    - `reset`: a function (t, y, args) of the state at the event. It returns the state
        from which the run continues, as a pair (q, v), or (q, p) for a Hamiltonian
        system, or as a `State`. The new state must satisfy the constraints.
    - `terminate`: end the run at the event, after its reset. The default is True
        without a `reset`, and False with a `reset`. With False and no `reset`, events
        are only reported.
    - `max_events`: the largest number of events in a run, an int >= 1. The limits of
        several events add up; exceeding the total ends the run with
        `RESULTS.too_many_events`. With `terminate` it is 1.

    **Raises:** `TypeError` or `ValueError` for arguments of a wrong type or value, and
    for functions that do not take (t, y, args) in this order.

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
            if name == "cond_fn" or function is not None:
                check_signature("Event", name, function, ("t", "y", "args"))
        if not isinstance(direction, bool | np.bool_ | None):
            raise TypeError(
                "Event: `direction` must be True or False, for functions that increase "
                f"or decrease, or None for both, got {direction!r}."
            )
        if terminate is None:
            terminate = reset is None
        if not isinstance(max_events, int | np.integer) or max_events < 1:
            raise ValueError(
                f"Event: `max_events` must be an int >= 1, got {max_events!r}."
            )
        self.cond_fn, self.reset = cond_fn, reset
        self.direction = None if direction is None else bool(direction)
        self.terminate = check_flag("terminate", terminate)
        self.max_events = 1 if self.terminate else int(max_events)


def _as_events(event: Any) -> tuple[Event, ...] | None:
    """Return the events of a run as a tuple, or None if there are none."""
    if event is None:
        return None
    events = tuple(event) if isinstance(event, list | tuple) else event
    if not isinstance(events, tuple):
        events = (events,)
    advice = "For example, pass nhjax.Event(cond_fn), or a sequence of events."
    for one in events:
        check_type("event", one, Event, advice)
    return events or None


def checked_events(
    event: Event | Sequence[Event] | None, saveat: SaveAt, invariants: object
) -> tuple[Event, ...] | None:
    """Return the events of a run; raise if an option cannot be combined with them."""
    events = _as_events(event)
    if events is not None and saveat.checkpoint:
        raise ValueError(
            "SaveAt: `checkpoint=True` is not available together with `event`, because "
            "the run may end between two nodes. Start another run from the last state, "
            "with `t0=sol.t1`."
        )
    if events is not None and invariants is not None:
        raise ValueError(
            "`invariants` are not available together with `event`, because a reset "
            "changes them. Leave out one of the two."
        )
    if events is not None and (saveat.dense or saveat.ts is not None):
        option = "dense=True" if saveat.dense else "ts=..."
        raise ValueError(
            f"SaveAt: `{option}` is not available together with `event`, because a "
            "step with an event in it has two polynomials. Save at `steps`, or use the "
            "times and states in `Solution.events` for runs from one event to the next "
            "with dense output."
        )
    return events


class ConditionSigns(eqx.Module):
    """The sign of each condition where a step starts.

    - `sign`: the sign, 0 if it is not known.
    - `value`: the condition's value or, if `at_zero`, its rate times the sign of dt.
    - `at_zero`: whether the condition is zero and takes the sign of its rate.
    """

    sign: Float[Array, " e"]
    value: Float[Array, " e"]
    at_zero: Bool[Array, " e"]

    def after_step(
        self, at_node: BoolScalar, values: Float[Array, " e"]
    ) -> "ConditionSigns":
        """Return the signs after a step: new signs at a node, otherwise the old signs.

        `at_node` is whether the step ends at a node t_k and not at an event. `values`
        are the conditions at this node. A condition that is zero keeps its old sign.
        """
        sign = jnp.where(values == 0, self.sign, jnp.sign(values))
        return ConditionSigns(
            sign=jnp.where(at_node, sign, self.sign),
            value=jnp.where(at_node, values, self.value),
            at_zero=self.at_zero & ~at_node,
        )

    def scale(self, h: FloatScalar) -> Float[Array, " e"]:
        """Compute |condition| or, where it is zero, its change in a step of size h."""
        value = jnp.where(self.at_zero, self.value * h, self.value)
        return jax.lax.stop_gradient(jnp.abs(value))


class Conditions(eqx.Module):
    """The functions whose zeros are the e events of a run.

    `directions` are 1 for events where a function increases, -1 where it decreases, and
    0 for both.
    """

    functions: tuple[ClosureConverted, ...]
    directions: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls, events: tuple[Event, ...], t: FloatScalar, y: State, args: Args
    ) -> "Conditions":
        """Return the conditions of events; raise if a function returns a wrong type."""
        for i, event in enumerate(events):
            _check_condition(i, event, t, y, args)
        directions = {None: 0, True: 1, False: -1}
        return cls(
            tuple(ClosureConverted(event.cond_fn, t, y, args) for event in events),
            tuple(directions[event.direction] for event in events),
        )

    def __call__(self, t: FloatScalar, y: State, args: Args) -> Float[Array, " e"]:
        """Compute all conditions at a state with the continuous multiplier."""
        return jnp.stack([function(t, y, args) for function in self.functions])

    def crossed(
        self, sign: Float[Array, " e"], values: Float[Array, " e"]
    ) -> Bool[Array, " e"]:
        """Return which conditions went from `sign` to zero or beyond.

        Conditions count only in the direction that the user asked for.
        """
        directions = jnp.asarray(self.directions, sign.dtype)
        return (sign != 0) & (sign * values <= 0) & (sign * directions <= 0)


def _check_condition(
    i: int, event: Event, t: FloatScalar, y: State, args: Args
) -> None:
    """Raise unless the condition of an event returns a scalar of the state's dtype."""
    called = "cond_fn(t, y, args)"
    with naming(f"Event {i}: {called}", event.cond_fn, args):
        out = eqx.filter_eval_shape(event.cond_fn, t, y, args)
    name = f"Event {i}: `{called}`"
    shape, dtype = getattr(out, "shape", None), getattr(out, "dtype", None)
    if shape is None or dtype is None:
        raise ShapeError(
            f"{name} must return an array of shape (), a scalar, got {no_array(out)}"
        )
    if shape != ():
        raise ShapeError(
            f"{name} must return shape (), a scalar, got shape {shape}; for several "
            "conditions give `event` a sequence of events."
        )
    if dtype != y.p.dtype:
        advice = dtype_advice(dtype)
        if dtype == jnp.bool_:
            advice = "return a real number whose zero is the event."
        raise DTypeError(
            f"{name} returns dtype {dtype}, but the state has {y.p.dtype}: {advice}"
        )


def signs_at(
    conditions: Conditions,
    stepper: PlainStepper,
    t: FloatScalar,
    step_state: StepState,
    round_off: Float[Array, " e"] | None = None,
) -> tuple[ConditionSigns, BoolScalar]:
    """Compute the signs of all conditions at a state, and whether all are finite.

    A condition counts as zero if, changing at its present rate, it was or will be zero
    within a small part of a step. It also counts as zero if its absolute value is at
    most its `round_off`. If `round_off` is None, it is measured.
    """
    step_state = jax.lax.stop_gradient(step_state)
    system, dt, args = stepper.system, stepper.dt, stepper.args
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
        bound = NOISE_DEVIATIONS * noise_near(values_at, manifold, t, y.q, u, dt, rate)
    y = with_continuous_multiplier(system, stepper.method, t, y, args)
    values = conditions(t, y, args)
    small = float(jnp.finfo(values.dtype).eps) ** 0.5
    # An infinite rate, such as the rate of a square root at zero, does not make a
    # condition zero.
    near = jnp.isfinite(rate) & (jnp.abs(values) <= small * jnp.abs(rate * dt))
    at_zero = near | ((jnp.abs(values) <= bound) & ~jnp.isnan(rate))
    value = jnp.where(at_zero, rate * jnp.sign(dt), values)
    signs = ConditionSigns(jnp.sign(value), value, at_zero)
    return jax.lax.stop_gradient((signs, jnp.all(jnp.isfinite(values))))


def with_continuous_multiplier(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalar,
    y: State,
    args: Args,
) -> State:
    """Return the state with the continuous multiplier λ_c.

    States of a run have it already, except with `closure="propagated"`.
    """
    if not method.carries_multiplier:
        return y
    u = system.fibre_coordinate(y)
    lin = linearise(system, t, y.q, u, args, may_be_sparse=True)
    return State(y.q, y.v, y.p, lin.multiplier)


class EventOutcome(NamedTuple):
    """The outcome of the action of an event.

    - `step_state`: the state from which the run continues.
    - `signs`: the signs of the conditions at this state.
    - `pending`: the conditions that a reset has carried across zero.
    - `result`: whether the run continues, ends or fails.
    """

    step_state: StepState
    signs: ConditionSigns
    pending: Bool[Array, " e"]
    result: RESULTS


class EventActions(eqx.Module):
    """The actions of events: a reset of the state, and the end of the run.

    An event may have both actions, one or none. The reset comes before the end.

    `max_events` is the largest number of events in the run.
    """

    resets: tuple[ClosureConverted | None, ...]
    terminates: tuple[bool, ...] = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        events: tuple[Event, ...],
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        y: State,
        args: Args,
    ) -> "EventActions":
        """Return the actions of events; raise if a reset returns a wrong type."""
        resets = [
            ClosureConverted(
                partial(state_from_reset, system, i, event.reset), t, y, args
            )
            if event.reset is not None
            else None
            for i, event in enumerate(events)
        ]
        terminates = tuple(event.terminate for event in events)
        room = sum(event.max_events for event in events)
        # If every event ends the run, at most one event occurs.
        return cls(tuple(resets), terminates, 1 if all(terminates) else room)

    @property
    def only_end(self) -> bool:
        """Return whether every event ends the run and none resets the state.

        In this case the run keeps no log.
        """
        return all(self.terminates) and not any(self.resets)

    def apply(
        self,
        conditions: Conditions,
        stepper: PlainStepper,
        fires: BoolScalar,
        which: Int[Array, ""],
        t: FloatScalar,
        step_state: StepState,
        value: FloatScalar,
        signs: ConditionSigns,
        pending: Bool[Array, " e"],
    ) -> EventOutcome:
        """Apply the action of event `which` if it `fires`; otherwise do nothing.

        `value` is the value of the event's condition, zero up to round-off. After a
        reset, values of this size count as zero, so that the event does not occur
        again at once. `signs` and `pending` are the signs and the pending conditions at
        the start of the step that led to the event.
        """
        ends = jnp.asarray(self.terminates)[which]
        result = RESULTS.where(ends, RESULTS.event_occurred, RESULTS.successful)
        unchanged = EventOutcome(step_state, signs, pending, result)
        if self.only_end:
            return unchanged

        def reset() -> EventOutcome:
            resets = [partial(_reset, stepper, x, t, step_state) for x in self.resets]
            after, consistent = jax.lax.switch(which, resets)
            others = jnp.arange(len(self.resets), dtype=jnp.int32) != which
            round_off = jnp.where(others, 0, jnp.abs(value))
            new, known = signs_at(conditions, stepper, t, after, round_off)
            turned = conditions.crossed(signs.sign, new.sign)
            waiting = (pending | (turned & (new.sign != 0))) & others
            found = RESULTS.where(known, result, RESULTS.nonfinite_event)
            found = RESULTS.where(consistent, found, RESULTS.inconsistent_reset)
            after = tree_where(consistent, after, step_state)
            return EventOutcome(after.differentiated_in_state(), new, waiting, found)

        return jax.lax.cond(fires, reset, lambda: unchanged)


def _reset(
    stepper: PlainStepper,
    reset: ClosureConverted | None,
    t: FloatScalar,
    step_state: StepState,
) -> tuple[StepState, BoolScalar]:
    """Reset the state at an event; also return whether the new state is consistent."""
    system, method, args = stepper.system, stepper.method, stepper.args
    if reset is None:
        return step_state, jnp.ones((), bool)
    y = with_continuous_multiplier(system, method, t, step_state.state, args)
    y = with_continuous_multiplier(system, method, t, reset(t, y, args), args)
    after = first_step_state(system, method, t, y, args)
    assert stepper.noise is not None
    violations = stepper.noise.violations
    return after, all_finite(y) & is_consistent(system, t, after, args, violations)


def state_from_reset(
    system: AbstractMechanicalSystem,
    i: int,
    reset: Callable[[Any, Any, Any], Any],
    t: FloatScalar,
    y: State,
    args: Args,
) -> State:
    """Call a reset, which returns a pair (q, u) or a state, and return the state."""
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
    """Raise unless a part of a reset state has the shapes and dtypes of `like`."""

    def tree(x: Any) -> Any:
        return jax.tree.structure(x)

    if tree(got) != tree(like) or not all(map(eqx.is_array, jax.tree.leaves(got))):
        raise TypeError(
            f"{called} returned the `{name}` {reprlib.repr(got)} of type "
            f"{type(got).__name__}, but it must have the form that it has in `y`: "
            f"{reprlib.repr(like)}."
        )
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(like), strict=True):
        if x.shape != y.shape:
            raise ShapeError(
                f"{called} returned a `{name}` with an array of shape {x.shape}, but "
                f"in `y` this array has shape {y.shape}."
            )
        if x.dtype != y.dtype:
            raise DTypeError(
                f"{called} returned a `{name}` of dtype {x.dtype}, but `y` has "
                f"{y.dtype}: write its constants in the precision of the state."
            )
