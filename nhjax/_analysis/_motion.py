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
    check_multiplier,
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
    with_kept_functions,
)


class Motion(eqx.Module):
    """The continuous motion of a system at one state: its accelerations and reactions.

    - `acceleration`: the rate v̇ of the velocity, shape (n,). On a group it is the rate
        of the body velocity.
    - `momentum_rate`: the rate ṗ of the momentum, shape (n,).
    - `multiplier`: the multiplier λ_c, shape (l,) with l = m + k: m nonholonomic
        constraints, then k holonomic ones.
    - `reaction`: the generalised force λᵀB of all constraints, shape (n,).
    - `mass_matrix`: M = ∂p/∂v, shape (n, n).
    - `constraint_jacobian`: B = ∂Φ/∂v, shape (l, n). Its last rows belong to the rates
        of the holonomic constraints.
    - `is_unique`: whether the equations determine each multiplier, shape (l,). It is
        false for redundant constraints, whose multipliers are the solution with the
        least norm. The total `reaction` is always unique.

    The product of a generalised force and its coordinate is work, so that the unit of
    the force is N for a coordinate in m, and N m for an angle. A multiplier is a force
    in N if its constraint is a velocity in m/s or a distance in m.
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
        """Return the generalised force λ_a B_a of each constraint, as rows."""
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

    The function solves the continuous equations of motion (the paper's section 3)
    together with the hidden constraints (the time derivatives of the constraints),

    M v̇ - Bᵀ λ = ad*_v p + D1L + F - (∂t + D1 v) p,    B v̇ = -(∂t + D1 v) Φ,

    or the corresponding equations of a Hamiltonian system. Here D1 is the derivative
    with respect to q, D1 v the directional derivative along v, and F the force. To save
    reactions along a trajectory, use
    `SaveAt(fn=lambda t, y, args: nhjax.motion(system, t, y, args).reaction)`.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time of the state.
    - `y`: a state, from `initial_state` or `Solution.ys`. If its velocity violates
        constraints, the accelerations keep this violation constant.
    - `args`: passed on to the functions of the system.

    **Returns:** a `Motion`. Its rates and forces are not finite if the mass matrix is
    singular, or if the compatibility matrix is singular and the system does not declare
    its constraints redundant.

    **Raises:** `DependentConstraintsError` if constraints are dependent, unless the
    system declares them redundant; under `jit` and `vmap`, accelerations and reactions
    are NaN instead. `TypeError` if `system` is not a system or `y` is not a `State`;
    `ShapeError` if `y` is not a state of this system, or is a batch of states.

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
    system = with_kept_functions(system, t, y.q, u, args)
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
    hessian = system.metric(t, y.q, u, args)
    mass, jacobian = convert_to_velocities(system, hessian, lin.dense[0])
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


def convert_to_velocities(
    system: AbstractMechanicalSystem,
    hessian: Float[Array, "n n"],
    jacobian: Float[Array, "l n"],
) -> tuple[Float[Array, "n n"], Float[Array, "l n"]]:
    """Return ∂p/∂v and ∂Φ/∂v, given ∂Φ/∂u and the Hessian D2D2L or D2D2H."""
    if system.fibre_coordinate_name == "v":
        return hessian, jacobian
    # The Hessian is D2D2H = ∂v/∂p.
    mass = inverse(hessian)
    return mass, jacobian @ mass


def checked_time(
    function: str, system: Any, t: FloatScalarLike, y: Any, args: Args
) -> FloatScalar:
    """Return the time as an array; raise for an invalid system, time or state."""
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_time_and_state(function, t, y, "system, ")
    check_state(system, y, "y")
    check_multiplier(system, y, args, "y")
    return real_scalar("t", t, y.p.dtype)
