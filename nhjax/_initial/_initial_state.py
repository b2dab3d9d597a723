from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._errors import DTypeError, is_traced, require, ShapeError, undecided
from .._numerics import (
    active_ranks,
    has_zero_row,
    inverse,
    max_norm,
    nan_unless,
    rank_of_gram,
    RankCondition,
    reciprocal_condition,
    root,
    small_einsum,
    stop_gradient,
    tree_where,
)
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    check_flag,
    check_functions,
    check_type,
    configuration,
    finite,
    floating,
    function_noise,
    FunctionNoise,
    HamiltonianSystem,
    LagrangianSystem,
    Linearisation,
    linearise,
    parameters,
    position_scale,
    real_scalar,
    require_manifold,
    require_names,
    State,
    violation_scale,
    with_kept_functions,
)
from ._checks import Found, judge, list_checks
from ._projection import (
    checked_keep,
    Chosen,
    Fixed,
    Kept,
    project_fibre_coordinate,
    project_position,
)


# The largest number of coordinates for which one kernel computes an initial state and
# its checks.
_LARGEST_WHOLE = 12


def initial_state(
    system: AbstractMechanicalSystem,
    q: PyTree[Array],
    v: Float[Array, " n"] | None = None,
    p: Float[Array, " n"] | None = None,
    *,
    t: FloatScalarLike = 0.0,
    args: Args = None,
    project: bool = False,
    keep_q: Chosen = None,
    keep_v: Chosen = None,
    keep_p: Chosen = None,
    throw: bool = True,
) -> State:
    """Create a consistent state (q, v, p, λ) from q and either v or p.

    You give the velocity or the momentum; the other one follows from the Legendre
    transform p = D2L or v = D2H. The multiplier is the multiplier of the continuous
    problem. It follows from the hidden constraints: dΦ/dt = 0 for nonholonomic and
    d²Γ/dt² = 0 for holonomic constraints. With an inconsistent initial multiplier λ_0,
    a method with the closure `"propagated"` has in general only order 2, for any number
    of stages.

    **Arguments:**

    - `system`: the mechanical system.
    - `q`: the configuration, shape (n,), floating point; on a group an element, on a
        product of groups a tuple of elements.
    - `v`, `p`: the velocity or the momentum, of shape (n,) and of the dtype of q, where
        n is the dimension of the manifold; on a group in the body frame. Give exactly
        one.
    - `t`, `args`: passed on to the functions of the system, as in `integrate`.
    - `project`: whether to replace q by the nearest configuration, and then v by the
        nearest velocity, that satisfies the constraints. Distances are measured in the
        kinetic metric. The velocity needs one linear solve if the constraints are
        linear or affine in v, and Newton's method otherwise.
    - `keep_q`, `keep_v`, `keep_p`: the components of q, v or p that the projection must
        not change: an index, a name or a sequence of them, known when tracing. Use
        `keep_v` with `v`, and `keep_p` with `p`. The projection then finds the nearest
        values of the other components, in the same metric, that satisfy the
        constraints. An index counts the numbers of the flattened `q` (for a tuple, of
        all its parts joined in order) or of `v` or `p`. A name is an entry of the
        `coordinates` of the system. If the kept components determine a constraint and
        violate it, the error names the constraint and these components.
    - `throw`: whether to raise if there is no consistent state. If false, all numbers
        of the state returned in this case are NaN, and `integrate` reports the state as
        not finite; under `vmap` the other members of an ensemble are not affected.
        Wrong types and shapes always raise.

    **Returns:** a `State`.

    **Raises:** the following errors. Under `jit`, an error that depends on values has
    the same message, and JAX raises it as a `JaxRuntimeError` or a `ValueError`.

    - `TypeError`: `system`, `project`, `keep_q`, `keep_v`, `keep_p` or a part of `args`
        is of a wrong type.
    - `ValueError`: `v` and `p` are both given or both left out; a component to keep is
        unknown, chosen twice, or chosen without `project=True`.
    - `ShapeError`, `DTypeError`, `NonFiniteError`: an argument, or the value of one of
        the system's functions, has a wrong shape or dtype, or is not finite.
    - `ConstraintViolationError`: a constraint is violated, or `q` is not on the group,
        and `project` is false or the kept components prevent the correction.
    - `IrregularLagrangianError`: D2D2L (or D2D2H) is singular.
    - `DependentConstraintsError`: D2Φ and DΓ together do not have full rank
        (admissibility), and the constraints of the system are `"independent"`.
    - `IncompatibleConstraintsError`: the compatibility matrix C^{ab} is singular.
    - `NewtonError`: no velocity was found for the momentum (or the reverse), or the
        projection by Newton's method did not converge.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> system = nhjax.systems.NonholonomicParticle().system
        >>> y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.ones(3), project=True)
        >>> [float(x) for x in y0.v]
        [1.0, 1.0, 0.0]

    In the next example a disc of radius 1 m has the speed 3 m/s and the roll rate 0,
    which violates the rolling constraint. The first projection changes both. In the
    second projection `keep_v` keeps the speed of exactly 3 m/s, and the roll rate
    becomes 3 rad/s:

        >>> disc = nhjax.systems.VerticalRollingDisc(radius=1.0).system
        >>> v = jnp.array([3.0, 0.0, 0.0, 0.0])
        >>> y0 = nhjax.initial_state(disc, jnp.zeros(4), v, project=True)
        >>> [float(x) for x in y0.v]
        [2.0, 0.0, 2.0, 0.0]
        >>> y0 = nhjax.initial_state(disc, jnp.zeros(4), v, project=True, keep_v=[0])
        >>> [float(x) for x in y0.v]
        [3.0, 0.0, 3.0, 0.0]
    """
    project = check_flag("project", project)
    throw = check_flag("throw", throw)
    q, v, p, t = checked_inputs(system, q, v, p, t)
    chosen = {"q": keep_q, "v": keep_v, "p": keep_p}
    keep = checked_keep(system, q, "p" if v is None else "v", chosen, project)
    args = parameters(args)
    check_functions(system, t, q, args)
    inputs = [
        finite(name, x)
        for name, x in (("q", q), ("v", v), ("p", p), ("t", t))
        if x is not None
    ]
    if throw:
        # Check concrete inputs now, and traced ones with the solution in one call-back.
        inputs = undecided(*inputs)
    found, judged = _solve(system, t, q, v, p, args, project, keep)
    holds = [x if is_traced(x) else bool(x) for x in judged]
    checks = inputs + list_checks(system, found, holds, q, v, p, project, keep)
    if throw:
        return require(found.state, *checks)
    good = jnp.all(jnp.stack([jnp.asarray(check.ok) for check in checks]))
    return nan_unless(good, found.state)


@tracked_jit("system", "args")
def _solve(
    system, t, q, v, p, args, project: bool, keep: tuple[Kept, Kept]
) -> tuple[Found, list[BoolScalar | np.bool_]]:
    """Compute a `Found`, and whether each of its checks holds."""
    system = with_kept_functions(system, t, q, p if v is None else v, args)
    given = system, t, q, v, p, args, project, keep
    # A large program compiles faster in parts. So does a program that calls LAPACK,
    # such as the projection with kept components.
    keeps_any = any(kept.indices for kept in keep)
    if keeps_any or system.manifold_of(q).dim > _LARGEST_WHOLE:
        return _found_and_judged(*given)
    return as_cpu_kernel(_found_and_judged, *given, is_brief=True)


def _found_and_judged(*given: Any) -> tuple[Found, list[BoolScalar | np.bool_]]:
    found = _found(*given)
    return found, judge(found)


def _found(system, t, q, v, p, args, project: bool, keep: tuple[Kept, Kept]) -> Found:
    keep_u = keep[1]
    given = system, t, q, v, p, args, project, keep
    at = as_cpu_kernel(_project, *given, is_brief=True)
    projected, starts = at.projected, at.starts
    q, u, found_v, found_p, lin = at.q, at.u, at.v, at.p, at.lin
    if not project:
        # The given velocity or momentum is returned bit for bit.
        found_v = found_v if v is None else v
        found_p = found_p if p is None else p
    elif v is not None:
        found_v = keep_u.restored(found_v, v)
    else:
        found_p = keep_u.restored(found_p, p)
    state = State(q, found_v, found_p, lin.multiplier)
    # The numbers that the checks need are not differentiated.
    system, args, t, q, u, lin, starts = stop_gradient(
        (system, args, t, q, u, lin, starts)
    )
    noise, jacobian = _noise(system, lin, t, q, u, args)
    here = RankCondition(jacobian, q, projected)
    ranks = (
        [here] if system.constraints == "redundant" else active_ranks([*starts, here])
    )
    positions = system.position_constraint(t, q, args)
    deficient, compatibility = _ranks_judged(system, lin, ranks)
    given = system, lin, noise, t, q, u, args
    allowed, allowed_positions, tolerance = _allowed(*given)
    return Found(
        state=state,
        lin=lin,
        generator=system.named(system.generator)(t, q, u, args),
        positions=positions,
        off_group=at.off_group,
        regularity=reciprocal_condition(system.metric(t, q, u, args)),
        ranks=ranks,
        deficient=deficient,
        compatibility=compatibility,
        allowed=allowed,
        allowed_positions=allowed_positions,
        allowed_off_group=tolerance,
        legendre_solved=at.legendre_solved,
        projected=projected,
        fixed_positions=at.fixed_positions,
        fixed_velocities=at.fixed_velocities,
    )


class _Projected(NamedTuple):
    """The consistent state, and how it was found.

    - `q`, `u`, `v`, `p`: the position, the fibre coordinate, the velocity and the
        momentum of the state.
    - `lin`: the equations of motion, linearised at the state.
    - `starts`: the Jacobians of the constraints at the points where the searches for
        the nearest points started.
    - `off_group`, `legendre_solved`, `projected`, `fixed_positions`,
        `fixed_velocities`: as in `Found`.
    """

    q: PyTree[Array]
    u: Float[Array, " n"]
    v: Float[Array, " n"]
    p: Float[Array, " n"]
    lin: Linearisation
    starts: list[RankCondition]
    off_group: FloatScalar
    legendre_solved: BoolScalar
    projected: BoolScalar
    fixed_positions: Fixed | None
    fixed_velocities: Fixed | None


def _project(
    system, t, q, v, p, args, project: bool, keep: tuple[Kept, Kept]
) -> _Projected:
    manifold = system.manifold_of(q)
    given_q, given = q, p if v is None else v
    keep_q, keep_u = keep
    is_fibre_coordinate = (v is None) == (system.fibre_coordinate_name == "p")
    legendre_solved = projected = jnp.asarray(True)
    off_group = manifold.distance_to_group(stop_gradient(q))
    starts, fixed_q, fixed_u = [], None, None
    if project:
        normal = manifold.normalise(q)
        possible = jnp.asarray(all_finite(normal))
        q = tree_where(possible, normal, q)
        off_group = jnp.where(possible, 0, off_group)
        if system.holonomic is not None:
            guess = given if is_fibre_coordinate else jnp.zeros_like(given)
            start = q
            nearest = project_position(system, t, q, guess, args, keep_q, given_q)
            q, projected, fixed_q = nearest.x, nearest.found, nearest.fixed
            starts.append(RankCondition(nearest.jacobian, start, ~projected))
        if keep_q.indices:
            q = keep_q.restored(q, given_q)
            off_group = manifold.distance_to_group(stop_gradient(q))
    u = given
    if not is_fibre_coordinate:
        u, legendre_solved = _inverse_legendre(system, t, q, given, args)
    if project and (system.nonholonomic is not None or system.holonomic is not None):
        nearest = project_fibre_coordinate(system, t, q, u, args, keep_u, given)
        starts.append(RankCondition(nearest.jacobian, q, projected & ~nearest.found))
        u, projected = nearest.x, projected & nearest.found
        fixed_u = nearest.fixed
    return _Projected(
        q=q,
        u=u,
        v=system.velocity(t, q, u, args),
        p=system.momentum(t, q, u, args),
        lin=linearise(system, t, q, u, args),
        starts=starts,
        off_group=off_group,
        legendre_solved=legendre_solved,
        projected=projected,
        fixed_positions=fixed_q,
        fixed_velocities=fixed_u,
    )


def _noise(
    system, lin: Linearisation, t, q, u, args
) -> tuple[FunctionNoise, Float[Array, "l n"]]:
    """Measure round-off; set rows of D2Φ and DΓ that are only round-off to zero.

    A constraint that is the square of an expression has such a row at states that
    satisfy the constraint. The round-off of a row is measured along one direction,
    which is cheaper than measuring it for all columns.
    """
    random = np.random.default_rng(0)
    sizes = random.uniform(0.5, 1.5, u.shape) * random.choice([-1.0, 1.0], u.shape)
    direction = jnp.asarray(sizes, u.dtype)
    given = system, t, q, u, lin.multiplier, args, 1.0, direction
    noise = as_cpu_kernel(function_noise, *given, is_brief=True)
    assert noise.slopes is not None
    jacobian = lin.dense[0]
    slopes = jnp.abs(small_einsum("ln,n->l", jacobian, direction))
    return noise, jnp.where((slopes <= 10 * noise.slopes)[:, None], 0, jacobian)


def _allowed(
    system, lin: Linearisation, noise: FunctionNoise, t, q, u, args
) -> tuple[Float[Array, " l"], Float[Array, " k"], FloatScalar]:
    """Bound the violations of velocity and position constraints due to round-off.

    The third result bounds the distance to a group. The round-off is measured, because
    constants in the constraints can cause larger round-off than q and v if q and v are
    small.
    """
    tolerance = jnp.asarray(1e3 * float(jnp.finfo(u.dtype).eps), u.dtype)
    on_velocities = tolerance * violation_scale(system, lin, t, q, u, args)
    on_positions = tolerance * position_scale(system, t, q, args)
    violations = noise.violations
    return (
        jnp.maximum(on_velocities, violations[0]),
        jnp.maximum(on_positions, violations[1]),
        tolerance,
    )


def _ranks_judged(
    system: AbstractMechanicalSystem, lin: Linearisation, ranks: list[RankCondition]
) -> tuple[list[BoolScalar], FloatScalar]:
    """Return which ranks are deficient, and the reciprocal condition number of C.

    C is the compatibility matrix. Redundant constraints are compatible if C has the
    same rank as their derivatives. For redundant constraints, the second result is one
    if they are compatible and zero otherwise, and a rank is deficient only if all
    derivatives of a constraint are zero.
    """
    jacobian, reaction, _ = lin.dense
    delassus = jacobian @ reaction
    if system.constraints != "redundant":
        return [rank.deficient for rank in ranks], reciprocal_condition(delassus)
    rank = rank_of_gram(jacobian @ jacobian.T)
    full = (rank_of_gram(delassus) == rank).astype(delassus.dtype)
    return [rank.is_active & has_zero_row(rank.jacobian) for rank in ranks], full


def _inverse_legendre(
    system, t, q, given: Float[Array, " n"], args
) -> tuple[Float[Array, " n"], BoolScalar]:
    """Return the u whose fibre derivative is `given`, and whether it was found."""
    zero = jnp.zeros_like(given)
    # If the terms of the equation cancel, as at rest in a magnetic field, the round-off
    # of u is proportional to these terms and not to u. Therefore they give the scale.
    terms = jnp.abs(given) + jnp.abs(system.fibre_derivative(t, q, zero, args))
    scale = max_norm(jnp.abs(inverse(system.metric(t, q, zero, args))) @ terms)
    solved = root(
        lambda u: system.fibre_derivative(t, q, u, args) - given,
        zero,
        jnp.where(jnp.isfinite(scale), scale, 0),
    )
    return solved.x, solved.converged


def checked_inputs(system, q, v, p, t):
    """Convert the arguments of `initial_state` to arrays, and check them."""
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    if isinstance(q, State):
        raise TypeError(
            "`q` must be a configuration, got an nhjax.State. For a state `y` pass "
            "`y.q` and `y.v`."
        )
    if (v is None) == (p is None):
        given = "neither" if v is None else "both"
        raise ValueError(
            f"Give either `v` or `p`, got {given} of them. Call it as "
            "`initial_state(system, q, v, t=..., args=...)`."
        )
    name, u = ("v", v) if p is None else ("p", p)
    q, u = configuration(q), floating(name, u)
    require_manifold(system, "q", q)
    if system.manifold is None and q.ndim != 1:
        advice = "For many trajectories use `jax.vmap`."
        if q.ndim == 0:
            advice = (
                "For a single coordinate write `jnp.array([x])`. Call it as "
                "`initial_state(system, q, v, t=..., args=...)`."
            )
        raise ShapeError(
            f"`q` has shape {q.shape}, but a configuration has shape (n,). {advice}"
        )
    manifold = system.manifold_of(q)
    q = manifold.check(q)
    require_names(system, "q", manifold)
    leaves = jax.tree.leaves(q)
    if u.shape != (manifold.dim,):
        raise ShapeError(
            f"`{name}` has shape {u.shape}, but `q` has shape "
            f"{' x '.join(str(leaf.shape) for leaf in leaves)} and needs a `{name}` of "
            f"shape ({manifold.dim},)."
        )
    for leaf in leaves:
        if u.dtype != leaf.dtype:
            raise DTypeError(
                f"`{name}` has dtype {u.dtype}, but `q` has {leaf.dtype}: they "
                "must agree."
            )
    t = real_scalar("t", t, u.dtype)
    return (q, u, None, t) if p is None else (q, None, u, t)
