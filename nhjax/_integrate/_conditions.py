"""The conditions of events as one function, and their signs where a step starts."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Args, BoolScalar, FloatScalar
from .._errors import DTypeError, naming, ShapeError
from .._method import AbstractMethod
from .._numerics import ClosureConverted, NOISE_DEVIATIONS
from .._step import StepState
from .._system import (
    AbstractMechanicalSystem,
    dtype_advice,
    linearise,
    no_array,
    noise_near,
    State,
)
from ._event import Event
from ._sides import Sides
from ._stepping import Stepping


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
