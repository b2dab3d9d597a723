"""What a model in SymPy says: its Lagrangian, constraints and forces as expressions."""

import contextlib
import reprlib
from collections.abc import Iterable, Mapping, Set
from typing import Any, NamedTuple

from ._library import mechanics, sympy


class Description(NamedTuple):
    """The expressions of a model, in coordinates q(t), their rates and the time.

    There are as many `forces`, the generalised ones, as `coordinates`, or none.
    """

    lagrangian: Any
    coordinates: list[Any]
    nonholonomic: list[Any]
    holonomic: list[Any]
    forces: list[Any]


def expressions(name: str, given: Any) -> list[Any]:
    """Return one or several expressions, or equations, as a list of expressions."""
    if given is None:
        return []
    library = sympy()
    if isinstance(given, library.MatrixBase):
        given = list(given)
    if isinstance(given, Set | library.Set):
        raise TypeError(
            f"from_sympy: `{name}` is a set, which has no order: give a list."
        )
    several = isinstance(given, Iterable) and not isinstance(given, str | Mapping)
    return [expression(name, x) for x in (given if several else [given])]


def expression(name: str, x: Any) -> Any:
    """Return an expression; an equation is the difference of its sides."""
    library = sympy()
    if isinstance(x, library.MatrixBase) and x.shape == (1, 1):
        x = x[0, 0]
    # Strict, so that no string is evaluated.
    with contextlib.suppress(library.SympifyError):
        x = library.sympify(x, strict=True)
    if isinstance(x, library.Equality):
        x = x.lhs - x.rhs
    matrix = library.MatrixBase | library.MatrixExpr
    if not isinstance(x, library.Expr) or isinstance(x, matrix):
        raise TypeError(
            f"from_sympy: `{name}` must be of scalar expressions of SymPy, got "
            f"{reprlib.repr(x)} of type {type(x).__name__}."
        )
    return x


def rates(coordinates: list[Any]) -> list[Any]:
    """Return the derivatives of the coordinates by time."""
    t = mechanics().dynamicsymbols._t
    return [q.diff(t) for q in coordinates]


def check_coordinates(coordinates: Any) -> list[Any]:
    """Return the coordinates as a list; raise unless they are different q(t)."""
    library, t = sympy(), mechanics().dynamicsymbols._t
    found = expressions("coordinates", coordinates)
    if not found:
        raise ValueError("from_sympy: `coordinates` is empty: give at least one q(t).")
    for q in found:
        if not isinstance(q, library.core.function.AppliedUndef) or q.args != (t,):
            raise TypeError(
                f"from_sympy: the coordinate {q} is no function of time, of the symbol "
                "`dynamicsymbols._t`; make it by "
                "`sympy.physics.mechanics.dynamicsymbols`."
            )
    names = [str(q.func) for q in found]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"from_sympy: the coordinate {name} is given twice.")
    return found


def generalised_forces(forces: Any, coordinates: list[Any], frame: Any) -> list[Any]:
    """Return the generalised force of each coordinate; an empty list for none."""
    if forces is None:
        return []
    if isinstance(forces, Mapping):
        return _by_coordinate(forces, coordinates)
    pairs = list(forces) if isinstance(forces, Iterable) else [forces]
    if pairs and all(_is_load(pair) for pair in pairs):
        return of_loads(pairs, rates(coordinates), frame)
    found = expressions("forces", forces)
    if len(found) != len(coordinates):
        raise ValueError(
            f"from_sympy: `forces` has {len(found)} entries, but there are "
            f"{len(coordinates)} coordinates. Give one for each, a dictionary of "
            "coordinates, or pairs of a point and a force, or a frame and a torque."
        )
    return found


def _by_coordinate(forces: Mapping[Any, Any], coordinates: list[Any]) -> list[Any]:
    """Put the forces of a dictionary, by coordinates or their names, in their order."""
    of_name = {str(q.func): q for q in coordinates}
    of_coordinate: dict[Any, Any] = {}
    for key, force in forces.items():
        q = of_name.get(key) if isinstance(key, str) else key
        if q not in coordinates:
            raise ValueError(
                f"from_sympy: `forces` has {key}, not among the coordinates "
                f"{', '.join(map(str, coordinates))}."
            )
        if q in of_coordinate:
            raise ValueError(f"from_sympy: `forces` has {q} twice, once by its name.")
        of_coordinate[q] = force
    return [expression("forces", of_coordinate.get(q, 0)) for q in coordinates]


def _is_load(pair: Any) -> bool:
    vector = mechanics().Vector
    return isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], vector)


def of_loads(loads: list[Any], speeds: list[Any], frame: Any) -> list[Any]:
    """Compute the generalised forces Σ F·∂v/∂u of loads, for each of the speeds u."""
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


def of_lagranges_method(method: Any) -> Description:
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
        of_loads(loads, rates(coordinates), method.inertial) if loads else [],
    )
