"""The import of SymPy, an optional dependency, where it is first needed."""

import importlib
from typing import Any


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


def printer() -> Any:
    """Make SymPy's printer for JAX, with all digits of floating-point numbers.

    SymPy itself prints 15 digits, and integers that JAX has no type for.
    """
    base = importlib.import_module("sympy.printing.numpy").JaxPrinter

    class Printer(base):
        def _print_Float(self, expr):
            return repr(float(expr))

        def _print_Integer(self, expr):
            return str(expr.p) if abs(expr.p) < 2**31 else repr(float(expr.p))

    # As `lambdify` makes it.
    settings = {"fully_qualified_modules": False, "inline": True}
    return Printer(settings | {"allow_unknown_functions": True})
