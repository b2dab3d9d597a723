"""The sizes of the terms of constraints, and the round-off of the system's functions.

A violation of a constraint is an error only if it is larger than the round-off of the
terms that cancel in the constraint. This file estimates the sizes of these terms from
derivatives, and measures the round-off of functions at nearby points.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._manifold import AbstractLieGroup
from .._numerics import (
    JacobianMatrix,
    max_norm,
    measured_noise,
    NOISE_DEVIATIONS,
    nonzero_or_one,
    stop_gradient,
)
from ._linearisation import Linearisation
from ._systems import AbstractMechanicalSystem, State


def violation_scale(
    system: AbstractMechanicalSystem,
    lin: Linearisation,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> Float[Array, " l"]:
    """Estimate how large the terms of each row of Φ are for vectors as large as u.

    The estimate treats Φ as affine in u. The terms at u itself may be too small for a
    scale: a constraint such as v[1] has a single term, which is round-off in every
    state that satisfies the constraint. If u is zero, the size of u is taken as one,
    since terms that cancel have round-off at rest too.
    """
    return velocity_scale(system, lin.jacobian, t, q, u, args)


def velocity_scale(
    system: AbstractMechanicalSystem,
    jacobian: JacobianMatrix,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> Float[Array, " l"]:
    """Estimate the sizes of the terms of Φ from `jacobian` = ∂Φ/∂u and Φ at u = 0."""
    affine = _finite_or_zero(system.constraint(t, q, jnp.zeros_like(u), args))
    return jacobian.absolute_row_sums() * nonzero_or_one(max_norm(u)) + affine


def position_scale(
    system: AbstractMechanicalSystem, t: FloatScalar, q: PyTree[Array], args: Args
) -> Float[Array, " k"]:
    """Estimate how large the terms of each row of Γ are for vectors as large as q.

    The estimate treats Γ as affine in q. The terms at q itself may be too small for a
    scale; see `violation_scale`. If q is zero, its size is taken as one.
    """
    size = nonzero_or_one(max_norm(*jax.tree.leaves(q)))
    sizes = jax.tree.map(lambda x: jnp.full_like(x, size), q)
    return _affine_terms(system, t, q, args, sizes)


def position_terms(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    args: Args,
    lin: Linearisation,
) -> Float[Array, " k"]:
    """Estimate, row by row, how large the terms of Γ are at q.

    These terms, times the unit round-off, bound the change of Γ if each entry of q is
    rounded. Entries that Γ does not depend on do not count, although they can be large,
    such as the position of a machine far from the origin. If the linearisation `lin` at
    q is sparse and belongs to a Lagrangian system, its derivatives of Γ are used.
    """
    sizes = jax.tree.map(jnp.abs, q)
    if lin.is_sparse and lin.fibre_coordinate_name == "v":
        products = lin.jacobian.absolute().matvec(ravel_pytree(sizes)[0])
        return products + _terms_at_zero(system, t, q, args)
    return _affine_terms(system, t, q, args, sizes)


def _affine_terms(system, t, q, args, sizes: PyTree[Array]) -> Float[Array, " k"]:
    """Compute Σ_j |∂Γ/∂q_j| s_j + |Γ(0)| for sizes s of the entries of q."""
    constant = _terms_at_zero(system, t, q, args)
    if system.holonomic is None:
        return constant
    slopes = jax.jacrev(lambda q: system.position_constraint(t, q, args))(q)
    terms = jax.tree.map(
        lambda slope, size: jnp.tensordot(jnp.abs(slope), size, axes=size.ndim),
        slopes,
        sizes,
    )
    return sum(jax.tree.leaves(terms)) + constant


def _terms_at_zero(system, t, q, args) -> Float[Array, " k"]:
    """Compute the sizes of the terms of Γ that do not depend on q."""
    zero = jax.tree.map(jnp.zeros_like, q)
    return _finite_or_zero(system.position_constraint(t, zero, args))


def keeps_constraints(
    system: AbstractMechanicalSystem,
    lin: Linearisation,
    t: FloatScalar,
    y: State,
    args: Args,
    small: FloatScalarLike,
    round_off: tuple[Float[Array, " l"], Float[Array, " k"]] | None,
) -> BoolScalar:
    """Return whether all constraints hold at y, up to `small` times their terms.

    Larger violations are allowed too, up to the two bounds in `round_off`: the first is
    for constraints on velocities, the second for constraints on positions.
    """
    u = system.fibre_coordinate(y)
    positions = system.position_constraint(t, y.q, args)
    on_velocities = small * violation_scale(system, lin, t, y.q, u, args)
    on_positions = small * position_scale(system, t, y.q, args)
    if round_off is not None:
        on_velocities = jnp.maximum(on_velocities, round_off[0])
        on_positions = jnp.maximum(on_positions, round_off[1])
    return jnp.all(jnp.abs(lin.violation) <= on_velocities) & jnp.all(
        jnp.abs(positions) <= on_positions
    )


def _finite_or_zero(x: Array) -> Array:
    # x are constraints at q = 0 or u = 0. A value that is not finite does not show how
    # large the terms of the constraint are, so it is replaced by 0.
    return jnp.abs(jnp.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0))


class FunctionNoise(NamedTuple):
    """The round-off of the functions of a system at a state, for each component.

    The functions are the momentum, the free force, all constraints on velocities and
    the holonomic constraints on positions. With a `direction` of u, `function_noise`
    adds `slopes`, the round-off of the derivatives of all constraints along it.
    """

    momentum: Float[Array, " n"]
    force: Float[Array, " n"]
    on_velocities: Float[Array, " l"]
    on_positions: Float[Array, " k"]
    slopes: Float[Array, " l"] | None = None

    @property
    def violations(self) -> tuple[Float[Array, " l"], Float[Array, " k"]]:
        """Return bounds on the violations of constraints that round-off can cause."""
        parts = self.on_velocities, self.on_positions
        on_velocities, on_positions = (NOISE_DEVIATIONS * x for x in parts)
        return on_velocities, on_positions


def function_noise(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    multiplier: Float[Array, " l"],
    args: Args,
    dt: FloatScalarLike,
    direction: Float[Array, " n"] | None = None,
) -> FunctionNoise:
    """Measure the round-off of the functions of a system at (t, q, u).

    The force is measured with a constant multiplier; `dt` is passed on to `noise_near`.
    """
    # `eval_shape` does not get `args`, which may contain objects that are not arrays.
    positions = jax.eval_shape(lambda: system.position_constraint(t, q, args))
    system, args, multiplier = stop_gradient((system, args, multiplier))

    def values(t, q, u):
        slopes = None
        if direction is None:
            constraint = system.constraint(t, q, u, args)
        else:

            def along(u):
                return system.constraint(t, q, u, args)

            constraint, slopes = jax.jvp(along, (u,), (direction,))
        return FunctionNoise(
            system.momentum(t, q, u, args),
            system.free_force(t, q, u, multiplier, args),
            constraint,
            system.position_constraint(t, q, args),
            slopes,
        )

    slopes = None if direction is None else multiplier
    like = FunctionNoise(u, u, multiplier, positions, slopes)
    return noise_near(values, system.manifold_of(q), t, q, u, dt, like)


def noise_near(
    function: Callable[[FloatScalar, PyTree[Array], Float[Array, " n"]], PyTree[Array]],
    manifold: AbstractLieGroup,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    dt: FloatScalarLike,
    like: PyTree[Array | jax.ShapeDtypeStruct],
) -> PyTree[Array]:
    """Measure the round-off of a function of (t, q, u) near a state.

    `dt` is a time step that resolves the motion. If `dt` is shorter than the unit of
    time, times are displaced in units of `dt`, because prescribed motions can be fast.
    If `dt` is longer, velocities and momenta are displaced in units of 1 / `dt`,
    because the motion can be slow. `like` has the structure, shapes and dtype of the
    results; see `measured_noise`.
    """
    (t, q, u, dt), n = stop_gradient((t, q, u, dt)), u.shape[0]
    dt = jnp.abs(dt)
    short = jnp.minimum(dt, 1).astype(t.dtype)
    slow = (1 / jnp.maximum(dt, 1)).astype(u.dtype)
    # Angles are reduced to the first turn, because angles of many turns have more
    # round-off.
    q = manifold.wrapped(q, manifold.no_compensation(q))

    def displaced(z):
        dt, xi, du = z[0], z[1 : n + 1], z[n + 1 :]
        return function(t + short * dt, manifold.act(q, xi), u + slow * du)

    return measured_noise(displaced, 2 * n + 1, like)
