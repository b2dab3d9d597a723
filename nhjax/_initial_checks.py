"""What can be wrong with a state, judged once it has been computed."""

from typing import NamedTuple, TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import all_finite
from ._custom_types import BoolScalar, FloatScalar
from ._errors import (
    Check,
    ConstraintViolationError,
    DependentConstraintsError,
    IncompatibleConstraintsError,
    IrregularLagrangianError,
    NewtonError,
    NonFiniteError,
    require,
)
from ._linearisation import Linearisation
from ._state import State


if TYPE_CHECKING:
    from ._system import AbstractMechanicalSystem


class Found(NamedTuple):
    """A state, and the figures by which to judge it."""

    state: State
    lin: Linearisation
    generator: FloatScalar  # the value of L or H
    positions: Float[Array, " k"]  # the holonomic constraints
    off_group: FloatScalar
    regularity: FloatScalar
    admissibility: FloatScalar
    compatibility: FloatScalar
    allowed: Float[Array, " l"]
    allowed_positions: Float[Array, " k"]
    allowed_off_group: FloatScalar
    legendre_solved: BoolScalar
    projected: BoolScalar


def conditioning(matrix: Float[Array, "k l"]) -> FloatScalar:
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


class _Words(NamedTuple):
    """The names of a system's functions in messages."""

    generator: str
    letter: str
    hessian: str
    force: str
    legendre: str
    fibre: str
    conjugate: str
    constraint: str


_WORDS = {
    "lagrangian": _Words(
        generator="Lagrangian",
        letter="L",
        hessian="mass matrix D2D2L",
        force="D1L + F",
        legendre="D2L(t, q, v) = p",
        fibre="v",
        conjugate="p",
        constraint="Φ",
    ),
    "hamiltonian": _Words(
        generator="Hamiltonian",
        letter="H",
        hessian="Hessian D2D2H",
        force="F - D1H",
        legendre="D2H(t, q, p) = v",
        fibre="p",
        conjugate="v",
        constraint="Ψ",
    ),
}


def check_found(
    system: "AbstractMechanicalSystem",
    found: Found,
    given_name: str,
    given: Float[Array, " n"] | None,
    project: bool,
) -> State:
    """The state, or an exception that says what is wrong with it."""
    state, lin = found.state, found.lin
    n, eps = state.v.shape[0], jnp.finfo(state.v.dtype).eps
    singular = 10 * n * eps
    words = _WORDS[system.generator]
    name, phi = words.generator, words.constraint
    fibre = "velocity" if words.fibre == "v" else "momentum"

    def where():
        # What was given, not what was found from it: that would be a riddle.
        return f"q = {state.q}, {given_name} = {given}"

    def reached():
        return f"{words.fibre} = {getattr(state, words.fibre)}"

    return require(
        state,
        Check(
            found.off_group <= found.allowed_off_group,
            lambda: ConstraintViolationError(
                f"`q` = {state.q} is no element of the group "
                f"{system.manifold_of(state.q)}: it is off by "
                f"{float(found.off_group):.3g}. Pass `project=True`, or "
                "`manifold.normalise(q)`."
            ),
            "initial_state: `q` is no element of the group; pass `project=True`.",
        ),
        # Not ">": a matrix that is not finite is no singular matrix.
        Check(
            ~(found.regularity <= singular),
            lambda: IrregularLagrangianError(
                f"The {name} is not regular: the {words.hessian} is singular "
                f"at {where()} (reciprocal condition number "
                f"{float(found.regularity):.1e}). Give every coordinate a kinetic "
                "energy, or remove those without."
            ),
            f"initial_state: the {name} is not regular ({words.hessian} is singular).",
        ),
        Check(
            found.legendre_solved,
            lambda: NewtonError(
                f"No {fibre} with {words.legendre} was found for {where()}. Give "
                f"`{words.fibre}` instead of `{words.conjugate}`."
            ),
            f"initial_state: no {fibre} with {words.legendre} was found.",
        ),
        Check(
            found.projected,
            lambda: NewtonError(
                f"The state could not be projected onto the constraints: Newton's "
                f"method stopped at {reached()} with {phi} = {lin.violation}"
                f"{_positions(found)}. Start nearer to them."
            ),
            "initial_state: the state could not be projected onto the constraints.",
        ),
        Check(
            all_finite(
                (found.generator, found.regularity, lin.violation, found.positions)
            ),
            lambda: NonFiniteError(
                f"The {name}, its second derivatives in {words.fibre}, or the "
                f"constraint is not finite at {where()}: {words.letter} = "
                f"{found.generator}, {phi} = {lin.violation}"
                f"{_positions(found)}. Check the functions of the system at this state."
            ),
            f"initial_state: the {name} or the constraint is not finite there.",
        ),
        Check(
            ~(found.admissibility <= singular),
            lambda: _dependence_error(found, where(), phi),
            f"initial_state: the constraints are dependent (D2{phi} has not full "
            "rank).",
        ),
        Check(
            ~(found.compatibility <= singular),
            lambda: IncompatibleConstraintsError(
                f"The constraints are not compatible with the {name}: C = D2Φ M⁻¹ "
                f"D2Φᵀ is singular at {where()} (the paper's compatibility condition; "
                f"reciprocal condition number {float(found.compatibility):.1e}). No "
                "multiplier is determined there."
            ),
            "initial_state: the compatibility matrix C = D2Φ M⁻¹ D2Φᵀ is singular.",
        ),
        Check(
            jnp.all(jnp.abs(found.positions) <= found.allowed_positions),
            lambda: _position_error(found, project),
            "initial_state: a holonomic constraint is violated; pass `project=True`.",
        ),
        Check(
            jnp.all(jnp.abs(lin.violation) <= found.allowed),
            lambda: _violation_error(found, reached(), phi, project),
            "initial_state: the constraints are violated; pass `project=True`.",
        ),
        Check(
            all_finite((lin.acceleration, lin.multiplier)),
            lambda: NonFiniteError(
                f"The forces {words.force}, or the derivatives of {phi}, are not "
                f"finite at {where()}: the rate of {words.fibre} would be "
                f"{lin.acceleration}, the multiplier {lin.multiplier}. Check the "
                "functions of the system at this state."
            ),
            "initial_state: the forces or the multiplier are not finite there.",
        ),
    )


def _positions(found: Found) -> str:
    return f", Γ = {found.positions}" if found.positions.shape[0] else ""


def _dependence_error(found: Found, where: str, phi: str) -> DependentConstraintsError:
    jacobian, k = found.lin.jacobian, found.positions.shape[0]
    m = jacobian.shape[0] - k
    zero = [a for a in range(m + k) if not jnp.any(jacobian[a])]
    advice = (
        "Remove redundant constraints, or start from a state at which they are "
        "independent."
    )
    if zero and zero[0] < m:
        advice = (
            f"{phi}[{zero[0]}] does not depend on velocities there; pass a constraint "
            "on positions as `holonomic`."
        )
    elif zero:
        advice = (
            f"Γ[{zero[0] - m}] has no gradient there; a constraint must have one where "
            "it vanishes."
        )
    names = " and ".join([f"D2{phi}"] * (m > 0) + ["DΓ"] * (k > 0))
    return DependentConstraintsError(
        f"The constraints are dependent: {names} has not full rank at {where} (the "
        f"paper's admissibility condition; {names} = {jacobian.tolist()}). {advice}"
    )


def _listed(
    letters: list[str], values: Float[Array, " l"], allowed: Float[Array, " l"]
) -> list[str]:
    return [
        f"{letter} = {float(value):.6g} (allowed {float(bound):.1e})"
        for letter, value, bound in zip(letters, values, allowed, strict=True)
        if abs(value) > bound
    ]


def _violation_error(
    found: Found, reached: str, phi: str, project: bool
) -> ConstraintViolationError:
    violation, k = found.lin.violation, found.positions.shape[0]
    m = violation.shape[0] - k
    letters = [f"{phi}[{a}]" for a in range(m)] + [f"dΓ[{a}]/dt" for a in range(k)]
    bad = _listed(letters, violation, found.allowed)
    advice = (
        "the projection did not reach them"
        if project
        else "choose a velocity on the constraints, or pass `project=True`"
    )
    kind = "nonholonomic constraints" if k == 0 else "constraints on velocities"
    return ConstraintViolationError(
        f"{len(bad)} of {violation.shape[0]} {kind} violated at q = {found.state.q}, "
        f"{reached}: {'; '.join(bad)}; {advice}."
    )


def _position_error(found: Found, project: bool) -> ConstraintViolationError:
    letters = [f"Γ[{a}]" for a in range(found.positions.shape[0])]
    bad = _listed(letters, found.positions, found.allowed_positions)
    advice = (
        "the projection did not reach them"
        if project
        else "choose a configuration on the constraints, or pass `project=True`"
    )
    return ConstraintViolationError(
        f"{len(bad)} of {len(letters)} holonomic constraints violated at q = "
        f"{found.state.q}: {'; '.join(bad)}; {advice}."
    )
