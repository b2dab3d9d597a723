"""Reading a model from SymPy: its Lagrangian, constraints and forces as expressions.

The model is given as expressions, as a `LagrangesMethod`, or as a `KanesMethod`, whose
speeds u are then written in terms of q'. SymPy is an optional dependency, and is
imported when it is first needed.
"""

import contextlib
import reprlib
import zlib
from collections.abc import Iterable, Mapping, Set
from typing import Any, NamedTuple

import numpy as np


class Description(NamedTuple):
    """The expressions of a model, in coordinates q(t), their rates and the time.

    `forces` has one generalised force for each coordinate, or is empty.
    """

    lagrangian: Any
    coordinates: list[Any]
    nonholonomic: list[Any]
    holonomic: list[Any]
    forces: list[Any]


def read_lagranges_method(method: Any) -> Description:
    """Read a `LagrangesMethod`."""
    coordinates = check_coordinates(method.q)
    holonomic = list(method._hol_coneqs)
    # `coneqs` begins with the rates of the holonomic constraints.
    nonholonomic = list(method.coneqs)[len(holonomic) :]
    loads = list(method.forcelist or [])
    return Description(
        expression("lagrangian", method._L),
        coordinates,
        nonholonomic,
        holonomic,
        forces_of_loads(loads, rates(coordinates), method.inertial) if loads else [],
    )


def read_kanes_method(method: Any, potential: Any) -> Description:
    """Read a `KanesMethod` that has bodies.

    If `potential` is None, the potential energy is the sum over the bodies.
    """
    coordinates = check_coordinates(method.q)
    speeds = list(method.u)
    if len(speeds) != len(coordinates):
        raise ValueError(
            f"from_sympy: the KanesMethod has {len(speeds)} speeds "
            f"({_comma_separated(speeds)}) for {len(coordinates)} coordinates "
            f"({_comma_separated(coordinates)}). A Lagrangian needs a coordinate for "
            "each speed, even if the motion does not depend on it, such as the angle "
            "of a wheel and the position of its contact point."
        )
    bodies, frame = list(method.bodies or []), method._inertial
    if not bodies:
        raise ValueError(
            "from_sympy: the KanesMethod has no bodies: create it with `bodies=`, or "
            "call its `kanes_equations` first."
        )
    solved = _solve_for_speeds(method, coordinates, speeds)
    for body in bodies:
        _check_velocity(body, frame, solved)
    kinetic = mechanics().kinetic_energy(frame, *bodies)
    loads = list(method.loads or [])
    if potential is None:
        potential = mechanics().potential_energy(*bodies)
        if loads and potential != 0:
            raise ValueError(
                f"from_sympy: the bodies of the KanesMethod have the potential energy "
                f"{potential}, and there are loads. Kane's method ignores potential "
                "energies: pass `potential=0` if the loads contain its forces, and "
                "otherwise pass the energy itself as `potential`."
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


def _comma_separated(names: list[Any]) -> str:
    return ", ".join(map(str, names))


def _solve_for_speeds(
    method: Any, coordinates: list[Any], speeds: list[Any]
) -> dict[Any, Any]:
    """Solve the kinematical differential equations for the speeds."""
    matrix, rest = method._k_ku_implicit, method._f_k_implicit
    of_rates = method._k_kqdot_implicit * sympy().Matrix(rates(coordinates))
    if sympy().simplify(matrix.det()) == 0:
        raise ValueError(
            "from_sympy: the kinematical differential equations do not determine the "
            f"speeds {_comma_separated(speeds)} from the rates of the coordinates."
        )
    return dict(zip(speeds, matrix.LUsolve(-(of_rates + rest)), strict=True))


def _nonholonomic(
    method: Any,
    coordinates: list[Any],
    speeds: list[Any],
    solved: dict[Any, Any],
    holonomic: list[Any],
) -> list[Any]:
    """Return the velocity constraints that are not rates of holonomic constraints.

    The velocity constraints of a `KanesMethod` include the rates of its configuration
    constraints. All velocity constraints are linear in the speeds.
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
        return [_evaluate_at_generic_point(part) for part in (*slopes, rest)]

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
    """Compute generalised forces for the coordinates from forces for the speeds.

    A force F at a point of velocity v(q, u, q') has the generalised force
    F·(∂v/∂u ∂u/∂q' + ∂v/∂q').
    """
    of_speeds = sympy().Matrix(forces_of_loads(loads, speeds, frame))
    directly = sympy().Matrix(forces_of_loads(loads, rates(coordinates), frame))
    slopes = sympy().Matrix([solved[u] for u in speeds]).jacobian(rates(coordinates))
    return [x.subs(solved) for x in slopes.T * of_speeds + directly]


def _check_velocity(body: Any, frame: Any, solved: dict[Any, Any]) -> None:
    """Raise if a constraint was substituted into the velocity of a body.

    In Kane's method, a model may set the velocity of the point where a wheel touches
    the ground to zero, although the contact moves. The energy is then correct only for
    motions that satisfy the constraint, and Lagrange equations derived from this energy
    are wrong.
    """
    centre = body.masscenter
    for point in _connected_points(centre)[1:]:
        if frame not in point._vel_dict:
            continue
        difference = centre.vel(frame) - point.vel(frame)
        moved = centre.pos_from(point).dt(frame)
        for component in (difference - moved).to_matrix(frame):
            if not _vanishes(component.subs(solved)):
                raise ValueError(
                    f"from_sympy: the velocity of {centre} relative to {point} is not "
                    "the rate of its position: a constraint such as rolling was "
                    "substituted, but Lagrange's equations need the energy without it. "
                    "Describe the position of the contact by coordinates, and rolling "
                    "by a constraint."
                )


def _vanishes(expression: Any) -> bool:
    """Return whether an expression vanishes at a generic point."""
    return abs(_evaluate_at_generic_point(expression)) < 1e-9


def _evaluate_at_generic_point(expression: Any) -> complex:
    """Evaluate an expression with each variable replaced by its `_value_of`.

    The value of a variable depends only on its name, so that all expressions are
    evaluated at the same point.
    """
    library = sympy()
    # Replace derivatives first, because they contain functions.
    for kind in (
        library.Derivative,
        library.core.function.AppliedUndef,
        library.Symbol,
    ):
        values = {x: _value_of(str(x)) for x in expression.atoms(kind)}
        expression = expression.xreplace(values)
    return complex(expression.evalf())


def _value_of(name: str) -> Any:
    """Return a pseudo-random number between 1/2 and 3/2 for a name."""
    return sympy().Rational(zlib.crc32(name.encode()) % 9973 + 4987, 9973)


def _connected_points(point: Any) -> list[Any]:
    """List `point`, and the points whose positions relative to it are known."""
    found = [point]
    for known in found:
        found += [other for other in known._pos_dict if other not in found]
    return found


def expressions(name: str, given: Any) -> list[Any]:
    """Return one or several expressions or equations as a list of expressions."""
    if given is None:
        return []
    library = sympy()
    if isinstance(given, library.MatrixBase):
        given = list(given)
    if isinstance(given, Set | library.Set):
        raise TypeError(
            f"from_sympy: `{name}` is a set, which has no order: pass a list."
        )
    several = isinstance(given, Iterable) and not isinstance(given, str | Mapping)
    return [expression(name, x) for x in (given if several else [given])]


def expression(name: str, x: Any) -> Any:
    """Return an expression; an equation becomes the difference of its sides."""
    library = sympy()
    if isinstance(x, library.MatrixBase) and x.shape == (1, 1):
        x = x[0, 0]
    # With `strict`, SymPy does not evaluate strings.
    with contextlib.suppress(library.SympifyError):
        x = library.sympify(x, strict=True)
    if isinstance(x, library.Equality):
        x = x.lhs - x.rhs
    matrix = library.MatrixBase | library.MatrixExpr
    if not isinstance(x, library.Expr) or isinstance(x, matrix):
        raise TypeError(
            f"from_sympy: `{name}` must consist of scalar SymPy expressions, got "
            f"{reprlib.repr(x)} of type {type(x).__name__}."
        )
    return x


def rates(coordinates: list[Any]) -> list[Any]:
    """Return the time derivatives of the coordinates."""
    t = mechanics().dynamicsymbols._t
    return [q.diff(t) for q in coordinates]


def check_coordinates(coordinates: Any) -> list[Any]:
    """List the coordinates; raise unless they are distinct functions q(t)."""
    library, t = sympy(), mechanics().dynamicsymbols._t
    found = expressions("coordinates", coordinates)
    if not found:
        raise ValueError("from_sympy: `coordinates` is empty: pass at least one q(t).")
    for q in found:
        if not isinstance(q, library.core.function.AppliedUndef) or q.args != (t,):
            raise TypeError(
                f"from_sympy: the coordinate {q} is not a function of the time "
                "`dynamicsymbols._t`; create it with "
                "`sympy.physics.mechanics.dynamicsymbols`."
            )
    names = [str(q.func) for q in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"from_sympy: the coordinate {name} is given twice.")
    return found


def generalised_forces(forces: Any, coordinates: list[Any], frame: Any) -> list[Any]:
    """Return the generalised force of each coordinate; an empty list for None."""
    if forces is None:
        return []
    if isinstance(forces, Mapping):
        return _order_by_coordinate(forces, coordinates)
    pairs = list(forces) if isinstance(forces, Iterable) else [forces]
    if pairs and all(_is_load(pair) for pair in pairs):
        return forces_of_loads(pairs, rates(coordinates), frame)
    found = expressions("forces", forces)
    if len(found) != len(coordinates):
        raise ValueError(
            f"from_sympy: `forces` has {len(found)} entries, but there are "
            f"{len(coordinates)} coordinates. Pass one for each, a dictionary by "
            "coordinates, or pairs of a point and a force, or a frame and a torque."
        )
    return found


def _order_by_coordinate(
    forces: Mapping[Any, Any], coordinates: list[Any]
) -> list[Any]:
    """List forces, given by coordinates or their names, in the order of coordinates."""
    of_name = {str(q.func): q for q in coordinates}
    of_coordinate: dict[Any, Any] = {}
    for key, force in forces.items():
        q = of_name.get(key) if isinstance(key, str) else key
        if q not in coordinates:
            raise ValueError(
                f"from_sympy: `forces` has {key}, which is not one of the "
                f"coordinates {', '.join(map(str, coordinates))}."
            )
        if q in of_coordinate:
            raise ValueError(f"from_sympy: `forces` has {q} twice, also by its name.")
        of_coordinate[q] = force
    return [expression("forces", of_coordinate.get(q, 0)) for q in coordinates]


def _is_load(pair: Any) -> bool:
    vector = mechanics().Vector
    return isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], vector)


def forces_of_loads(loads: list[Any], speeds: list[Any], frame: Any) -> list[Any]:
    """Compute, for each speed u, the force Σ F·∂v/∂u of loads F with velocities v."""
    module = mechanics()
    if not isinstance(frame, module.ReferenceFrame):
        raise TypeError(
            "from_sympy: forces at points and torques on frames need `frame`, the "
            f"inertial ReferenceFrame, got {frame!r}."
        )
    total = [sympy().S.Zero for _ in speeds]
    for where, vector in loads:
        if isinstance(where, module.ReferenceFrame):
            velocity = where.ang_vel_in(frame)
        elif isinstance(where, module.Point):
            velocity = where.vel(frame)
        else:
            raise TypeError(
                f"from_sympy: a load acts on {where!r} of type {type(where).__name__}, "
                "but it must be a Point or a ReferenceFrame."
            )
        for i, u in enumerate(speeds):
            total[i] += velocity.diff(u, frame, var_in_dcm=False).dot(vector)
    return total


def sympy() -> Any:
    """Return the module `sympy`, with `sympy.physics.mechanics` loaded."""
    try:
        import sympy
        import sympy.physics.mechanics
    except ImportError as error:
        raise ImportError(
            "nhjax.from_sympy needs SymPy, an optional dependency: "
            '`pip install "nhjax[sympy]"`.'
        ) from error
    return sympy


def mechanics() -> Any:
    """Return the module `sympy.physics.mechanics`."""
    return sympy().physics.mechanics
