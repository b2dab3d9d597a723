"""Checks of a computed initial state, with their error messages."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._errors import (
    Check,
    ConstraintViolationError,
    DependentConstraintsError,
    IncompatibleConstraintsError,
    IrregularLagrangianError,
    NewtonError,
    NonFiniteError,
)
from .._numerics import RankCondition
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    dependence_error,
    dependent_names,
    enumerated,
    Linearisation,
    State,
)
from ._projection import Fixed, Kept


class Found(NamedTuple):
    """A computed initial state, and the numbers that the checks need.

    - `lin`: the linearisation of the equations of motion at the state.
    - `off_group`: the distance of q, given or projected, from its group.
    - `regularity`, `compatibility`: the reciprocal condition numbers of the metric on
        the fibre, D2D2L or D2D2H, and of the compatibility matrix.
    - `ranks`, `deficient`: the constraint derivatives whose rank is checked, and
        whether each lacks full rank. For redundant constraints, the rank is deficient
        only if a row is zero.
    - `allowed`, `allowed_positions`, `allowed_off_group`: the bounds on the violations
        of constraints on velocities and on positions, and on `off_group`.
    - `legendre_solved`: whether the Legendre transform was inverted, if needed.
    - `projected`: whether the projection onto the constraints has converged.
    - `fixed_positions`, `fixed_velocities`: the combinations of constraints that kept
        components determine; None if no components are kept.
    """

    state: State
    lin: Linearisation
    generator: FloatScalar  # the value of L or H
    positions: Float[Array, " k"]  # the holonomic constraints
    off_group: FloatScalar
    regularity: FloatScalar
    ranks: list[RankCondition]
    deficient: list[BoolScalar]
    compatibility: FloatScalar
    allowed: Float[Array, " l"]
    allowed_positions: Float[Array, " k"]
    allowed_off_group: FloatScalar
    legendre_solved: BoolScalar
    projected: BoolScalar
    fixed_positions: Fixed | None
    fixed_velocities: Fixed | None


class _Words(NamedTuple):
    """The names of a system's functions and variables that messages use."""

    generator: str
    letter: str
    hessian: str
    force: str
    legendre: str
    coordinate: str
    dual: str
    constraint: str


_WORDS = {
    "lagrangian": _Words(
        generator="Lagrangian",
        letter="L",
        hessian="mass matrix D2D2L",
        force="D1L + F",
        legendre="D2L(t, q, v) = p",
        coordinate="v",
        dual="p",
        constraint="Φ",
    ),
    "hamiltonian": _Words(
        generator="Hamiltonian",
        letter="H",
        hessian="Hessian D2D2H",
        force="F - D1H",
        legendre="D2H(t, q, p) = v",
        coordinate="p",
        dual="v",
        constraint="Ψ",
    ),
}


class _Case(NamedTuple):
    """A computed state with the user's input, for error messages."""

    found: Found
    q: PyTree[Array]
    given_name: str
    given: Float[Array, " n"] | None
    project: bool
    words: _Words
    group: str
    keep: tuple[Kept, Kept]

    @property
    def where(self) -> str:
        # The message shows the values that the user passed.
        return f"q = {self.q}, {self.given_name} = {self.given}"

    @property
    def reached(self) -> str:
        letter = self.words.coordinate
        return f"{letter} = {getattr(self.found.state, letter)}"

    @property
    def coordinate_name(self) -> str:
        return "velocity" if self.words.coordinate == "v" else "momentum"

    @property
    def violations(self) -> str:
        found = self.found
        positions = f", Γ = {found.positions}" if found.positions.shape[0] else ""
        return f"{self.words.constraint} = {found.lin.violation}{positions}"


def judge(found: Found) -> list[BoolScalar | np.bool_]:
    """Return whether each condition of `list_checks` holds, in the same order."""
    state, lin = found.state, found.lin
    singular = 10 * state.v.shape[0] * jnp.finfo(state.v.dtype).eps
    values = found.generator, found.regularity, lin.violation, found.positions
    return [
        found.off_group <= found.allowed_off_group,
        # The negated "<=" lets NaN pass, since another check reports a matrix that is
        # not finite.
        ~(found.regularity <= singular),
        found.legendre_solved,
        *[~deficient for deficient in found.deficient],
        *[all_finite(rank.jacobian) | ~rank.is_active for rank in found.ranks],
        found.projected,
        all_finite(values),
        ~(found.compatibility <= singular),
        jnp.all(jnp.abs(found.positions) <= found.allowed_positions),
        jnp.all(jnp.abs(lin.violation) <= found.allowed),
        all_finite((lin.acceleration, lin.multiplier)),
    ]


def list_checks(
    system: AbstractMechanicalSystem,
    found: Found,
    holds: list[BoolScalar | np.bool_ | bool],
    q: PyTree[Array],
    v: Float[Array, " n"] | None,
    p: Float[Array, " n"] | None,
    project: bool,
    keep: tuple[Kept, Kept],
) -> list[Check]:
    """List the conditions on an initial state, each with its exception.

    `holds` has the result of `judge`: whether each condition holds.
    """
    name, given = ("p", p) if v is None else ("v", v)
    words, group = _WORDS[system.generator], f"{system.manifold_of(q)}"
    case = _Case(found, q, name, given, project, words, group, keep)
    errors = [
        (_group_error, case),
        (_regularity_error, case),
        (_legendre_error, case),
        *[(_dependence_error, case, rank) for rank in found.ranks],
        *[(_derivative_error, case, rank) for rank in found.ranks],
        (_projection_error, case),
        (_value_error, case),
        (_compatibility_error, case),
        (_position_error, case),
        (_violation_error, case),
        (_force_error, case),
    ]
    return [
        Check(ok, error, tuple(values))
        for ok, (error, *values) in zip(holds, errors, strict=True)
    ]


def _group_error(case: _Case) -> ConstraintViolationError:
    if case.keep[0].indices:
        where, q = "`q` with its kept numbers", case.found.state.q
        labels = enumerated(list(case.keep[0].labels))
        advice = (
            f"Keep fewer components than {labels} in `keep_q`, or pass "
            "`manifold.normalise(q)` as `q`."
        )
    elif case.project:
        where, q = "`q`", case.q
        advice = (
            "The projection found no element near it: a quaternion must not be zero."
        )
    else:
        where, q = "`q`", case.q
        advice = "Pass `project=True`, or `manifold.normalise(q)` as `q`."
    return ConstraintViolationError(
        f"{where} = {q} is not an element of the group {case.group}: it is off by "
        f"{float(case.found.off_group):.3g}. {advice}"
    )


def _regularity_error(case: _Case) -> IrregularLagrangianError:
    return IrregularLagrangianError(
        f"The {case.words.generator} is not regular: the {case.words.hessian} is "
        f"singular at {case.where} (reciprocal condition number "
        f"{float(case.found.regularity):.1e}). Give every coordinate a kinetic energy, "
        "or remove the coordinates without one."
    )


def _legendre_error(case: _Case) -> NewtonError:
    return NewtonError(
        f"No {case.coordinate_name} with {case.words.legendre} was found for "
        f"{case.where}. Give `{case.words.coordinate}` instead of `{case.words.dual}`."
    )


def _derivative_error(case: _Case, rank: RankCondition) -> NonFiniteError:
    rows, k = np.asarray(rank.jacobian), case.found.positions.shape[0]
    bad = int(np.flatnonzero(~np.all(np.isfinite(rows), axis=1))[0])
    m, words = rows.shape[0] - k, case.words
    name, variable = (f"{words.constraint}[{bad}]", words.coordinate)
    if bad >= m:
        name, variable = f"Γ[{bad - m}]", "q"
    return NonFiniteError(
        f"{name}, or its derivative with respect to {variable}, is not finite at q = "
        f"{rank.q}, {case.given_name} = {case.given}. Check it there. `jnp.sqrt` and "
        "`jnp.linalg.norm` have no derivative at 0: in place of the length of a "
        "vector, pass its components as constraints."
    )


def _projection_error(case: _Case) -> NewtonError:
    return NewtonError(
        f"The state could not be projected onto the constraints from {case.where}: "
        f"Newton's method stopped at q = {case.found.state.q}, {case.reached} with "
        f"{case.violations}. Start nearer to the constraints"
        f"{_or_keep_fewer(*case.keep)}. In place of a square, pass the expression "
        "itself: the derivative of a square is zero where the constraint holds."
    )


def _value_error(case: _Case) -> NonFiniteError:
    words = case.words
    return NonFiniteError(
        f"The {words.generator}, its second derivatives in {words.coordinate}, or the "
        f"constraint is not finite at {case.where}: {words.letter} = "
        f"{case.found.generator}, {case.violations}. Check the functions of the system "
        "at this state."
    )


def _compatibility_error(case: _Case) -> IncompatibleConstraintsError:
    jacobian, reaction, _ = case.found.lin.dense
    which = dependent_names(jacobian @ reaction, case.found.positions.shape[0])
    return IncompatibleConstraintsError(
        f"The constraints are not compatible with the {case.words.generator}: C = D2Φ "
        f"M⁻¹ D2Φᵀ is singular at {case.where} (the paper's compatibility condition "
        f"fails for {which}; reciprocal condition number "
        f"{float(case.found.compatibility):.1e}). These multipliers "
        "are not determined: remove or change the constraints."
    )


def _force_error(case: _Case) -> NonFiniteError:
    words, lin = case.words, case.found.lin
    return NonFiniteError(
        f"The forces {words.force}, or the derivatives of {words.constraint}, are not "
        f"finite at {case.where}: d{words.coordinate}/dt = {lin.acceleration} and "
        f"multiplier = {lin.multiplier}. Check the functions of the system at this "
        "state. With a force that depends on the multipliers, such as strong friction, "
        "there may be no reaction that solves the equations."
    )


def _dependence_error(case: _Case, rank: RankCondition) -> DependentConstraintsError:
    return dependence_error(
        rank.jacobian,
        case.found.positions.shape[0],
        case.words.constraint,
        f"q = {rank.q}, {case.given_name} = {case.given}",
    )


def _or_keep_fewer(*keep: Kept) -> str:
    kept = [x for x in keep if x.indices]
    if not kept:
        return ""
    listed = [f"{enumerated(list(x.labels))} (`{x.argument}`)" for x in kept]
    return f", or keep fewer components than {enumerated(listed)}"


def _listed(
    letters: list[str], values: Float[Array, " l"], allowed: Float[Array, " l"]
) -> list[str]:
    return [
        f"{letter} = {float(value):.6g} (allowed {float(bound):.1e})"
        for letter, value, bound in zip(letters, values, allowed, strict=True)
        if abs(value) > bound
    ]


def _violation_error(case: _Case) -> ConstraintViolationError:
    found, phi = case.found, case.words.constraint
    violation, k = found.lin.violation, found.positions.shape[0]
    m = violation.shape[0] - k
    letters = [f"{phi}[{a}]" for a in range(m)] + [f"dΓ[{a}]/dt" for a in range(k)]
    bad = _listed(letters, violation, found.allowed)
    kind = "nonholonomic constraints" if k == 0 else "constraints on velocities"
    if not case.project:
        advice = "choose a velocity on the constraints, or pass `project=True`"
    else:
        advice = _unreached(
            found.fixed_velocities, case.keep[1], letters, violation, found.allowed
        )
    return ConstraintViolationError(
        f"{len(bad)} of {violation.shape[0]} {kind} violated at q = {found.state.q}, "
        f"{case.reached}: {'; '.join(bad)}; {advice}."
    )


def _position_error(case: _Case) -> ConstraintViolationError:
    found = case.found
    letters = [f"Γ[{a}]" for a in range(found.positions.shape[0])]
    bad = _listed(letters, found.positions, found.allowed_positions)
    if not case.project:
        advice = "choose a configuration on the constraints, or pass `project=True`"
    else:
        allowed = found.allowed_positions
        advice = _unreached(
            found.fixed_positions, case.keep[0], letters, found.positions, allowed
        )
    return ConstraintViolationError(
        f"{len(bad)} of {len(letters)} holonomic constraints violated at q = "
        f"{found.state.q}: {'; '.join(bad)}; {advice}."
    )


def _unreached(
    fixed: Fixed | None,
    kept: Kept,
    letters: list[str],
    violation: Float[Array, " l"],
    allowed: Float[Array, " l"],
) -> str:
    """Describe why a projection left a violation, with advice."""
    missed = "the projection did not reach them"
    if fixed is None:
        return missed
    # The part of the violation that no change of the free components can remove.
    left = fixed.projector @ (violation / fixed.sizes)
    rows = [a for a, x in enumerate(left) if abs(x) > allowed[a] / fixed.sizes[a]]
    if not rows:
        return f"{missed}{_or_keep_fewer(kept)}"
    # Each column is the change of this part along one kept component.
    released = fixed.projector @ fixed.slopes
    small = float(np.finfo(left.dtype).eps) ** 0.5
    largest = np.max(np.abs(left))
    involved, helpful = [], []
    for label, column in zip(kept.labels, released.T, strict=True):
        size = np.linalg.norm(column)
        direction = column / size if size > small else np.zeros_like(column)
        corrected = direction * (direction @ left)
        involved += [label] * bool(np.max(np.abs(corrected)) > small * largest)
        helpful += [label] * bool(np.max(np.abs(left - corrected)) <= small * largest)
    names = enumerated([letters[a] for a in rows])
    is_each_fixed = np.all(np.diagonal(fixed.projector)[rows] > 1 - small)
    what = names if is_each_fixed else f"a combination of {names}"
    if not involved:
        return (
            f"{what} cannot be changed there by any component: start from another state"
        )
    release = enumerated(helpful, "or") or f"more than one of {enumerated(involved)}"
    return (
        f"the components that `{kept.argument}` keeps determine {what}: leave "
        f"{release} out of `{kept.argument}`, or keep values that satisfy the "
        "constraints"
    )
