from typing import NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import (
    all_finite,
    check_functions,
    check_type,
    finite,
    floating,
    parameters,
    real_scalar,
)
from ._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from ._errors import (
    Check,
    ConstraintViolationError,
    DependentConstraintsError,
    DTypeError,
    IncompatibleConstraintsError,
    IrregularLagrangianError,
    NewtonError,
    NonFiniteError,
    require,
    ShapeError,
)
from ._iteration import root
from ._linearisation import Linearisation, linearise


if TYPE_CHECKING:
    from ._system import LagrangianSystem


class State(eqx.Module):
    """The state of a mechanical system at one time, or a trajectory of them.

    - `q`: the configuration, shape (n,).
    - `v`: the velocity, shape (n,).
    - `p`: the momentum D2L(t, q, v), shape (n,).
    - `multiplier`: λ, shape (m,); the reaction on the system is λᵀ D2Φ.

    Make one with `nhjax.initial_state`, which sees to it that the four agree.
    """

    q: Array
    v: Float[Array, " n"]
    p: Float[Array, " n"]
    multiplier: Float[Array, " m"]


def initial_state(
    system: "LagrangianSystem",
    q: Array,
    v: Float[Array, " n"] | None = None,
    p: Float[Array, " n"] | None = None,
    *,
    t: FloatScalarLike = 0.0,
    args: Args = None,
    project: bool = False,
) -> State:
    """A consistent state (q, v, p, λ) from a configuration and a velocity or momentum.

    The one of v and p that is not given follows by the Legendre transform p = D2L. The
    multiplier is that of the continuous problem, from the hidden constraint dΦ/dt = 0:
    an inconsistent λ_0 would lower the order of the method (paper, section 4).

    **Arguments:**

    - `system`: the mechanical system.
    - `q`: the configuration, shape (n,), floating point.
    - `v`, `p`: velocity or momentum, shape (n,), of the dtype of q. Give exactly one.
    - `t`, `args`: passed on to the functions of the system, as `integrate` does.
    - `project`: replace v by the nearest velocity, in the kinetic metric, that
        satisfies the constraints (one linear solve for constraints linear or affine in
        v, Newton's method for others).

    **Returns:** a `State`.

    **Raises:** under `jit` as a runtime error of the compiled program,

    - `ShapeError`, `DTypeError`, `NonFiniteError`: an argument, or the value of one of
        the system's functions, is not what it should be.
    - `ConstraintViolationError`: Φ(t, q, v) is not zero and `project` is false.
    - `IrregularLagrangianError`: D2D2L is singular.
    - `DependentConstraintsError`: D2Φ has not full rank (admissibility).
    - `IncompatibleConstraintsError`: C^{ab} is singular (compatibility).

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> system = nhjax.systems.NonholonomicParticle().system
        >>> y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.ones(3), project=True)
        >>> [float(x) for x in y0.v]
        [1.0, 1.0, 0.0]
    """
    # At the top it would be a circle: the system's methods take states.
    from ._system import LagrangianSystem

    check_type("system", system, LagrangianSystem)
    q, v, p, t = _check_inputs(system, q, v, p, t)
    args = parameters(args)
    check_functions(system, t, q, args)
    found = _solve(system, t, q, v, p, args, project)
    return _check_found(found, p, project)


class _Found(NamedTuple):
    state: State
    lin: Linearisation
    lagrangian: FloatScalar
    regularity: FloatScalar
    admissibility: FloatScalar
    compatibility: FloatScalar
    allowed: Float[Array, " m"]
    legendre_solved: BoolScalar
    projected: BoolScalar


@eqx.filter_jit
def _solve(system, t, q, v, p, args, project: bool) -> _Found:
    legendre_solved = projected = jnp.asarray(True)
    if v is None:
        solved = root(lambda u: system.momentum(t, q, u, args) - p, jnp.zeros_like(p))
        v, legendre_solved = solved.x, solved.converged
    if project and system.nonholonomic is not None:
        v, projected = _project(system, t, q, v, args)
    lin = linearise(system, t, q, v, args)
    momentum = system.momentum(t, q, v, args)
    if p is None or project:
        p = momentum
    compliance = lin.jacobian @ lin.reaction
    return _Found(
        state=State(q, v, p, lin.multiplier),
        lin=lin,
        lagrangian=system.lagrangian(t, q, v, args),
        regularity=_conditioning(system.mass_matrix(t, q, v, args)),
        admissibility=_conditioning(lin.jacobian),
        compatibility=_conditioning(compliance),
        allowed=1e3
        * jnp.finfo(v.dtype).eps
        * violation_scale(system, lin, t, q, v, args),
        legendre_solved=legendre_solved,
        projected=projected,
    )


def violation_scale(
    system: "LagrangianSystem",
    lin: Linearisation,
    t: FloatScalar,
    q: Array,
    v: Float[Array, " n"],
    args: Args,
) -> Float[Array, " m"]:
    """Row by row the size of the terms that cancel in Φ, for an affine Φ."""
    affine = jnp.nan_to_num(system.constraint(t, q, jnp.zeros_like(v), args))
    return jnp.abs(lin.jacobian) @ jnp.abs(v) + jnp.abs(affine)


def _project(system, t, q, v, args) -> tuple[Float[Array, " n"], BoolScalar]:
    """The stationary point of ½ (u-v)ᵀ M (u-v) on Φ(t, q, u) = 0."""
    mass = system.mass_matrix(t, q, v, args)

    def stationarity(z):
        u, multiplier = z
        phi, pullback = jax.vjp(lambda u: system.constraint(t, q, u, args), u)
        return mass @ (u - v) - pullback(multiplier)[0], phi

    phi = system.constraint(t, q, v, args)
    solved = root(stationarity, (v, jnp.zeros_like(phi)))
    return solved.x[0], solved.converged


def _conditioning(matrix: Float[Array, "k l"]) -> FloatScalar:
    """Smallest over largest singular value, after scaling rows (and columns) to one.

    The scaling makes it blind to the units of single coordinates and constraints.
    """
    if matrix.shape[0] == 0:
        return jnp.ones((), matrix.dtype)
    rows = jnp.max(jnp.abs(matrix), axis=1)
    rows = jnp.where(rows > 0, rows, 1)
    if matrix.shape[0] == matrix.shape[1]:
        scaled = matrix / jnp.sqrt(rows[:, None] * rows[None, :])
    else:
        scaled = matrix / rows[:, None]
    if matrix.shape[0] > matrix.shape[1]:
        return jnp.zeros((), matrix.dtype)
    singular = jnp.linalg.svd(scaled, compute_uv=False)
    # Not "> 0": what is not a number must not pass for singular.
    return jnp.where(singular[0] == 0, 0, singular[-1] / singular[0])


def _check_found(found: _Found, p: Float[Array, " n"] | None, project: bool) -> State:
    state, lin = found.state, found.lin
    n, eps = state.v.shape[0], jnp.finfo(state.v.dtype).eps
    singular = 10 * n * eps

    def where():
        # A velocity that was not found would be a riddle.
        return f"q = {state.q}, " + (f"v = {state.v}" if p is None else f"p = {p}")

    return require(
        state,
        # Not ">": a matrix that is not finite is no singular matrix.
        Check(
            ~(found.regularity <= singular),
            lambda: IrregularLagrangianError(
                "The Lagrangian is not regular: the mass matrix D2D2L is singular at "
                f"{where()} (reciprocal condition number {float(found.regularity):.1e})"
                ". Give every coordinate a kinetic energy, or remove those without."
            ),
            "initial_state: the Lagrangian is not regular (D2D2L is singular).",
        ),
        Check(
            found.legendre_solved,
            lambda: NewtonError(
                f"No velocity with D2L(t, q, v) = p was found for q = {state.q}, "
                f"p = {p}. Give `v` instead of `p`."
            ),
            "initial_state: no velocity with D2L(t, q, v) = p was found.",
        ),
        Check(
            all_finite((found.lagrangian, found.regularity, lin.violation)),
            lambda: NonFiniteError(
                "The Lagrangian, its second derivatives in v, or the constraint is not "
                f"finite at {where()}: L = {found.lagrangian}, Φ = {lin.violation}. "
                "Check the functions of the system at this state."
            ),
            "initial_state: the Lagrangian or the constraint is not finite there.",
        ),
        Check(
            ~(found.admissibility <= singular),
            lambda: _dependence_error(found, where()),
            "initial_state: the constraints are dependent (D2Φ has not full rank).",
        ),
        Check(
            ~(found.compatibility <= singular),
            lambda: IncompatibleConstraintsError(
                "The constraints are not compatible with the Lagrangian: C = D2Φ M⁻¹ "
                f"D2Φᵀ is singular at {where()} (the paper's compatibility condition; "
                f"reciprocal condition number {float(found.compatibility):.1e}). No "
                "multiplier is determined there."
            ),
            "initial_state: the compatibility matrix C = D2Φ M⁻¹ D2Φᵀ is singular.",
        ),
        Check(
            found.projected,
            lambda: NewtonError(
                "The velocity could not be projected onto the constraints: Newton's "
                f"method stopped at v = {state.v} with Φ = {lin.violation}. Start "
                "nearer to them."
            ),
            "initial_state: the velocity could not be projected onto the constraints.",
        ),
        Check(
            jnp.all(jnp.abs(lin.violation) <= found.allowed),
            lambda: _violation_error(found, project),
            "initial_state: the constraints are violated; pass `project=True`.",
        ),
        Check(
            all_finite((lin.acceleration, lin.multiplier)),
            lambda: NonFiniteError(
                "The forces D1L + F, or the derivatives of Φ, are not finite at "
                f"{where()}: the acceleration would be {lin.acceleration}, the "
                f"multiplier {lin.multiplier}. Check the functions of the system at "
                "this state."
            ),
            "initial_state: the forces or the multiplier are not finite there.",
        ),
    )


def _dependence_error(found: _Found, where: str) -> DependentConstraintsError:
    jacobian = found.lin.jacobian
    zero = [a for a in range(jacobian.shape[0]) if not jnp.any(jacobian[a])]
    advice = (
        f"Φ[{zero[0]}] does not depend on v there; give a constraint on positions "
        "by its time derivative."
        if zero
        else "Remove redundant constraints, or start from a state at which they are "
        "independent."
    )
    return DependentConstraintsError(
        f"The constraints are dependent: D2Φ has not full rank at {where} (the paper's "
        f"admissibility condition; D2Φ = {jacobian.tolist()}). {advice}"
    )


def _violation_error(found: _Found, project: bool) -> ConstraintViolationError:
    violation = found.lin.violation
    bad = [a for a in range(violation.shape[0]) if abs(violation[a]) > found.allowed[a]]
    listed = "; ".join(
        f"Φ[{a}] = {float(violation[a]):.6g} (allowed {float(found.allowed[a]):.1e})"
        for a in bad
    )
    advice = (
        "the projection did not reach them"
        if project
        else "choose a velocity on the constraints, or pass `project=True`"
    )
    return ConstraintViolationError(
        f"{len(bad)} of {violation.shape[0]} nonholonomic constraints violated at "
        f"q = {found.state.q}, v = {found.state.v}: {listed}; {advice}."
    )


def _check_inputs(system, q, v, p, t):
    if (v is None) == (p is None):
        given = "neither" if v is None else "both"
        raise ValueError(f"Give either `v` or `p`; got {given} of them.")
    name, fibre = ("v", v) if p is None else ("p", p)
    q, fibre = floating("q", q), floating(name, fibre)
    if q.ndim != 1 and system.manifold is None:
        raise ShapeError(
            f"`q` has shape {q.shape}, but a configuration has shape (n,). For many "
            "trajectories use `jax.vmap`."
        )
    manifold = system.manifold_of(q)
    q = manifold.check(q)
    if fibre.shape != (manifold.dim,):
        raise ShapeError(
            f"`{name}` has shape {fibre.shape}, but `q` has shape {q.shape} and needs "
            f"a `{name}` of shape ({manifold.dim},)."
        )
    if fibre.dtype != q.dtype:
        raise DTypeError(
            f"`{name}` has dtype {fibre.dtype}, but `q` has {q.dtype}: they must agree."
        )
    t = real_scalar("t", t, q.dtype)
    # All on q, which no system ignores: jit drops a check of what is not used.
    q = require(q, finite("q", q), finite(name, fibre), finite("t", t))
    return (q, fibre, None, t) if p is None else (q, None, fibre, t)
