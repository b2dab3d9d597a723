"""The import of a model from SymPy, whose expressions become functions of JAX.

`from_sympy` reads the model, replaces coordinates and rates by symbols, lets SymPy's
printer write the expressions as functions of JAX, and wraps these in a
`LagrangianSystem`.
"""

import importlib
import math
import numbers
import reprlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalarLike
from .._errors import is_traced, ShapeError
from .._initial import initial_state
from .._system import LagrangianSystem, State
from ._description import (
    check_coordinates,
    Description,
    expression,
    expressions,
    generalised_forces,
    mechanics,
    read_kanes_method,
    read_lagranges_method,
    sympy,
)


class SymPyModel(eqx.Module):
    """A model that `from_sympy` has imported.

    - `system`: the system, whose `args` are a dictionary of the parameters by name.
    - `args`: the parameter values that `from_sympy` was given, by name.
    - `coordinates`: the names of the coordinates, in the order of q.
    - `parameters`: the names of all parameters.
    """

    system: LagrangianSystem
    args: dict[str, Array]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    parameters: tuple[str, ...] = eqx.field(static=True)

    def initial_state(
        self,
        q: Mapping[Any, FloatScalarLike] | Float[Array, " n"],
        v: Mapping[Any, FloatScalarLike] | Float[Array, " n"],
        *,
        t: FloatScalarLike = 0.0,
        args: Args = None,
        project: bool = False,
        keep_q: Any = None,
        keep_v: Any = None,
    ) -> State:
        """Create a consistent state, as `nhjax.initial_state` does.

        **Arguments:**

        - `q`, `v`: coordinates and velocities, as arrays, or as dictionaries whose keys
            are coordinates of SymPy or their names. Missing entries are zero.
        - `t`: the time.
        - `args`: the parameters. The default is `self.args`.
        - `project`: whether to project the state onto the constraints.
        - `keep_q`, `keep_v`: the coordinates and velocities that the projection must
            not change: indices, names or SymPy coordinates, one or several.

        **Returns:** a `State`.

        **Raises:** as `nhjax.initial_state` does; `ValueError` for unknown names and
        names given twice; `TypeError` for parameters that are not real numbers.
        """
        q, v = self._array("q", q), self._array("v", v)
        args = self.args if args is None else args
        # Check `args` first, because JAX cannot sort keys that are symbols.
        parameter_values(self.parameters, args)
        return initial_state(
            self.system,
            q,
            v,
            t=t,
            args=args,
            project=project,
            keep_q=_with_names(keep_q),
            keep_v=_with_names(keep_v),
        )

    def _array(self, name: str, given: Any) -> Array:
        if not isinstance(given, Mapping):
            return given
        values = _by_name(f"`{name}`", given)
        unknown = [key for key in values if key not in self.coordinates]
        if unknown:
            raise ValueError(
                f"`{name}` has {', '.join(unknown)}, but the coordinates are "
                f"{', '.join(self.coordinates)}."
            )
        found = [values.get(key, 0.0) for key in self.coordinates]
        made = [jnp.asarray(x, jnp.result_type(float)) for x in found]
        for key, x in zip(self.coordinates, made, strict=True):
            if x.shape != ():
                raise ShapeError(
                    f"`{name}[{key!r}]` has shape {x.shape}, but a coordinate is a "
                    "scalar; for several states use `jax.vmap`."
                )
        return jnp.stack(made)


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

    SymPy's printer writes the Lagrangian L(q, q', t), the constraints and the forces as
    functions of JAX. These become a `LagrangianSystem` on R^n, with v = q'. SymPy does
    not derive equations of motion: nhjax differentiates L itself. Frames, points and
    bodies of `sympy.physics.mechanics` can be used through functions such as
    `kinetic_energy`.

    **Arguments:**

    - `lagrangian`: L, an expression in the coordinates, their time derivatives and
        `dynamicsymbols._t`. It may also be a `LagrangesMethod`, which defines all other
        arguments except `parameters`, or a `KanesMethod` with bodies. The kinematical
        differential equations of a `KanesMethod` replace speeds by rates of
        coordinates, its loads become forces, and its configuration and velocity
        constraints become constraints.
    - `coordinates`: the functions q(t), a list of `dynamicsymbols`, in the order of q.
    - `nonholonomic`: expressions in q, q' and t that must be zero, or equations. They
        need not be linear in q'.
    - `holonomic`: expressions in q and t that must be zero, or equations.
    - `forces`: generalised forces, as a list with one for each coordinate, or as a
        dictionary with coordinates or their names as keys. It may also be a list of
        pairs: (point, force) or (frame, torque), as for `LagrangesMethod`; `frame` is
        then required.
    - `parameters`: a dictionary of values of the remaining symbols, with symbols or
        names as keys. Values that are not given here must be added to `args` at run
        time.
    - `frame`: the inertial frame for forces at points and torques on frames.
    - `potential`: the potential energy of a `KanesMethod`. The default is the sum of
        the potential energies of its bodies. The argument is required if bodies have a
        potential energy and there are loads, because the loads may already include the
        forces of this energy: if they do, pass 0; otherwise pass the energy.

    **Returns:** a `SymPyModel` with the `system`, the `args` for `integrate`, and the
    names of the coordinates, which `Solution.to_xarray` uses.

    **Raises:** `ImportError` without SymPy (`pip install "nhjax[sympy]"`); `TypeError`
    and `ValueError` that name the part that cannot be imported, such as a function of
    time that is not a coordinate, an acceleration, a function that the printer does not
    know, a constraint without coordinates, or a KanesMethod in which a constraint was
    substituted into the velocity of a body. At run time, an error names missing and
    unknown parameters in `args`.

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
        _check_not_given(lagrangian, *given)
        if isinstance(lagrangian, mechanics().KanesMethod):
            model = read_kanes_method(lagrangian, potential)
        else:
            _check_no_potential(potential)
            model = read_lagranges_method(lagrangian)
    else:
        _check_no_potential(potential)
        energy = expression("lagrangian", lagrangian)
        chosen = check_coordinates(coordinates)
        model = Description(
            energy,
            chosen,
            expressions("nonholonomic", nonholonomic),
            expressions("holonomic", holonomic),
            generalised_forces(forces, chosen, frame),
        )
    return _build_model(model, {} if parameters is None else parameters)


def _check_not_given(method: Any, *given: Any) -> None:
    names = ("coordinates", "nonholonomic", "holonomic", "forces", "frame")
    for name, value in zip(names, given, strict=True):
        if value is not None:
            raise ValueError(
                f"from_sympy: `{name}` is given together with a "
                f"{type(method).__name__}, which defines it already: omit it."
            )


def _check_no_potential(potential: Any) -> None:
    if potential is not None:
        raise ValueError(
            "from_sympy: `potential` is for a KanesMethod only; include it in the "
            "Lagrangian."
        )


class Symbols(NamedTuple):
    """The symbols that replace coordinates and rates, and the parameters.

    - `of`: the symbol of each coordinate and rate.
    - `coordinates`, `rates`: these symbols, in the order of the coordinates.
    - `parameters`: all other symbols of the expressions, sorted by name.
    """

    of: dict[Any, Any]
    coordinates: list[Any]
    rates: list[Any]
    parameters: list[Any]


def make_symbols(coordinates: list[Any], all_expressions: list[Any]) -> Symbols:
    """Create the symbols of a model, and find its parameters."""
    library, t = sympy(), mechanics().dynamicsymbols._t
    positions = [library.Dummy(f"q_{q.func}") for q in coordinates]
    velocities = [library.Dummy(f"v_{q.func}") for q in coordinates]
    of = dict(zip(coordinates, positions, strict=True))
    of |= {q.diff(t): v for q, v in zip(coordinates, velocities, strict=True)}
    free = set().union(*(x.free_symbols for x in all_expressions)) - {t}
    for symbol in sorted(free, key=str):
        if not isinstance(symbol, library.Symbol):
            raise TypeError(
                f"from_sympy: {symbol} is a {type(symbol).__name__}, but parameters "
                "must be scalar Symbols."
            )
    parameters = sorted(free, key=lambda symbol: symbol.name)
    names = [symbol.name for symbol in parameters]
    for name in names:
        if [*names, t.name].count(name) > 1:
            raise ValueError(
                f"from_sympy: there are two symbols of the name {name}, with different "
                "assumptions: use a single one."
            )
    return Symbols(of, positions, velocities, parameters)


def substitute_symbols(name: str, given: Any, symbols: Symbols) -> Any:
    """Replace coordinates and rates by symbols; raise for other functions of time."""
    library, t = sympy(), mechanics().dynamicsymbols._t
    if given.atoms(library.Derivative) - set(symbols.of):
        # This evaluates, for instance, the derivative of a product of coordinates.
        given = given.doit()
    for derivative in sorted(
        given.atoms(library.Derivative) - set(symbols.of), key=str
    ):
        of = derivative.expr
        if of in symbols.of and set(derivative.variables) == {t}:
            raise ValueError(
                f"from_sympy: `{name}` contains {derivative}, but it may depend "
                "on coordinates, velocities and the time only, not on accelerations."
            )
        raise ValueError(
            f"from_sympy: `{name}` contains {derivative}, but {of} is not a coordinate."
        )
    functions = given.atoms(library.core.function.AppliedUndef)
    left = sorted(functions - set(symbols.of), key=str)
    if left:
        raise ValueError(
            f"from_sympy: `{name}` contains {left[0]}, which is not one of the "
            "coordinates. Make it a coordinate, a parameter (a Symbol), or an explicit "
            "function of time."
        )
    return given.xreplace(symbols.of)


class CompiledExpressions(NamedTuple):
    """Expressions as a function of the time, coordinates, rates and parameters."""

    compute: Callable[..., list[Any]]
    parameters: tuple[str, ...]
    is_scalar: bool

    def __call__(self, t: Any, variables: tuple[Any, ...], args: Args) -> Array:
        """Compute the expressions, as a scalar or as a vector."""
        values = parameter_values(self.parameters, args)
        dtype = variables[0].dtype
        found = [jnp.asarray(x, dtype) for x in self.compute(t, *variables, *values)]
        return found[0] if self.is_scalar else jnp.stack(found)


def compile_expressions(
    name: str, given: list[Any], symbols: Symbols, *, of_rates: bool, is_scalar: bool
) -> CompiledExpressions:
    """Compile expressions to one function with common subexpressions eliminated."""
    given = [substitute_symbols(name, x, symbols) for x in given]
    library = sympy()
    for number, words in (
        (library.I, "the imaginary unit"),
        (library.nan, "nan, which is not a number"),
        (library.oo, "infinity"),
        (-library.oo, "infinity"),
        (library.zoo, "infinity"),
    ):
        if any(x.has(number) for x in given):
            raise ValueError(f"from_sympy: `{name}` contains {words}.")
    compute = _lambdify(given, symbols, of_rates)
    if compute is None:
        part = _first_unsupported_part(given, symbols)
        raise ValueError(
            f"from_sympy: `{name}` contains {part}, which JAX or SymPy's printer "
            "for JAX does not support. Write it in terms of elementary functions."
        )
    names = tuple(symbol.name for symbol in symbols.parameters)
    return CompiledExpressions(compute, names, is_scalar)


def _lambdify(
    given: list[Any], symbols: Symbols, of_rates: bool
) -> Callable[..., list[Any]] | None:
    """Return a function that computes scalar expressions, or None if this fails."""
    t = mechanics().dynamicsymbols._t
    rates = symbols.rates if of_rates else []
    inputs = [t, *symbols.coordinates, *rates, *symbols.parameters]
    # If `given` is a part of an integral, the integration variable is a further input.
    inputs += sorted(set().union(*(x.free_symbols for x in given)) - {*inputs}, key=str)
    scalar = jax.ShapeDtypeStruct((), jnp.result_type(float))
    # Any exception, in the printer or in the code that it wrote, means that the model
    # contains an unsupported expression.
    try:
        compute = sympy().lambdify(
            inputs, given, modules="jax", printer=printer(), cse=True
        )
        shapes = jax.eval_shape(
            lambda *x: [jnp.asarray(value) for value in compute(*x)],
            *[scalar] * len(inputs),
        )
    except Exception:
        return None
    return compute if all(x.shape == () for x in shapes) else None


def _first_unsupported_part(given: list[Any], symbols: Symbols) -> str:
    """Describe the first, innermost part that `_lambdify` cannot compute."""
    back = {symbol: of for of, symbol in symbols.of.items()}
    for whole in given:
        for part in sympy().postorder_traversal(whole):
            if isinstance(part, sympy().Expr) and not _lambdify([part], symbols, True):
                return f"{part.xreplace(back)} ({type(part).__name__})"
    return "an expression"


def parameter_values(names: tuple[str, ...], args: Args) -> list[Any]:
    """Return the values of the parameters in `args`, in the order of `names`."""
    if args is None and not names:
        return []
    if not isinstance(args, dict) or not all(isinstance(name, str) for name in args):
        got = type(args).__name__
        if args is None or isinstance(args, dict):
            got = reprlib.repr(args)
        raise TypeError(
            "`args` must be a dictionary of the model's parameters by name, "
            f"as strings ({', '.join(names)}), such as `args=model.args`; got {got}."
        )
    missing = [name for name in names if name not in args]
    unknown = [str(name) for name in args if name not in names]
    if missing or unknown:
        wrong = [f"lacks the parameters {', '.join(missing)}"] if missing else []
        wrong += [f"has the unknown parameters {', '.join(unknown)}"] if unknown else []
        raise ValueError(
            f"`args` {' and '.join(wrong)}. The parameters of the model are "
            f"{', '.join(names)}."
        )
    values = []
    for name in names:
        value = float(args[name]) if isinstance(args[name], int) else args[name]
        if not eqx.is_array_like(value) or jnp.iscomplexobj(value):
            raise TypeError(f"`args[{name!r}]` must be a real number, got {value!r}.")
        if jnp.shape(value) != ():
            raise ShapeError(
                f"`args[{name!r}]` has shape {jnp.shape(value)}, but a parameter is a "
                "scalar; for several values use `jax.vmap`."
            )
        values.append(value)
    return values


def components(name: str, x: Any, names: tuple[str, ...]) -> tuple[Array, ...]:
    """Split a vector into its components, one for each coordinate."""
    if jnp.shape(x) != (len(names),):
        raise ShapeError(
            f"`{name}` has shape {jnp.shape(x)}, but the model has the coordinates "
            f"{', '.join(names)}: shape ({len(names)},) is needed."
        )
    return tuple(jax.lax.index_in_dim(x, i, keepdims=False) for i in range(len(names)))


def printer() -> Any:
    """Create SymPy's printer for JAX, modified to print all digits of floats.

    SymPy's own printer prints 15 digits, and integers that are too large for JAX; here
    these integers become floats.
    """
    base = importlib.import_module("sympy.printing.numpy").JaxPrinter

    class Printer(base):
        def _print_Float(self, expr):
            return repr(float(expr))

        def _print_Integer(self, expr):
            return str(expr.p) if abs(expr.p) < 2**31 else repr(float(expr.p))

    # `lambdify` gives its own printer the same settings.
    settings = {"fully_qualified_modules": False, "inline": True}
    return Printer(settings | {"allow_unknown_functions": True})


def _build_model(model: Description, parameters: Mapping[Any, Any]) -> SymPyModel:
    groups = {
        "lagrangian": [model.lagrangian],
        "nonholonomic": model.nonholonomic,
        "holonomic": model.holonomic,
        "forces": model.forces,
    }
    symbols = make_symbols(model.coordinates, [x for g in groups.values() for x in g])
    _check_constraints(model, symbols)

    names = tuple(str(q.func) for q in model.coordinates)

    def of_phase(name: str) -> Any:
        if not groups[name]:
            return None
        is_scalar = name == "lagrangian"
        return _of_phase(
            compile_expressions(
                name, groups[name], symbols, of_rates=True, is_scalar=is_scalar
            ),
            names,
        )

    holonomic = None
    if model.holonomic:
        function = compile_expressions(
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


def _of_phase(
    function: CompiledExpressions, names: tuple[str, ...]
) -> Callable[..., Array]:
    def of_phase(t, q, v, args):
        return function(
            t, (*components("q", q, names), *components("v", v, names)), args
        )

    return of_phase


def _of_position(
    function: CompiledExpressions, names: tuple[str, ...]
) -> Callable[..., Array]:
    def of_position(t, q, args):
        return function(t, components("q", q, names), args)

    return of_position


def _check_constraints(model: Description, symbols: Symbols) -> None:
    """Raise for a constraint without coordinates, or passed as the wrong argument."""
    positions, velocities = set(symbols.coordinates), set(symbols.rates)
    for name, group in (
        ("nonholonomic", model.nonholonomic),
        ("holonomic", model.holonomic),
    ):
        for number, constraint in enumerate(group):
            free = substitute_symbols(name, constraint, symbols).free_symbols
            where = f"from_sympy: `{name}[{number}]`, {constraint},"
            if not free & (positions | velocities):
                raise ValueError(f"{where} contains no coordinate.")
            if name == "holonomic" and free & velocities:
                raise ValueError(
                    f"{where} contains velocities: pass it as `nonholonomic`."
                )
            if name == "nonholonomic" and not free & velocities:
                raise ValueError(
                    f"{where} contains no velocity: pass it as `holonomic`."
                )


def _with_names(chosen: Any) -> Any:
    """Replace SymPy coordinates, alone or in a sequence, by their names."""
    if isinstance(chosen, (list, tuple, set, frozenset)):
        return [_name(x) for x in chosen]
    return _name(chosen)


def _name(x: Any) -> Any:
    """Return the name of a symbol or a coordinate q(t), and anything else unchanged."""
    return x if isinstance(x, str) else getattr(x, "name", x)


def _by_name(where: str, given: Mapping[Any, Any]) -> dict[str, Any]:
    """Replace the keys of a dictionary, symbols or coordinates q(t), by their names."""
    values = {}
    for key, value in given.items():
        name = str(_name(key))
        if name in values:
            raise ValueError(f"{where} has {name} twice.")
        values[name] = value
    return values


def parameter_defaults(
    parameters: Mapping[Any, Any], known: tuple[str, ...]
) -> dict[str, Array]:
    """Return the values of parameters by name, as arrays."""
    if not isinstance(parameters, Mapping):
        raise TypeError(
            "from_sympy: `parameters` must be a dictionary of values by symbol or "
            f"name, got {parameters!r}."
        )
    values = {}
    for name, value in _by_name("from_sympy: `parameters`", parameters).items():
        if name not in known:
            raise ValueError(
                f"from_sympy: `parameters` has {name}, but the symbols of the model "
                f"are {', '.join(known) or 'none'}."
            )
        if not eqx.is_array_like(value) or jnp.iscomplexobj(value):
            # The value may be, for instance, a number of SymPy.
            value = _number(name, value)
        value = float(value) if isinstance(value, numbers.Real) else value
        values[name] = jnp.asarray(value)
        if values[name].shape != ():
            raise ShapeError(
                f"from_sympy: `parameters[{name!r}]` has shape {values[name].shape}, "
                "but a parameter is a scalar; for several values use `jax.vmap` over "
                "`args`."
            )
        if not is_traced(value) and not math.isfinite(np.asarray(value)):
            raise ValueError(f"from_sympy: `parameters[{name!r}]` is {value}.")
    return values


def _number(name: str, value: Any) -> float:
    try:
        if isinstance(value, str):
            raise TypeError
        return float(value)
    except (TypeError, ValueError):
        raise TypeError(
            f"from_sympy: `parameters[{name!r}]` must be a real number, got {value!r}."
        ) from None
