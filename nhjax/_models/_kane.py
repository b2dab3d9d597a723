"""Models for Kane's method: their energies, with speeds u written in terms of q'."""

import zlib
from typing import Any

import numpy as np

from ._description import check_coordinates, Description, expression, of_loads, rates
from ._library import mechanics, sympy


def of_kanes_method(method: Any, potential: Any) -> Description:
    """Read a `KanesMethod` whose bodies it knows."""
    coordinates = check_coordinates(method.q)
    speeds = list(method.u)
    if len(speeds) != len(coordinates):
        raise ValueError(
            f"from_sympy: the KanesMethod has {len(speeds)} speeds "
            f"({_listed(speeds)}) for {len(coordinates)} coordinates "
            f"({_listed(coordinates)}). A Lagrangian needs a coordinate for each "
            "speed, also where the motion does not depend on it, such as the angle of "
            "a wheel and the place of its contact."
        )
    bodies, frame = list(method.bodies or []), method._inertial
    if not bodies:
        raise ValueError(
            "from_sympy: the KanesMethod knows no bodies: make it with `bodies=`, or "
            "call its `kanes_equations` before."
        )
    solved = _speeds_of_rates(method, coordinates, speeds)
    for body in bodies:
        _check_velocity(body, frame, solved)
    kinetic = mechanics().kinetic_energy(frame, *bodies)
    loads = list(method.loads or [])
    if potential is None:
        potential = mechanics().potential_energy(*bodies)
        if loads and potential != 0:
            raise ValueError(
                f"from_sympy: the bodies of the KanesMethod have the potential energy "
                f"{potential}, and there are loads. Kane's method leaves potential "
                "energies out: give `potential=0` if the loads contain its forces, "
                "and otherwise the energy itself as `potential`."
            )
    lagrangian = (kinetic - expression("potential", potential)).subs(solved)
    holonomic = list(method._f_h)
    return Description(
        lagrangian,
        coordinates,
        _nonholonomic(method, coordinates, speeds, solved, holonomic),
        holonomic,
        _forces(loads, coordinates, speeds, solved, frame) if loads else [],
    )


def _listed(names: list[Any]) -> str:
    return ", ".join(map(str, names))


def _speeds_of_rates(
    method: Any, coordinates: list[Any], speeds: list[Any]
) -> dict[Any, Any]:
    """Solve the kinematical differential equations for the speeds."""
    matrix, rest = method._k_ku_implicit, method._f_k_implicit
    of_rates = method._k_kqdot_implicit * sympy().Matrix(rates(coordinates))
    if sympy().simplify(matrix.det()) == 0:
        raise ValueError(
            "from_sympy: the kinematical differential equations do not determine the "
            f"speeds {_listed(speeds)} from the rates of the coordinates."
        )
    return dict(zip(speeds, matrix.LUsolve(-(of_rates + rest)), strict=True))


def _nonholonomic(
    method: Any,
    coordinates: list[Any],
    speeds: list[Any],
    solved: dict[Any, Any],
    holonomic: list[Any],
) -> list[Any]:
    """Return the velocity constraints that are no rates of holonomic ones.

    Kane's method needs the rates of its configuration constraints among its velocity
    constraints. They are linear in the speeds.
    """
    if not method._f_nh:
        return []
    given = method._k_nh * sympy().Matrix(speeds) + method._f_nh
    velocity = [x.subs(solved) for x in given]
    if not holonomic:
        return velocity
    t = mechanics().dynamicsymbols._t

    def row(x: Any) -> list[Any]:
        slopes = [x.diff(rate) for rate in rates(coordinates)]
        rest = x.subs(dict.fromkeys(rates(coordinates), 0))
        return [_at_a_point(part) for part in (*slopes, rest)]

    known = np.array([row(x.diff(t)) for x in holonomic])
    rank = np.linalg.matrix_rank(known)

    def is_new(x: Any) -> bool:
        return bool(np.linalg.matrix_rank(np.vstack([known, row(x)])) > rank)

    return [x for x in velocity if is_new(x)]


def _forces(
    loads: list[Any],
    coordinates: list[Any],
    speeds: list[Any],
    solved: dict[Any, Any],
    frame: Any,
) -> list[Any]:
    """Compute the generalised forces of the coordinates, by those of the speeds.

    With velocities v(q, u, q') the force of q is F·(∂v/∂u ∂u/∂q' + ∂v/∂q').
    """
    of_speeds = sympy().Matrix(of_loads(loads, speeds, frame))
    directly = sympy().Matrix(of_loads(loads, rates(coordinates), frame))
    slopes = sympy().Matrix([solved[u] for u in speeds]).jacobian(rates(coordinates))
    return [x.subs(solved) for x in slopes.T * of_speeds + directly]


def _check_velocity(body: Any, frame: Any, solved: dict[Any, Any]) -> None:
    """Raise if the velocity of a body has a constraint put into it.

    For Kane's method a point where a wheel touches the ground may be given the velocity
    zero, although the place of contact moves. The energy is then that of motions which
    satisfy the constraint, and Lagrange's equations of it are not those of the system.
    """
    centre = body.masscenter
    for point in _connected(centre)[1:]:
        if frame not in point._vel_dict:
            continue
        difference = centre.vel(frame) - point.vel(frame)
        moved = centre.pos_from(point).dt(frame)
        for component in (difference - moved).to_matrix(frame):
            if not _vanishes(component.subs(solved)):
                raise ValueError(
                    f"from_sympy: the velocity of {centre} relative to {point} is not "
                    "the rate of its position: a constraint such as rolling is put "
                    "into it already, and Lagrange's equations need the energy without "
                    "it. Give the place of the contact coordinates, and rolling as a "
                    "constraint."
                )


def _vanishes(expression: Any) -> bool:
    """Tell whether an expression vanishes at a generic point."""
    return abs(_at_a_point(expression)) < 1e-9


def _at_a_point(expression: Any) -> complex:
    """Evaluate an expression at a generic point, in the numbers of `_value_of`.

    The value of a variable depends on its name alone, so that several expressions are
    evaluated at the same point.
    """
    library = sympy()
    # Derivatives first: the functions are parts of them.
    for kind in (
        library.Derivative,
        library.core.function.AppliedUndef,
        library.Symbol,
    ):
        values = {x: _value_of(str(x)) for x in expression.atoms(kind)}
        expression = expression.xreplace(values)
    return complex(expression.evalf())


def _value_of(name: str) -> Any:
    """Return a number between 1/2 and 3/2 that belongs to a name."""
    return sympy().Rational(zlib.crc32(name.encode()) % 9973 + 4987, 9973)


def _connected(point: Any) -> list[Any]:
    """List the points whose positions relative to `point` are known."""
    found = [point]
    for known in found:
        found += [other for other in known._pos_dict if other not in found]
    return found
