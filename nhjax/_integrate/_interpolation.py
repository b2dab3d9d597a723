"""Dense output: the collocation polynomials of the steps."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Args, FloatScalar, FloatScalarLike
from .._errors import Check, require
from .._method import AbstractMethod
from .._numerics import max_norm, root
from .._step import chart_of_step, StepRecord
from .._system import AbstractMechanicalSystem, linearise, real_scalar, State


def interpolate(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    record: StepRecord,
    t: FloatScalar,
    h: FloatScalar,
    theta: FloatScalar,
    args: Args,
) -> State:
    """Compute the state at t + θ h, inside a step that starts at t.

    The configuration q is the value of the continuous collocation polynomial u(t), and
    the momentum p is the value of the mixed polynomial v(t) of the paper's appendix.
    Both polynomials are integrals of polynomials that interpolate stage values at the
    nodes c_i: the stage velocities for u(t), and the forces for v(t).
    """
    start, time = record.start, t + theta * h
    weights = method.integrated_basis(theta)
    whole = h * (jnp.asarray(method.b, h.dtype) @ record.velocity)
    manifold = system.manifold_of(start.q)
    chart = chart_of_step(manifold, method.chart, start.q, whole)
    y = chart.coordinates(h * (weights @ record.velocity)[None])
    known = chart.momentum_at_origin(start.p) + h * (weights @ record.force)
    q = chart.position(y[0])
    p = chart.from_origin(y, known[None])[0]
    u = p
    if system.fibre_coordinate_name == "v":
        u = root(
            lambda u: system.momentum(time, q, u, args) - p, start.v, max_norm(start.v)
        ).x
    v = system.velocity(time, q, u, args)
    if method.carries_multiplier:
        multiplier = method.basis(theta) @ record.multiplier
    else:
        multiplier = linearise(system, time, q, u, args, may_be_sparse=True).multiplier
    return State(q, v, p, multiplier)


class DenseInterpolation(eqx.Module):
    """The collocation polynomials of a whole trajectory, one for each of its steps.

    They are defined from t0 to t0 + num_steps dt or, with variable steps, to the end of
    the run. `integrate` creates an instance if `SaveAt(dense=True)` is given; users
    evaluate the polynomials by `Solution.evaluate`.
    """

    method: AbstractMethod = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    t0: FloatScalar
    dt: FloatScalar
    records: StepRecord
    # The number of steps with valid records; None in a run with constant steps.
    count: Int[Array, ""] | None
    # The system and args are stored as a list of their arrays, a tuple of their other
    # leaves and the structure of the tree, because `jax.jit` and `jax.vmap` cannot
    # return functions.
    _arrays: list[Array]
    _rest: tuple[Any, ...] = eqx.field(static=True)
    _treedef: Any = eqx.field(static=True)

    def __init__(
        self,
        system: AbstractMechanicalSystem,
        method: AbstractMethod,
        num_steps: int,
        t0: FloatScalar,
        dt: FloatScalar,
        records: StepRecord,
        args: Args,
        count: Int[Array, ""] | None = None,
    ):
        self.method, self.num_steps, self.count = method, num_steps, count
        self.t0, self.dt, self.records = t0, dt, records
        leaves, self._treedef = jax.tree.flatten((system, args))
        self._arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        self._rest = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)

    @property
    def _system_and_args(self) -> tuple[AbstractMechanicalSystem, Args]:
        arrays = iter(self._arrays)
        leaves = [next(arrays) if leaf is None else leaf for leaf in self._rest]
        return jax.tree.unflatten(self._treedef, leaves)

    def evaluate(self, t: FloatScalarLike) -> State:
        """Compute the state at time `t`, which must lie inside the run."""
        batch = self.records.force.shape[:-3]
        if batch:
            raise ValueError(
                f"This solution is a batch of shape {batch}: evaluate each member, "
                "`jax.vmap(lambda sol: sol.evaluate(t))(sol)`."
            )
        t = real_scalar("t", t, self.t0.dtype)
        if self.records.interval is not None and self.count is not None:
            starts, sizes = self.records.interval
            last = self.count - 1
            end = starts[last] + sizes[last]
            inside = is_within(t, self.t0, end)
            t = require(t, Check(inside, _outside_of_steps, (t, self.t0, end)))
            return _evaluate(self, t)
        _, inside = step_position(t, self.t0, self.dt, self.num_steps)
        run = (t, self.t0, self.dt, self.num_steps)
        t = require(t, Check(inside, _outside, run))
        return _evaluate(self, t)


def _outside(
    t: np.ndarray, t0: np.ndarray, dt: np.ndarray, num_steps: int
) -> ValueError:
    return ValueError(
        f"Solution.evaluate: `t` = {float(t)} lies outside the run, from {float(t0)} "
        f"to {float(t0 + num_steps * dt)}."
    )


def _outside_of_steps(t: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> ValueError:
    return ValueError(
        f"Solution.evaluate: `t` = {float(t)} lies outside the run, from {float(t0)} "
        f"to {float(t1)}."
    )


def is_within(
    t: Float[Array, "*k"], t0: FloatScalar, t1: FloatScalar
) -> Bool[Array, "*k"]:
    """Return which times lie between t0 and t1, or outside only by round-off."""
    slack = 8 * float(jnp.finfo(t.dtype).eps) * jnp.maximum(jnp.abs(t0), jnp.abs(t1))
    least, most = jnp.minimum(t0, t1) - slack, jnp.maximum(t0, t1) + slack
    return (t >= least) & (t <= most)


def step_among(
    t: FloatScalar,
    interval: tuple[Float[Array, " k"], Float[Array, " k"]],
    count: Int[Array, ""] | int,
) -> Int[Array, ""]:
    """Find the index of the step that contains the time t, among variable steps.

    `interval` has the starts and the sizes of the steps, of which the first `count` are
    valid.
    """
    starts, sizes = interval
    forward = jnp.sign(sizes[0])
    is_before = forward * starts <= forward * t
    is_valid = jnp.arange(starts.shape[0], dtype=jnp.int32) < count
    number = jnp.sum(is_before & is_valid, dtype=jnp.int32)
    return jnp.maximum(number - 1, 0)


def step_position(
    t: Float[Array, "*k"], t0: FloatScalar, dt: FloatScalar, num_steps: int
) -> tuple[Float[Array, "*k"], Bool[Array, "*k"]]:
    """Return times as numbers of steps since t0, and which of them lie in the run.

    Times that lie outside of the run only by round-off count as inside.
    """
    position = (t - t0) / dt
    # The slack covers rounding errors, which are proportional to the largest time.
    steps = num_steps + jnp.abs(t0 / dt)
    slack = jnp.maximum(1e-6, 8 * jnp.finfo(t.dtype).eps * steps)
    return position, (position >= -slack) & (position <= num_steps + slack)


def step_index(
    t: FloatScalar, t0: FloatScalar, dt: FloatScalar, num_steps: int
) -> Int[Array, ""]:
    """Find the index of the step that contains the time t."""
    k = jnp.floor((t - t0) / dt).astype(jnp.int32)
    return jnp.clip(k, 0, num_steps - 1)


@eqx.filter_jit
def _evaluate(self: DenseInterpolation, t: FloatScalar) -> State:
    intervals = self.records.interval
    if intervals is not None and self.count is not None:
        k = step_among(t, intervals, self.count)
    else:
        k = step_index(t, self.t0, self.dt, self.num_steps)
    record = jax.tree.map(lambda x: x[k], self.records)
    start, h = record.interval or (self.t0 + k.astype(t.dtype) * self.dt, self.dt)
    system, args = self._system_and_args
    return interpolate(system, self.method, record, start, h, (t - start) / h, args)


def require_collocation(method: AbstractMethod) -> None:
    """Raise unless the method is a collocation method, as `interpolate` requires."""
    if method.stages > method.orders.C:
        raise ValueError(
            f"Dense output and `SaveAt(ts=...)` need a collocation method, one with "
            f"C(q) for q >= stages = {method.stages}; this tableau has "
            f"q = {method.orders.C}. Use LobattoIIIAB or Gauss, or save at steps."
        )
