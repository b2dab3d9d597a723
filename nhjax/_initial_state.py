from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ._checks import (
    all_finite,
    check_functions,
    check_type,
    configuration,
    finite,
    floating,
    parameters,
    real_scalar,
    require_manifold,
)
from ._contraction import inverse
from ._custom_types import Args, BoolScalar, FloatScalarLike
from ._errors import DTypeError, require, ShapeError
from ._implicit import root
from ._initial_checks import check_found, conditioning, Found
from ._linearisation import linearise
from ._scales import position_scale, violation_scale
from ._state import State
from ._system import AbstractMechanicalSystem, HamiltonianSystem, LagrangianSystem
from ._tracked_jit import tracked_jit


def initial_state(
    system: AbstractMechanicalSystem,
    q: PyTree[Array],
    v: Float[Array, " n"] | None = None,
    p: Float[Array, " n"] | None = None,
    *,
    t: FloatScalarLike = 0.0,
    args: Args = None,
    project: bool = False,
) -> State:
    """A consistent state (q, v, p, λ) from a configuration and a velocity or momentum.

    The one of v and p that is not given follows by the Legendre transform p = D2L, or
    v = D2H. The multiplier is that of the continuous problem, from the hidden
    constraints dΦ/dt = 0 of nonholonomic and d²Γ/dt² = 0 of holonomic ones: an
    inconsistent λ_0 would lower the order of the method (paper, section 4).

    **Arguments:**

    - `system`: the mechanical system.
    - `q`: the configuration, shape (n,), floating point; on a group an element, on a
        product of groups a tuple of elements.
    - `v`, `p`: velocity or momentum, shape (n,) with n the dimension of the manifold,
        of the dtype of q; on a group in the body frame. Give exactly one.
    - `t`, `args`: passed on to the functions of the system, as `integrate` does.
    - `project`: replace q by the nearest configuration, and then v by the nearest
        velocity, in the kinetic metric, that satisfies the constraints (one linear
        solve for constraints linear or affine in v, Newton's method for others).

    **Returns:** a `State`.

    **Raises:** under `jit` as a runtime error of the compiled program,

    - `ShapeError`, `DTypeError`, `NonFiniteError`: an argument, or the value of one of
        the system's functions, is not what it should be.
    - `ConstraintViolationError`: a constraint is violated, or `q` is off the group, and
        `project` is false.
    - `IrregularLagrangianError`: D2D2L (or D2D2H) is singular.
    - `DependentConstraintsError`: D2Φ and DΓ have not full rank (admissibility).
    - `IncompatibleConstraintsError`: C^{ab} is singular (compatibility).

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> system = nhjax.systems.NonholonomicParticle().system
        >>> y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.ones(3), project=True)
        >>> [float(x) for x in y0.v]
        [1.0, 1.0, 0.0]
    """
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    q, v, p, t = _check_inputs(system, q, v, p, t)
    args = parameters(args)
    check_functions(system, t, q, args)
    found = _solve(system, t, q, v, p, args, project)
    name, given = ("p", p) if v is None else ("v", v)
    return check_found(system, found, name, given, project)


@tracked_jit("system", "args")
def _solve(system, t, q, v, p, args, project: bool) -> Found:
    manifold = system.manifold_of(q)
    given = p if v is None else v
    is_fibre = (v is None) == (system.fibre_name == "p")
    legendre_solved = projected = jnp.asarray(True)
    off_group = manifold.defect(q)
    if project:
        normal = manifold.normalise(q)
        possible = all_finite(normal)
        q = jax.tree.map(lambda x, y: jnp.where(possible, x, y), normal, q)
        off_group = jnp.where(possible, 0, off_group)
        if system.holonomic is not None:
            guess = given if is_fibre else jnp.zeros_like(given)
            q, projected = _project_position(system, t, q, guess, args)
    u = given
    if not is_fibre:
        solved = root(
            lambda u: system.conjugate(t, q, u, args) - given, jnp.zeros_like(given)
        )
        u, legendre_solved = solved.x, solved.converged
    if project and (system.nonholonomic is not None or system.holonomic is not None):
        u, on_velocities = _project_fibre(system, t, q, u, args)
        projected = projected & on_velocities
    lin = linearise(system, t, q, u, args)
    found_v = system.velocity(t, q, u, args)
    found_p = system.momentum(t, q, u, args)
    if not project:
        # What was given is kept to the last bit.
        found_v = found_v if v is None else v
        found_p = found_p if p is None else p
    metric = system.metric(t, q, u, args)
    tolerance = jnp.asarray(1e3 * float(jnp.finfo(u.dtype).eps), u.dtype)
    return Found(
        state=State(q, found_v, found_p, lin.multiplier),
        lin=lin,
        generator=getattr(system, system.generator)(t, q, u, args),
        positions=system.position_constraint(t, q, args),
        off_group=off_group,
        regularity=conditioning(metric),
        admissibility=conditioning(lin.jacobian),
        compatibility=conditioning(lin.jacobian @ lin.reaction),
        allowed=tolerance * violation_scale(system, lin, t, q, u, args),
        allowed_positions=tolerance * position_scale(system, t, q, args),
        allowed_off_group=tolerance,
        legendre_solved=legendre_solved,
        projected=projected,
    )


def _project_position(system, t, q, u, args) -> tuple[PyTree[Array], BoolScalar]:
    """The stationary point of ½ ξᵀ M ξ on Γ(t, q τ(ξ)) = 0."""
    manifold = system.manifold_of(q)
    mass = system.metric(t, q, u, args)
    if system.fibre_name == "p":
        mass = inverse(mass)

    def gamma(xi):
        return system.position_constraint(t, manifold.act(q, xi), args)

    xi, converged = _nearest(mass, gamma, jnp.zeros_like(u))
    return manifold.act(q, xi), converged


def _project_fibre(system, t, q, u, args) -> tuple[Float[Array, " n"], BoolScalar]:
    """The stationary point of ½ (w-u)ᵀ K (w-u) on Φ(t, q, w) = 0."""
    metric = system.metric(t, q, u, args)
    return _nearest(metric, lambda w: system.constraint(t, q, w, args), u)


def _nearest(
    metric: Float[Array, "n n"],
    constraint: Callable[[Float[Array, " n"]], Float[Array, " m"]],
    x: Float[Array, " n"],
) -> tuple[Float[Array, " n"], BoolScalar]:
    """The stationary point of ½ (y-x)ᵀ K (y-x) on constraint(y) = 0."""

    def stationarity(z):
        y, multiplier = z
        value, pullback = jax.vjp(constraint, y)
        return metric @ (y - x) - pullback(multiplier)[0], value

    solved = root(stationarity, (x, jnp.zeros_like(constraint(x))))
    return solved.x[0], solved.converged


def _check_inputs(system, q, v, p, t):
    if (v is None) == (p is None):
        given = "neither" if v is None else "both"
        raise ValueError(f"Give either `v` or `p`; got {given} of them.")
    name, fibre = ("v", v) if p is None else ("p", p)
    q, fibre = configuration(q), floating(name, fibre)
    require_manifold(system, "q", q)
    if system.manifold is None and q.ndim != 1:
        raise ShapeError(
            f"`q` has shape {q.shape}, but a configuration has shape (n,). For many "
            "trajectories use `jax.vmap`."
        )
    manifold = system.manifold_of(q)
    q = manifold.check(q)
    leaves = jax.tree.leaves(q)
    if fibre.shape != (manifold.dim,):
        raise ShapeError(
            f"`{name}` has shape {fibre.shape}, but `q` has shape "
            f"{' x '.join(str(leaf.shape) for leaf in leaves)} and needs a `{name}` of "
            f"shape ({manifold.dim},)."
        )
    for leaf in leaves:
        if fibre.dtype != leaf.dtype:
            raise DTypeError(
                f"`{name}` has dtype {fibre.dtype}, but `q` has {leaf.dtype}: they "
                "must agree."
            )
    t = real_scalar("t", t, fibre.dtype)
    # All on q, which no system ignores: jit drops a check of what is not used.
    q = require(q, finite("q", q), finite(name, fibre), finite("t", t))
    return (q, fibre, None, t) if p is None else (q, None, fibre, t)
