"""Models for Kane's method: their energies, with speeds u written in terms of q'."""

from typing import Any

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
    if potential is None:
        potential = mechanics().potential_energy(*bodies)
    lagrangian = (kinetic - expression("potential", potential)).subs(solved)
    conditions = method._k_nh * sympy().Matrix(speeds) + method._f_nh
    loads = list(method.loads or [])
    return Description(
        lagrangian,
        coordinates,
        [x.subs(solved) for x in conditions] if method._k_nh else [],
        list(method._f_h),
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
    """Tell whether an expression is zero, at some point that is nothing special."""
    library = sympy()
    functions = expression.atoms(library.core.function.AppliedUndef)
    # Derivatives first: the functions are parts of them.
    for kind in (expression.atoms(library.Derivative), functions):
        found = sorted(kind, key=str)
        values = [library.Rational(3 + i, 7 + 2 * i) for i in range(len(found))]
        expression = expression.xreplace(dict(zip(found, values, strict=True)))
    free = sorted(expression.free_symbols, key=str)
    values = [library.Rational(5 + i, 4 + 3 * i) for i in range(len(free))]
    value = expression.xreplace(dict(zip(free, values, strict=True)))
    return abs(complex(value.evalf())) < 1e-9


def _connected(point: Any) -> list[Any]:
    """List the points whose positions relative to `point` are known."""
    found = [point]
    for known in found:
        found += [other for other in known._pos_dict if other not in found]
    return found
