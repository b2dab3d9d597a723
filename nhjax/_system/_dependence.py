"""The error for constraints that depend on each other, with their names."""

import jax
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalar
from .._errors import DependentConstraintsError
from .._numerics import dependent_rows, has_zero_row, is_deficient
from ._abstract import AbstractMechanicalSystem
from ._state import State


def _names(num_nonholonomic: int, num_holonomic: int) -> list[str]:
    """List the names of all constraints, such as "nonholonomic[0]" or "holonomic[2]".

    The order is that of the rows of the Jacobian ∂Φ/∂u and of the multipliers.
    """
    return [f"nonholonomic[{a}]" for a in range(num_nonholonomic)] + [
        f"holonomic[{a}]" for a in range(num_holonomic)
    ]


def dependence_error(
    jacobian: Float[Array, "l n"],
    num_holonomic: int,
    letter: str,
    where: str,
) -> DependentConstraintsError:
    """Make the error that names the constraints which depend on each other.

    **Arguments:**

    - `jacobian`: the derivatives of all constraints, those of holonomic ones last, or
        of holonomic constraints alone.
    - `num_holonomic`: the number k of holonomic constraints.
    - `letter`: the letter of nonholonomic constraints, Φ or Ψ.
    - `where`: the state, as text.
    """
    rows, k = np.asarray(jacobian), num_holonomic
    m = rows.shape[0] - k
    names = _names(m, k)
    zero = [a for a in range(m + k) if not np.any(rows[a])]
    if zero and zero[0] < m:
        advice = (
            f"{names[zero[0]]} does not depend on velocities there; pass a "
            "constraint on positions as `holonomic`."
        )
    elif zero:
        advice = (
            f"{names[zero[0]]} has no gradient there; a constraint must have one "
            "where it vanishes."
        )
    elif _rank(rows[:m]) + _rank(rows[m:]) > _rank(rows):
        advice = (
            "A nonholonomic one of them follows from holonomic ones, which say more: "
            "the rate of a constraint on positions is kept with it. Remove it, start "
            "from a state at which it does not follow, or give the system "
            '`constraints="redundant"`.'
        )
    else:
        advice = (
            "Remove redundant constraints, start from a state at which they are "
            'independent, or give the system `constraints="redundant"`.'
        )
    derivatives = " and ".join([f"D2{letter}"] * (m > 0) + ["DΓ"] * (k > 0))
    have = "have" if m > 0 and k > 0 else "has"
    which = dependent_names(jacobian, k)
    return DependentConstraintsError(
        f"The constraints are dependent: {derivatives} {have} not full rank at {where} "
        f"(the paper's admissibility condition fails for {which}). {advice}"
    )


def dependent_names(matrix: Float[Array, "l c"], num_holonomic: int) -> str:
    """Name the constraints whose rows of a matrix depend on each other.

    The rows of the `num_holonomic` holonomic constraints are the last.
    """
    rows = np.asarray(matrix)
    names = _names(rows.shape[0] - num_holonomic, num_holonomic)
    return enumerated([names[a] for a in dependent_rows(rows)])


def require_independent(
    system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
) -> None:
    """Raise a `DependentConstraintsError` if constraints are dependent at a state."""
    u = system.fibre_coordinate(y)
    jacobian = jax.jacrev(system.constraint, argnums=2)(t, y.q, u, args)
    is_redundant = system.constraints == "redundant"
    lacking = has_zero_row if is_redundant else is_deficient
    if jacobian.shape[0] == 0 or not lacking(jacobian):
        return
    k = system.position_constraint(t, y.q, args).shape[0]
    letter = "Φ" if system.fibre_coordinate_name == "v" else "Ψ"
    where = f"q = {y.q}, {system.fibre_coordinate_name} = {u}"
    raise dependence_error(jacobian, k, letter, where)


def _rank(rows: np.ndarray) -> int:
    if not rows.size:
        return 0
    scaled = rows / np.max(np.abs(rows), axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(scaled, rtol=np.finfo(rows.dtype).eps ** 0.5))


def enumerated(names: list[str], conjunction: str = "and") -> str:
    """Write names as a list in a sentence, such as "a, b and c"."""
    first = [", ".join(names[:-1])] if names[1:] else []
    return f" {conjunction} ".join(first + names[-1:])
