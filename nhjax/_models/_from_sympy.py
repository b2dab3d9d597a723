from collections.abc import Callable, Mapping
from typing import Any

from jaxtyping import Array

from .._custom_types import FloatScalarLike
from .._system import LagrangianSystem
from ._description import (
    check_coordinates,
    Description,
    expression,
    expressions,
    generalised_forces,
    of_lagranges_method,
)
from ._kane import of_kanes_method
from ._library import mechanics
from ._model import parameter_defaults, SymPyModel
from ._printed import parts, place_symbols, Printed, printed, Symbols, with_symbols


def from_sympy(
    lagrangian: Any,
    coordinates: Any = None,
    *,
    nonholonomic: Any = None,
    holonomic: Any = None,
    forces: Any = None,
    parameters: Mapping[Any, FloatScalarLike] | None = None,
    frame: Any = None,
    potential: Any = None,
) -> SymPyModel:
    """Import a mechanical system that is written in SymPy.

    The expressions of the Lagrangian L(q, q', t), of the constraints and forces are
    written as functions of JAX by SymPy's own printer, and become a `LagrangianSystem`
    on R^n, with v = q'. Equations of motion are not derived in SymPy: nhjax takes the
    derivatives of L itself. What `sympy.physics.mechanics` helps with, frames, points
    and bodies, comes in through `kinetic_energy` and the like.

    **Arguments:**

    - `lagrangian`: L, an expression in the coordinates, their time derivatives and
        `dynamicsymbols._t`. Or a `LagrangesMethod`, which has all the rest but
        `parameters`. Or a `KanesMethod` with its bodies, whose speeds are replaced by
        rates of coordinates through its kinematical differential equations; its loads
        become forces, and its configuration and velocity constraints constraints.
    - `coordinates`: the q(t), a list of `dynamicsymbols`, in the order of q.
    - `nonholonomic`: expressions, or equations, in q, q' and t that are zero: linear in
        q' or not.
    - `holonomic`: expressions, or equations, in q and t that are zero.
    - `forces`: generalised forces, a list with one for each coordinate, or a dictionary
        by coordinates or their names; or a list of pairs of a point and a force, or a
        frame and a torque, as `LagrangesMethod` takes it, with `frame`.
    - `parameters`: values of the symbols that remain, by symbol or name; those without
        one must be in `args` at run time.
    - `frame`: the inertial frame of forces at points.
    - `potential`: the potential energy of a `KanesMethod`; by default the sum of those
        of its bodies. It must be given if these have one and there are loads beside
        it; 0 if the loads contain its forces.

    **Returns:** a `SymPyModel`, with `.system`, `.args` for `integrate(..., args=)` and
    the names of the coordinates, which `Solution.to_xarray` shows.

    **Raises:** `ImportError` without SymPy (`pip install "nhjax[sympy]"`); `TypeError`
    and `ValueError` that name what cannot be imported, such as a function of time that
    is no coordinate, an acceleration, a function that the printer does not know, a
    constraint without coordinates, or a KanesMethod whose energy has a constraint put
    into it. At run time `args` that lack a parameter, or have another, are refused by
    name.

    !!! example

        >>> import nhjax, sympy
        >>> from sympy.physics.mechanics import dynamicsymbols
        >>> x, y, θ = dynamicsymbols("x y θ")
        >>> dx, dy, dθ = (q.diff() for q in (x, y, θ))
        >>> m, J = sympy.symbols("m J")
        >>> model = nhjax.from_sympy(m * (dx**2 + dy**2) / 2 + J * dθ**2 / 2, [x, y, θ],
        ...     nonholonomic=dy * sympy.cos(θ) - dx * sympy.sin(θ),
        ...     parameters={m: 2.0, J: 0.1})
        >>> y0 = model.initial_state(q={}, v={"x": 1.0, "θ": 0.5})
        >>> sol = nhjax.integrate(model.system, nhjax.LobattoIIIAB(3), y0, dt=0.1,
        ...     num_steps=10, args=model.args)
        >>> round(float(sol.ys.q[-1, 1]), 6)
        0.244835
    """
    given = (coordinates, nonholonomic, holonomic, forces, frame)
    if isinstance(lagrangian, mechanics().LagrangesMethod | mechanics().KanesMethod):
        _refuse_more(lagrangian, *given)
        if isinstance(lagrangian, mechanics().KanesMethod):
            model = of_kanes_method(lagrangian, potential)
        else:
            _refuse_potential(potential)
            model = of_lagranges_method(lagrangian)
    else:
        _refuse_potential(potential)
        energy = expression("lagrangian", lagrangian)
        chosen = check_coordinates(coordinates)
        model = Description(
            energy,
            chosen,
            expressions("nonholonomic", nonholonomic),
            expressions("holonomic", holonomic),
            generalised_forces(forces, chosen, frame),
        )
    return _model(model, {} if parameters is None else parameters)


def _refuse_more(method: Any, *given: Any) -> None:
    names = ("coordinates", "nonholonomic", "holonomic", "forces", "frame")
    for name, value in zip(names, given, strict=True):
        if value is not None:
            raise ValueError(
                f"from_sympy: `{name}` is given together with a "
                f"{type(method).__name__}, which has its own: leave it out."
            )


def _refuse_potential(potential: Any) -> None:
    if potential is not None:
        raise ValueError(
            "from_sympy: `potential` belongs to a KanesMethod; put it into the "
            "Lagrangian."
        )


def _model(model: Description, parameters: Mapping[Any, Any]) -> SymPyModel:
    groups = {
        "lagrangian": [model.lagrangian],
        "nonholonomic": model.nonholonomic,
        "holonomic": model.holonomic,
        "forces": model.forces,
    }
    symbols = place_symbols(model.coordinates, [x for g in groups.values() for x in g])
    _check_constraints(model, symbols)

    names = tuple(str(q.func) for q in model.coordinates)

    def of_phase(name: str) -> Any:
        if not groups[name]:
            return None
        is_scalar = name == "lagrangian"
        return _of_phase(
            printed(name, groups[name], symbols, of_rates=True, is_scalar=is_scalar),
            names,
        )

    holonomic = None
    if model.holonomic:
        function = printed(
            "holonomic", model.holonomic, symbols, of_rates=False, is_scalar=False
        )
        holonomic = _of_position(function, names)
    system = LagrangianSystem(
        of_phase("lagrangian"),
        nonholonomic=of_phase("nonholonomic"),
        holonomic=holonomic,
        force=of_phase("forces"),
        coordinates=names,
    )
    known = tuple(symbol.name for symbol in symbols.parameters)
    return SymPyModel(system, parameter_defaults(parameters, known), names, known)


def _of_phase(function: Printed, names: tuple[str, ...]) -> Callable[..., Array]:
    def of_phase(t, q, v, args):
        return function(t, (*parts("q", q, names), *parts("v", v, names)), args)

    return of_phase


def _of_position(function: Printed, names: tuple[str, ...]) -> Callable[..., Array]:
    def of_position(t, q, args):
        return function(t, parts("q", q, names), args)

    return of_position


def _check_constraints(model: Description, symbols: Symbols) -> None:
    """Raise for constraints of the wrong kind, or of nothing that moves."""
    positions, velocities = set(symbols.coordinates), set(symbols.rates)
    for name, group in (
        ("nonholonomic", model.nonholonomic),
        ("holonomic", model.holonomic),
    ):
        for number, constraint in enumerate(group):
            free = with_symbols(name, constraint, symbols).free_symbols
            where = f"from_sympy: `{name}[{number}]`, {constraint},"
            if not free & (positions | velocities):
                raise ValueError(f"{where} contains no coordinate.")
            if name == "holonomic" and free & velocities:
                raise ValueError(
                    f"{where} contains velocities: give it as `nonholonomic`."
                )
            if name == "nonholonomic" and not free & velocities:
                raise ValueError(
                    f"{where} contains no velocity: give it as `holonomic`."
                )
