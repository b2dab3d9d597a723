"""Mechanical systems imported from models of other libraries, so far of SymPy."""

from ._from_sympy import from_sympy as from_sympy, SymPyModel as SymPyModel
