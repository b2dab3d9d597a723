import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from ._custom_types import Args, FloatScalar, FloatScalarLike
from ._errors import is_traced, require
from ._iteration import root
from ._linearisation import linearise
from ._method import AbstractMethod
from ._state import State
from ._step_record import StepRecord
from ._system import LagrangianSystem


def interpolate(
    system: LagrangianSystem,
    method: AbstractMethod,
    record: StepRecord,
    t: FloatScalar,
    h: FloatScalar,
    theta: FloatScalar,
    args: Args,
) -> State:
    """The state at t + θ h inside a step that starts at t.

    q by the continuous collocation polynomial u(t), p by the mixed polynomial v(t) of
    the paper's appendix: both integrate the Lagrange basis on the nodes c_i.
    """
    start, time = record.start, t + theta * h
    weights = method.integrated_basis(theta)
    manifold = system.manifold_of(start.q)
    q = manifold.act(start.q, h * (weights @ record.velocity))
    p = start.p + h * (weights @ record.force)
    v = root(lambda u: system.momentum(time, q, u, args) - p, start.v).x
    if method.multiplier == "propagated":
        multiplier = method.basis(theta) @ record.multiplier
    else:
        multiplier = linearise(system, time, q, v, args).multiplier
    return State(q, v, p, multiplier)


class DenseInterpolation(eqx.Module):
    """The collocation polynomials of a whole trajectory.

    They are defined on [t0, t0 + num_steps dt]; use `Solution.evaluate`.
    """

    system: LagrangianSystem
    method: AbstractMethod = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    t0: FloatScalar
    dt: FloatScalar
    records: StepRecord
    args: Args

    def evaluate(self, t: FloatScalarLike) -> State:
        """The state at time `t`."""
        t = jnp.asarray(t)
        if t.ndim != 0:
            raise ValueError(
                f"`t` has shape {t.shape}, but one time is needed; for many use "
                "`jax.vmap(sol.evaluate)(ts)`."
            )
        t = t.astype(self.t0.dtype)
        if not is_traced(t, self.t0, self.dt):
            return _evaluate_jit(self, self._checked(t))
        return _evaluate(self, self._checked(t))

    def _checked(self, t: FloatScalar) -> FloatScalar:
        position = (t - self.t0) / self.dt
        slack = 1e-6
        return require(
            t,
            (position >= -slack) & (position <= self.num_steps + slack),
            lambda: ValueError(
                f"`t` = {float(t)} lies outside the run, from {float(self.t0)} to "
                f"{float(self.t0 + self.num_steps * self.dt)}."
            ),
            "Solution.evaluate: `t` lies outside the run.",
        )


def step_index(
    t: FloatScalar, t0: FloatScalar, dt: FloatScalar, num_steps: int
) -> Int[Array, ""]:
    """The index of the step that contains t."""
    k = jnp.floor((t - t0) / dt).astype(jnp.int32)
    return jnp.clip(k, 0, num_steps - 1)


def _evaluate(self: DenseInterpolation, t: FloatScalar) -> State:
    k = step_index(t, self.t0, self.dt, self.num_steps)
    record = jax.tree.map(lambda x: x[k], self.records)
    start = self.t0 + k.astype(t.dtype) * self.dt
    theta = (t - start) / self.dt
    return interpolate(
        self.system, self.method, record, start, self.dt, theta, self.args
    )


_evaluate_jit = eqx.filter_jit(_evaluate)


def require_collocation(method: AbstractMethod) -> None:
    """Raise unless the method is a collocation method, so that u(t) exists."""
    if method.orders.C < method.stages:
        raise ValueError(
            f"Dense output and `SaveAt(ts=...)` need a collocation method, one with "
            f"C(q) for q >= stages = {method.stages}; this tableau has "
            f"q = {method.orders.C}. Use LobattoIIIAB or Gauss, or save at steps."
        )
