"""Expressions of SymPy as functions of JAX, by SymPy's own printer."""

import reprlib
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import Args
from .._errors import ShapeError
from ._library import mechanics, printer, sympy


class Symbols(NamedTuple):
    """The symbols that stand for what expressions depend on.

    - `of`: what is replaced by them, the coordinates and their rates.
    - `coordinates`, `rates`: the symbols in their places.
    - `parameters`: the symbols that are left.
    """

    of: dict[Any, Any]
    coordinates: list[Any]
    rates: list[Any]
    parameters: list[Any]


def place_symbols(coordinates: list[Any], all_expressions: list[Any]) -> Symbols:
    """Make the symbols of a model, and find its parameters."""
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
                "assumptions: use one of them."
            )
    return Symbols(of, positions, velocities, parameters)


def with_symbols(name: str, given: Any, symbols: Symbols) -> Any:
    """Put symbols in the places of coordinates and rates; refuse what is left over."""
    library, t = sympy(), mechanics().dynamicsymbols._t
    if given.atoms(library.Derivative) - set(symbols.of):
        # Such as the derivative of a product of coordinates.
        given = given.doit()
    for derivative in sorted(
        given.atoms(library.Derivative) - set(symbols.of), key=str
    ):
        of = derivative.expr
        if of in symbols.of and set(derivative.variables) == {t}:
            raise ValueError(
                f"from_sympy: `{name}` contains {derivative}; it may depend on "
                "coordinates, velocities and the time, not on accelerations."
            )
        raise ValueError(
            f"from_sympy: `{name}` contains {derivative}, the derivative of what is no "
            "coordinate."
        )
    functions = given.atoms(library.core.function.AppliedUndef)
    left = sorted(functions - set(symbols.of), key=str)
    if left:
        raise ValueError(
            f"from_sympy: `{name}` contains {left[0]}, which is not among the "
            "coordinates. Make it a coordinate, a parameter (a Symbol), or an explicit "
            "function of time."
        )
    return given.xreplace(symbols.of)


class Printed(NamedTuple):
    """Expressions as a function of the time, coordinates, rates and parameters."""

    compute: Callable[..., list[Any]]
    parameters: tuple[str, ...]
    is_scalar: bool

    def __call__(self, t: Any, variables: tuple[Any, ...], args: Args) -> Array:
        """Compute the expressions, as a scalar or stacked."""
        values = parameter_values(self.parameters, args)
        dtype = variables[0].dtype
        found = [jnp.asarray(x, dtype) for x in self.compute(t, *variables, *values)]
        return found[0] if self.is_scalar else jnp.stack(found)


def printed(
    name: str, given: list[Any], symbols: Symbols, *, of_rates: bool, is_scalar: bool
) -> Printed:
    """Print expressions as one function, with what they share computed once."""
    given = [with_symbols(name, x, symbols) for x in given]
    library = sympy()
    for number, words in (
        (library.I, "the imaginary unit"),
        (library.nan, "nan, which is no number"),
        (library.oo, "infinity"),
        (-library.oo, "infinity"),
        (library.zoo, "infinity"),
    ):
        if any(x.has(number) for x in given):
            raise ValueError(f"from_sympy: `{name}` contains {words}.")
    compute = _computed(given, symbols, of_rates)
    if compute is None:
        raise ValueError(
            f"from_sympy: `{name}` contains {_culprit(given, symbols)}, which SymPy's "
            "printer for JAX cannot write, or JAX not compute. Write it in terms of "
            "elementary functions."
        )
    names = tuple(symbol.name for symbol in symbols.parameters)
    return Printed(compute, names, is_scalar)


def _computed(
    given: list[Any], symbols: Symbols, of_rates: bool
) -> Callable[..., list[Any]] | None:
    """Make a function of the expressions, or None if JAX cannot trace it."""
    t = mechanics().dynamicsymbols._t
    rates = symbols.rates if of_rates else []
    inputs = [t, *symbols.coordinates, *rates, *symbols.parameters]
    # Parts of an integral have symbols that the whole has not.
    inputs += sorted(set().union(*(x.free_symbols for x in given)) - {*inputs}, key=str)
    scalar = jax.ShapeDtypeStruct((), jnp.result_type(float))
    # Whatever goes wrong, in printing or in what was printed, the model is to blame.
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


def _culprit(given: list[Any], symbols: Symbols) -> str:
    """Name the smallest part that cannot be computed."""
    back = {symbol: of for of, symbol in symbols.of.items()}
    for expression in given:
        for part in sympy().postorder_traversal(expression):
            if isinstance(part, sympy().Expr) and not _computed([part], symbols, True):
                return f"{part.xreplace(back)} ({type(part).__name__})"
    return "an expression"


def parameter_values(names: tuple[str, ...], args: Args) -> list[Any]:
    """Take the values of the parameters from `args`, in the order of their names."""
    if args is None and not names:
        return []
    if not isinstance(args, dict) or not all(isinstance(name, str) for name in args):
        got = type(args).__name__
        if args is None or isinstance(args, dict):
            got = reprlib.repr(args)
        raise TypeError(
            "`args` must be a dictionary with the parameters of the model by name, "
            f"as strings, {', '.join(names)}, such as `args=model.args`; got "
            f"{got}."
        )
    missing = [name for name in names if name not in args]
    unknown = [str(name) for name in args if name not in names]
    if missing or unknown:
        wrong = [f"lacks {', '.join(missing)}"] if missing else []
        wrong += [f"has {', '.join(unknown)}, which is none"] if unknown else []
        raise ValueError(
            f"`args` {' and '.join(wrong)} of the parameters of the model. They are: "
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


def parts(name: str, x: Any, names: tuple[str, ...]) -> tuple[Array, ...]:
    """Take a vector apart that has one component for each of the coordinates."""
    if jnp.shape(x) != (len(names),):
        raise ShapeError(
            f"`{name}` has shape {jnp.shape(x)}, but the model has the coordinates "
            f"{', '.join(names)}: shape ({len(names)},) is needed."
        )
    return tuple(jax.lax.index_in_dim(x, i, keepdims=False) for i in range(len(names)))
