"""The accelerations and reactions of the continuous equations at one state."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._compile import tracked_jit
from .._custom_types import Args, FloatScalar, FloatScalarLike
from .._errors import is_traced
from .._numerics import inverse, nan_unless
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    check_state,
    check_time_and_state,
    check_type,
    HamiltonianSystem,
    LagrangianSystem,
    linearise,
    parameters,
    real_scalar,
    require_independent,
    State,
)


class Motion(eqx.Module):
    """The continuous motion of a system at one state: its accelerations and reactions.

    - `acceleration`: the rate v̇ of the velocity, shape (n,); on a group that of the
        body velocity.
    - `momentum_rate`: the rate ṗ of the momentum, shape (n,).
    - `multiplier`: the multiplier λ_c, shape (l,) with l = m + k: m nonholonomic
        constraints, then k holonomic ones.
    - `reaction`: the generalised force λᵀB of all constraints, shape (n,).
    - `mass_matrix`: M = ∂p/∂v, shape (n, n).
    - `constraint_jacobian`: B = ∂Φ/∂v, shape (l, n), with the rates of the holonomic
        constraints as its last rows.
    - `is_unique`: which multipliers the equations determine, shape (l,). Of redundant
        constraints it is false for all that depend on others, whose reactions are one
        choice of many: that of the least norm. Their sum `reaction` is unique.

    A generalised force has the unit that makes its product with a coordinate a work: N
    for a coordinate in m, N m for an angle. A multiplier is a force in N if its
    constraint is a velocity in m/s or a distance in m.
    """

    acceleration: Float[Array, " n"]
    momentum_rate: Float[Array, " n"]
    multiplier: Float[Array, " l"]
    reaction: Float[Array, " n"]
    mass_matrix: Float[Array, "n n"]
    constraint_jacobian: Float[Array, "l n"]
    is_unique: Bool[Array, " l"]

    @property
    def reaction_of_each(self) -> Float[Array, "l n"]:
        """Return the generalised force λ_a B_a of each constraint, one a row."""
        return self.multiplier[:, None] * self.constraint_jacobian

    @property
    def compatibility_matrix(self) -> Float[Array, "l l"]:
        """Return C = B M⁻¹ Bᵀ, the paper's compatibility matrix (section 3)."""
        b = self.constraint_jacobian
        return b @ jnp.linalg.solve(self.mass_matrix, b.T)

    @property
    def constrained_mass_matrix(self) -> Float[Array, "r r"]:
        """Return [[M, -Bᵀ], [B, 0]], the matrix of the equations for (v̇, λ)."""
        b = self.constraint_jacobian
        zero = jnp.zeros((b.shape[0], b.shape[0]), b.dtype)
        return jnp.block([[self.mass_matrix, -b.T], [b, zero]])


def motion(
    system: AbstractMechanicalSystem, t: FloatScalarLike, y: State, args: Args = None
) -> Motion:
    """Compute accelerations, multipliers and reaction forces at a state.

    They solve the continuous equations of motion (the paper's section 3) together with
    the hidden constraints,

    M v̇ - Bᵀ λ = ad*_v p + D1L + F - (∂t + D1 v) p,    B v̇ = -(∂t + D1 v) Φ,

    and those of a Hamiltonian system likewise. Along a trajectory, reactions are saved
    by `SaveAt(fn=lambda t, y, args: nhjax.motion(system, t, y, args).reaction)`.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time of the state.
    - `y`: a state, from `initial_state` or from `Solution.ys`. Where it violates the
        constraints, the accelerations are those that keep the violation constant.
    - `args`: passed on to the functions of the system.

    **Returns:** a `Motion`. Its numbers are not finite where the mass matrix or the
    compatibility matrix is singular.

    **Raises:** `DependentConstraintsError` if constraints are dependent, and the system
    does not say that they are redundant; under `jit` and `vmap` accelerations and
    reactions are NaN then. `TypeError` if `system` is no system or `y` no `State`;
    `ShapeError` if `y` is no state of this system, or many.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> nhjax.motion(disc.system, 0.0, disc.initial_state()).reaction.shape
        (4,)
    """
    args = parameters(args)
    t = checked_time("motion", system, t, y, args)
    found = _motion(system, t, y, args)
    if not is_traced(*jax.tree.leaves((found, y))) and not all_finite(found.multiplier):
        require_independent(system, t, y, args)
    return found


@tracked_jit("system", "args")
def _motion(system, t, y, args) -> Motion:
    u = system.fibre_coordinate(y)
    lin = linearise(system, t, y.q, u, args)
    manifold = system.manifold_of(y.q)
    velocity = system.velocity(t, y.q, u, args)

    def velocity_and_momentum(t, xi, u):
        g = manifold.act(y.q, xi)
        return system.velocity(t, g, u, args), system.momentum(t, g, u, args)

    _, (acceleration, momentum_rate) = jax.jvp(
        velocity_and_momentum,
        (t, jnp.zeros_like(u), u),
        (jnp.ones_like(t), velocity, lin.acceleration),
    )
    metric = system.metric(t, y.q, u, args)
    mass, jacobian = in_velocities(system, metric, lin.dense[0])
    rates = acceleration, momentum_rate, lin.multiplier
    if lin.multiplier.shape[0] > 0:
        rates = nan_unless(lin.determines_multipliers, rates)
    acceleration, momentum_rate, multiplier = rates
    return Motion(
        acceleration=acceleration,
        momentum_rate=momentum_rate,
        multiplier=multiplier,
        reaction=multiplier @ jacobian,
        mass_matrix=mass,
        constraint_jacobian=jacobian,
        is_unique=lin.is_unique,
    )


def in_velocities(
    system: AbstractMechanicalSystem,
    metric: Float[Array, "n n"],
    jacobian: Float[Array, "l n"],
) -> tuple[Float[Array, "n n"], Float[Array, "l n"]]:
    """Return ∂p/∂v and ∂Φ/∂v, given the metric K and ∂Φ/∂u of the system."""
    if system.fibre_coordinate_name == "v":
        return metric, jacobian
    # The metric is D2D2H, whose inverse is ∂p/∂v.
    mass = inverse(metric)
    return mass, jacobian @ mass


def checked_time(
    function: str, system: Any, t: FloatScalarLike, y: Any, args: Args
) -> FloatScalar:
    """Return the time as an array; raise for what is no system, time or state of it."""
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_time_and_state(function, t, y, "system, ")
    check_state(system, y, args, "y")
    return real_scalar("t", t, y.p.dtype)
