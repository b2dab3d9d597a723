"""Models that other libraries describe, as systems: those of SymPy."""

from ._from_sympy import from_sympy as from_sympy, SymPyModel as SymPyModel
