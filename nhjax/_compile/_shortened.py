"""Programs without operations that nothing uses, or that repeat an earlier one.

Derivatives compute the function on the way, and so do those of the next order, so that
much of a traced program is in it several times. What transforms and compiles programs
would work at each copy.
"""

from collections.abc import Hashable
from typing import Any

import jax
import jax.extend
import numpy as np


# Operations whose programs are those of the parameters listed here. Other operations
# with programs have rules that rely on them, and stay as they are.
_INNER = {
    "checkpoint": ("jaxpr",),
    "cond": ("branches",),
    "custom_jvp_call": ("call_jaxpr",),
    "custom_linear_solve": ("jaxprs",),
    "jit": ("jaxpr",),
    "remat2": ("jaxpr",),
    "scan": ("jaxpr",),
    "while": ("body_jaxpr", "cond_jaxpr"),
}


def shortened(program: Any) -> Any:
    """Leave out what is not used or repeated, in a jaxpr and in its loops.

    The results are the same to the last bit, since what stays is not changed.
    """
    if not hasattr(program, "jaxpr"):
        return _shortened(program)
    return program.replace(jaxpr=_shortened(program.jaxpr))


def _shortened(jaxpr: Any) -> Any:
    first: dict[Any, Any] = {}
    made: dict[Hashable, list[Any]] = {}
    equations = []

    def same(variable: Any) -> Any:
        if isinstance(variable, jax.extend.core.Literal):
            return variable
        return first.get(variable, variable)

    for equation in _used(jaxpr):
        key = None
        if not equation.effects:
            operands = tuple(_operand(same(v)) for v in equation.invars)
            key = (equation.primitive, operands, _hashable(equation.params))
            if key in made:
                first.update(zip(equation.outvars, made[key], strict=True))
                continue
            made[key] = equation.outvars
        equations.append(
            equation.replace(
                invars=[same(v) for v in equation.invars],
                params=_with_short_programs(equation),
            )
        )
    return jaxpr.replace(eqns=equations, outvars=[same(v) for v in jaxpr.outvars])


def _used(jaxpr: Any) -> list[Any]:
    """List the operations whose results are used, or that have effects."""
    used, found = set(_variables(jaxpr.outvars)), []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or not used.isdisjoint(equation.outvars):
            used.update(_variables(equation.invars))
            found.append(equation)
    return found[::-1]


def _variables(operands: Any) -> list[Any]:
    return [v for v in operands if not isinstance(v, jax.extend.core.Literal)]


def _operand(variable: Any) -> Hashable:
    if not isinstance(variable, jax.extend.core.Literal):
        return variable
    value = np.asarray(variable.val)
    return value.tobytes(), str(value.dtype), str(variable.aval)


def _hashable(params: dict[str, Any]) -> Hashable:
    """Make a key of parameters; what cannot be hashed is equal to itself alone."""
    out = []
    for name in sorted(params):
        value = params[name]
        try:
            hash(value)
        except TypeError:
            value = (type(value), id(value))
        out.append((name, type(value), value))
    return tuple(out)


def _with_short_programs(equation: Any) -> dict[str, Any]:
    """Return the parameters of an operation, with its inner programs shortened."""
    params = dict(equation.params)
    for name in _INNER.get(equation.primitive.name, ()):
        params[name] = jax.tree.map(shortened, params[name])
    return params
