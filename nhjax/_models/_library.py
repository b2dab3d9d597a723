"""The import of SymPy, an optional dependency, where it is first needed."""

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
