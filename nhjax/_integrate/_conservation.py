"""The invariants that a run keeps, and whether its system conserves them."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._compile import as_cpu_kernel
from .._custom_types import Args, BoolScalar, FloatScalar
from .._errors import DTypeError, naming, ShapeError
from .._numerics import (
    ClosureConverted,
    jacobian_sparsity,
    max_norm,
    square_jacobian,
    stop_gradient,
)
from .._step import invariant_values, Invariants, LEAST_PART
from .._system import (
    AbstractMechanicalSystem,
    check_signature,
    dtype_advice,
    linearise,
    no_array,
    noise_near,
    State,
)


# The rates of change of the invariants are checked at the initial state and at
# `_SAMPLES` states near it. `_SPREAD` is the size of the random displacements that lead
# to these states.
_SAMPLES, _SPREAD = 3, 0.3
# The number of Newton iterations that move these states onto the constraints on
# velocities. These constraints may be nonlinear.
_ITERATIONS = 5
# A rate of change below this many units of round-off per step counts as zero.
_UNITS = 1e3


def kept_invariants(
    invariants: str | Callable[..., Any] | None,
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    dt: FloatScalar,
    y: State,
    args: Args,
) -> Invariants | None:
    """Return the invariants that a run keeps, with their values at the initial state y.

    Raise a `TypeError` if `invariants` is not None, "energy" or a function. Raise a
    `ValueError` for "energy" if the system has a force or depends on time; the message
    gives the reason.
    """
    if invariants is None:
        return None
    u, function = system.fibre_coordinate(y), None
    if callable(invariants):
        _check_function(invariants, system, t, y, args)
        function = ClosureConverted(invariants, t, y.q, u, args)
    elif isinstance(invariants, str) and invariants == "energy":
        _require_conserved_energy(system, t, y.q, u, args)
    else:
        raise TypeError(
            '`invariants` must be None, "energy" or a function of (t, q, v, args) (of '
            f"a Hamiltonian system of (t, q, p, args)), got {invariants!r} of type "
            f"{type(invariants).__name__}."
        )
    value = invariant_values(function, system, t, y.q, u, args)
    given = function, system, t, dt, y.q, u, args, value
    noise, least_part = as_cpu_kernel(_noise_and_least_part, *given, is_brief=True)
    sizes = noise / float(jnp.finfo(value.dtype).eps)
    return Invariants(function, value, sizes, least_part)


def _noise_and_least_part(
    function, system, t, dt, q, u, args, value
) -> tuple[Float[Array, " k"], FloatScalar]:
    function, system, args = stop_gradient((function, system, args))
    noise = noise_near(
        lambda t, q, u: invariant_values(function, system, t, q, u, args),
        system.manifold_of(q),
        *(t, q, u, dt, value),
    )
    # Whether the mass matrix is definite is tested only at the initial state. It stays
    # definite or indefinite along the motion, because an eigenvalue that changes its
    # sign makes the matrix singular, which ends the run.
    t, q, u = stop_gradient((t, q, u))
    hessian = square_jacobian(lambda u: system.fibre_derivative(t, q, u, args), u)
    return noise, jnp.where(hessian.is_definite(), 0, LEAST_PART).astype(value.dtype)


def _check_function(
    function: Callable[..., Any],
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
) -> None:
    u, coordinate = system.fibre_coordinate(y), system.fibre_coordinate_name
    check_signature("integrate", "invariants", function, ("t", "q", coordinate, "args"))
    called = f"invariants(t, q, {coordinate}, args)"
    with naming(called, function, args):
        out = eqx.filter_eval_shape(function, t, y.q, u, args)
    shape, most = getattr(out, "shape", None), u.shape[0]
    if system.constraints == "independent":
        most -= y.multiplier.shape[0]
    if shape is None or len(shape) > 1 or not 1 <= math.prod(shape) <= most:
        got = no_array(out) if shape is None else f"shape {shape}."
        raise ShapeError(
            "`invariants` must return an array of shape () or (k,) with 1 <= k <= "
            f"{most}, the number of degrees of freedom, got {got}"
        )
    if out.dtype != u.dtype:
        raise DTypeError(
            f"`invariants` returns dtype {out.dtype}, but the state has {u.dtype}: "
            f"{dtype_advice(out.dtype)}"
        )


def _require_conserved_energy(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Array,
    args: Args,
) -> None:
    reason = None
    if system.force is not None:
        reason = "has a `force`, which may do work"
    for name in (system.generator, "holonomic"):
        function, given = system.functions(t, q, u, None, args).get(name, (None, ()))
        if function is not None and _depends_on_time(function, *given):
            reason = f"has a `{name}` that depends on time"
    if reason is not None:
        raise ValueError(
            f'`invariants="energy"`: the system {reason}, so that its energy is not '
            "conserved. If it conserves another quantity, pass that as a function."
        )


def _depends_on_time(function: Callable[..., Any], t: FloatScalar, *rest: Any) -> bool:
    """Return whether the program of a function uses its first argument, the time."""
    time = jnp.reshape(t, (1,))
    found = jacobian_sparsity(lambda t: jnp.atleast_1d(function(t[0], *rest)), time)
    return bool(np.any(found))


def conserves(
    system: AbstractMechanicalSystem,
    invariants: Invariants,
    t: FloatScalar,
    h: FloatScalar,
    y: State,
    args: Args,
) -> BoolScalar:
    """Return whether the invariants are constant along the motion, at y and near y.

    Their rate of change is computed at y and at some states near y: random
    displacements of y at times up to three steps later, moved onto the constraints on
    velocities. States that still violate these constraints are ignored, and so are
    states at which the equations of motion have no solution. With holonomic
    constraints, only the fibre coordinate (v or p) is displaced, because displaced
    positions and times may violate the constraints.
    """
    u0, manifold = system.fibre_coordinate(y), system.manifold_of(y.q)
    numbers = np.random.default_rng(0).standard_normal((2, _SAMPLES, u0.shape[0]))
    moves = np.concatenate([np.zeros_like(numbers[:, :1]), _SPREAD * numbers], axis=1)
    xi, w = jnp.asarray(moves, u0.dtype)
    steps = jnp.arange(_SAMPLES + 1, dtype=u0.dtype)
    if system.holonomic is not None:
        xi, steps = jnp.zeros_like(xi), jnp.zeros_like(steps)
    eps = float(jnp.finfo(u0.dtype).eps)
    small = eps**0.5

    def is_constant(t, xi, w):
        q = manifold.act(y.q, xi)

        def nearer(_, u):
            lin = linearise(system, t, q, u, args)
            excess = lin.delassus_inverse.matvec(lin.violation)
            return u - lin.reaction.matvec(excess)

        u = jax.lax.fori_loop(0, _ITERATIONS, nearer, u0 + w * (1 + jnp.abs(u0)))
        lin = linearise(system, t, q, u, args)
        v = system.velocity(t, q, u, args)
        by_time, by_position, by_fibre_coordinate = jax.jacrev(
            lambda t, xi, u: invariants.error(system, t, manifold.act(q, xi), u, args),
            argnums=(0, 1, 2),
        )(t, jnp.zeros_like(v), u)
        terms = jnp.concatenate(
            [
                by_time[:, None],
                by_position * v[None],
                by_fibre_coordinate * lin.acceleration[None],
            ],
            axis=1,
        )
        sizes = invariants.sizes(system, t, q, u, args, by_fibre_coordinate)
        noise = small * jnp.sum(jnp.abs(terms), axis=1) + _UNITS * eps * sizes / abs(h)
        is_off = max_norm(lin.violation) > small * (1 + max_norm(u))
        return is_off | ~jnp.any(jnp.abs(jnp.sum(terms, axis=1)) > noise)

    return jnp.all(jax.vmap(is_constant)(t + h * steps, xi, w))
