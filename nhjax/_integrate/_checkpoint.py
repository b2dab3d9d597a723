"""Checkpoints, from which a later run continues an earlier run bit for bit."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._errors import Check, is_traced, ShapeError
from .._numerics import max_norm, tree_where
from .._step import StepState
from .._system import (
    AbstractMechanicalSystem,
    check_state,
    check_type,
    Linearisation,
    State,
)


# Steps are counted in int32.
MOST_STEPS = 2**31 - 1


class Checkpoint(eqx.Module):
    """All data that a later run needs to continue an earlier run bit for bit.

    A `State` is not enough for this. The run adds up q and p by compensated sums, and
    also carries the rounding errors of these sums. It counts its times t_k = t0 + k dt
    from the start t0 of the first run. Each step uses the linearised equations of
    motion that the previous step computed at its end. `SaveAt(checkpoint=True)` saves a
    checkpoint, `integrate` accepts a checkpoint in place of a state, and `nhjax.save`
    writes it to a file.

    - `state`: the last state of the run; if the run failed, the last good state.
    - `q_compensation`, `p_compensation`: the rounding errors of the sums q and p.
    - `linearisation`: the arrays of the linearised equations of motion at the state.
    - `round_off`: the round-off of the system's functions, measured in the first run.
    - `t0`: the time from which steps are counted, the start of the first run.
    - `dt`: the step size.
    - `num_steps`: the number of steps taken since `t0`.
    - `clock`: the data of the `stepsize_controller`; empty after a run with constant
        steps. After a run with variable steps, `t0` is the time at the end of the run,
        and `num_steps` is zero.

    Under `vmap` every array has the batch as its leading axis. Derivatives pass through
    `state`, `t0` and `dt`.

    The bits of a result depend on the compiled instructions. A run in parts equals a
    run in one piece bit for bit if all runs save the same output and use the same
    releases of JAX and nhjax on the same machine. Under `jit` the run in one piece must
    also save a checkpoint, as all parts except the last do. Otherwise the results agree
    up to round-off. Dense output and the samples of `SaveAt(ts=...)` also agree only up
    to round-off, because each part counts time from its own start.

    !!! example

        >>> import nhjax
        >>> disc, method = nhjax.systems.VerticalRollingDisc(), nhjax.LobattoIIIAB(3)
        >>> half = nhjax.integrate(disc.system, method, disc.initial_state(), dt=0.1,
        ...     num_steps=50, saveat=nhjax.SaveAt(checkpoint=True))
        >>> sol = nhjax.integrate(disc.system, method, half.checkpoint, dt=0.1,
        ...     num_steps=50)
        >>> whole = nhjax.integrate(disc.system, method, disc.initial_state(), dt=0.1,
        ...     num_steps=100, saveat=nhjax.SaveAt(t1=True, checkpoint=True))
        >>> bool((sol.ys.q == whole.ys.q).all())
        True
    """

    state: State
    q_compensation: PyTree[Array]
    p_compensation: Float[Array, "*b n"]
    linearisation: tuple[Array, ...]
    round_off: tuple[Array, ...]
    t0: Float[Array, "*b"]
    dt: Float[Array, "*b"]
    num_steps: Int[Array, "*b"]
    clock: tuple[Array, ...] = ()

    @property
    def t(self) -> Float[Array, "*b"]:
        """Return the time of the state, t0 + num_steps dt."""
        return self.t0 + self.num_steps.astype(self.dt.dtype) * self.dt


class Origin(NamedTuple):
    """The origin of the times t_k = t0 + (first_step + k) dt + shift of a run.

    The shift is zero unless the step size changes at the checkpoint from which the run
    starts.
    """

    t0: FloatScalar
    first_step: Int[Array, ""]
    shift: FloatScalar


def start_of(
    y0: State | Checkpoint, t0: FloatScalar, dt: FloatScalar
) -> tuple[State, Origin]:
    """Return the state of `y0` and the origin of the times of a run.

    `t0` is the time of the state.
    """
    if isinstance(y0, State):
        return y0, Origin(t0, jnp.zeros((), jnp.int32), jnp.zeros_like(dt))
    shift = y0.num_steps.astype(dt.dtype) * (y0.dt - dt)
    return y0.state, Origin(y0.t0, y0.num_steps, shift)


def time_of(y0: State | Checkpoint, t0: FloatScalarLike | None) -> FloatScalarLike:
    """Return the time of `y0`; `t0` is the argument of `integrate`."""
    if isinstance(y0, State):
        return 0.0 if t0 is None else t0
    if t0 is not None:
        raise ValueError(
            "`t0` is given together with a checkpoint, which has its own time. Leave "
            "out `t0`, or start from `y0.state` at another time."
        )
    return y0.t


_ADVICE = (
    "Create one with nhjax.initial_state. The last state of a solution is "
    "`jax.tree.map(lambda x: x[-1], sol.ys)`. For an example of the gallery, use "
    "`machine.initial_state()`."
)


def check_start(
    system: AbstractMechanicalSystem, y0: State | Checkpoint, args: Args
) -> State:
    """Return the state of `y0`, which is a state or a checkpoint.

    Raise if `y0` is something else, or belongs to another system.
    """
    check_type("y0", y0, (State, Checkpoint), _ADVICE)
    if isinstance(y0, State):
        check_state(system, y0)
        return y0
    y = y0.state
    check_state(system, y, "y0.state")
    scalar = jax.ShapeDtypeStruct((), y.p.dtype)
    on_positions = jax.eval_shape(lambda: system.position_constraint(y0.t, y.q, args))
    expected = {
        "q_compensation": system.manifold_of(y.q).no_compensation(y.q),
        "p_compensation": y.p,
        "round_off": (y.p, y.p, y.multiplier, on_positions),
        "t0": scalar,
        "dt": scalar,
        "num_steps": jax.ShapeDtypeStruct((), jnp.int32),
    }
    for name, like in expected.items():
        _check_arrays(name, getattr(y0, name), like)
    return y


def _check_arrays(name: str, got: PyTree[Array], like: PyTree[Any]) -> None:
    def kinds(tree):
        return [(x.shape, str(x.dtype)) for x in jax.tree.leaves(tree)]

    if kinds(got) != kinds(like):
        raise ShapeError(
            f"`y0.{name}` has arrays of (shape, dtype) {kinds(got)}, but "
            f"{kinds(like)} is needed: the checkpoint belongs to another system, or it "
            "was changed. For many runs, use `jax.vmap` over the checkpoint."
        )


def countable_from(y0: State | Checkpoint, num_steps: int | Array) -> list[Check]:
    """Return the check that the count of steps since the origin fits into int32."""
    if isinstance(y0, State):
        return []
    numbers = y0.num_steps, num_steps
    numpy: Any = jnp if is_traced(*numbers) else np
    first, number = (numpy.asarray(x, numpy.int32) for x in numbers)
    ok = (first >= 0) & (first <= MOST_STEPS - number)
    return [Check(ok, _too_many, (first, number))]


def _too_many(first: np.ndarray, number: np.ndarray) -> ValueError:
    return ValueError(
        f"`y0.num_steps` = {first} and `num_steps` = {number} are more than 2^31 - 1 "
        "steps together. Start from `y0.state` at `t0=y0.t` instead."
    )


def resumed(y0: Checkpoint, fresh: StepState) -> StepState:
    """Return the step state from which a resumed run starts.

    `fresh` is the step state of a run from `y0.state`. The linearisation of `fresh`
    replaces the linearisation of the checkpoint if the matrices of the two differ by
    more than eps^(1/4), relative to their sizes. This can happen if the run continues
    with another system or other args.
    """
    new, structure = jax.tree.flatten(fresh.lin)
    _check_arrays("linearisation", y0.linearisation, new)
    old = jax.tree.unflatten(structure, y0.linearisation)
    same = _agree(old, fresh.lin)
    lin = jax.lax.stop_gradient(tree_where(same, old, fresh.lin))
    return StepState(y0.state, y0.q_compensation, y0.p_compensation, lin)


def _agree(old: Linearisation, new: Linearisation) -> BoolScalar:
    """Return whether the matrices of two linearisations agree up to eps^(1/4)."""
    pairs = [
        pair
        for name in (
            "fibre_hessian_inverse",
            "jacobian",
            "reaction",
            "delassus_inverse",
        )
        for pair in zip(
            jax.tree.leaves(getattr(old, name)),
            jax.tree.leaves(getattr(new, name)),
            strict=True,
        )
    ]
    # The bound is far above eps, because an ill-conditioned inverse has few correct
    # digits. If the differences are below the bound, the stage solver converges equally
    # well with the Jacobian of the checkpoint and with a fresh Jacobian.
    small = float(jnp.finfo(pairs[0][0].dtype).eps) ** 0.25
    close = [max_norm(x - y) <= small * (max_norm(x) + max_norm(y)) for x, y in pairs]
    return jnp.all(jnp.stack(close))
