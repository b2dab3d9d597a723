"""Mechanical systems imported from other libraries; so far, only from SymPy."""

from ._from_sympy import from_sympy as from_sympy, SymPyModel as SymPyModel
