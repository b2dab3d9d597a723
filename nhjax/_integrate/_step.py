"""The function `nhjax.step`, for users who write their own time loop."""

from typing import Literal

import jax
import jax.numpy as jnp

from .._custom_types import Args, FloatScalarLike, PhaseFunction
from .._method import AbstractMethod
from .._numerics import nan_unless
from .._results import RESULTS
from .._step import AbstractStageSolver, SimplifiedNewton
from .._system import AbstractMechanicalSystem, check_type, real_scalar, State
from ._integrate import integrate


def step(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalarLike,
    dt: FloatScalarLike,
    y: State,
    args: Args = None,
    *,
    stage_solver: AbstractStageSolver = SimplifiedNewton(),
    throw: bool = True,
    invariants: Literal["energy"] | PhaseFunction | None = None,
) -> State:
    """Take one step of size `dt`, from the state `y` at `t` to the state at `t + dt`.

    The step solves the discrete equations of the paper (its four summaries), and its
    result is the same to the last bit as that of `integrate` with `num_steps=1`. Use it
    for control loops, environments and other time loops that `integrate` does not
    offer. It works under `jit`, `vmap`, `grad`, `jvp`, `hessian` and inside of
    `jax.lax.scan`. Over many steps `integrate` is faster and its rounding errors are
    smaller, because it sums q and p with a compensation that a `State` does not hold.

    **Arguments:**

    - `system`, `method`: as for `nhjax.integrate`.
    - `t`: the time of `y`.
    - `dt`: the step size, a scalar, in units of time; negative to go back.
    - `y`: a consistent state, from `nhjax.initial_state`, from a `Solution` or from a
        step before.
    - `args`: passed on to the functions of the system, for instance the controls that
        are held during the step.
    - `stage_solver`: `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `throw`: raise if the step cannot be solved. Otherwise all numbers of the state
        that is returned are NaN.
    - `invariants`: what the step keeps at its value in `y`, as for `nhjax.integrate`.

    **Returns:** the `State` at `t + dt`.

    **Raises:** as `nhjax.integrate` does.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> y, method = disc.initial_state(), nhjax.LobattoIIIAB(3)
        >>> y = nhjax.step(disc.system, method, t=0.0, dt=0.1, y=y)
        >>> y.q.shape
        (4,)
    """
    call = "Call it as `step(system, method, t, dt, y, args)`."
    check_type("y", y, State, f"Make one with nhjax.initial_state. {call}")
    t = real_scalar("t", t, jnp.result_type(float))
    sol = integrate(
        system,
        method,
        y,
        dt=dt,
        num_steps=1,
        t0=t,
        args=args,
        stage_solver=stage_solver,
        throw=throw,
        invariants=invariants,
    )
    end = jax.tree.map(lambda x: x[0], sol.ys)
    if throw:
        return end
    return nan_unless(sol.result == RESULTS.successful, end)
