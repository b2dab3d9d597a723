"""Programs without operations that nothing uses, or that repeat an earlier one.

Derivatives compute the function on the way, and so do those of the next order, so that
much of a traced program is in it several times. What transforms and compiles programs
would work at each copy.
"""

from collections.abc import Hashable, Mapping
from typing import Any

import jax
import jax.extend
import numpy as np

from ._elementary import ARITHMETIC_AND_SHAPES, SMALL_PRODUCT


# Only these are left out where they are repeated: they have no state, as random numbers
# may have, and no parameters that a user chooses.
_REPEATABLE = frozenset(
    (*ARITHMETIC_AND_SHAPES, "dot_general", "gather", SMALL_PRODUCT)
)
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
    return _Shortening()(program)


class _Shortening:
    """Shortens programs, those that stand at several places once."""

    def __init__(self):
        # A program is kept beside what it has become, so that its identity is its own.
        self._known: dict[int, tuple[Any, Any]] = {}

    def __call__(self, program: Any) -> Any:
        if id(program) not in self._known:
            short = (
                program.replace(jaxpr=self._open(program.jaxpr))
                if hasattr(program, "jaxpr")
                else self._open(program)
            )
            self._known[id(program)] = program, short
        return self._known[id(program)][1]

    def _open(self, jaxpr: Any) -> Any:
        first: dict[Any, Any] = {}
        made: dict[Hashable, list[Any]] = {}
        equations = []

        def same(variable: Any) -> Any:
            if isinstance(variable, jax.extend.core.Literal):
                return variable
            return first.get(variable, variable)

        for equation in _used(jaxpr):
            operands = [same(variable) for variable in equation.invars]
            if _is_repeatable(equation):
                key = _key(equation, operands)
                if key in made:
                    first.update(zip(equation.outvars, made[key], strict=True))
                    continue
                made[key] = equation.outvars
            params = self._params(equation)
            equations.append(equation.replace(invars=operands, params=params))
        return jaxpr.replace(eqns=equations, outvars=[same(v) for v in jaxpr.outvars])

    def _params(self, equation: Any) -> dict[str, Any]:
        """Return the parameters of an operation, with its inner programs shortened."""
        names = _INNER.get(equation.primitive.name, ())
        inner = {name: jax.tree.map(self, equation.params[name]) for name in names}
        return {**equation.params, **inner}


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


def _is_repeatable(equation: Any) -> bool:
    # A result without a name cannot be used by another operation.
    return equation.primitive.name in _REPEATABLE and not any(
        isinstance(variable, jax.extend.core.DropVar) for variable in equation.outvars
    )


def _key(equation: Any, operands: list[Any]) -> Hashable:
    """Make a key that two operations share only if they compute the same."""
    params = tuple((name, _exact(equation.params[name])) for name in equation.params)
    # The context holds settings of JAX, such as where an operation is computed.
    context = _exact(getattr(equation, "ctx", None))
    return equation.primitive, tuple(map(_operand, operands)), params, context


def _operand(variable: Any) -> Hashable:
    if not isinstance(variable, jax.extend.core.Literal):
        return variable
    return _exact(np.asarray(variable.val)[()]), str(variable.aval)


def _exact(value: Any) -> Hashable:
    """Make a key of a parameter; what cannot be hashed is equal to itself alone.

    Numbers that are equal but differ, as 0.0 and -0.0 or 1 and True, have other keys.
    """
    if isinstance(value, tuple | list):
        return type(value), *map(_exact, value)
    if isinstance(value, Mapping):
        return type(value), *((name, _exact(value[name])) for name in value)
    if isinstance(value, np.generic):
        return type(value), value.dtype.str, value.tobytes()
    if isinstance(value, float | complex):
        return type(value), repr(value)
    try:
        hash(value)
    except TypeError:
        return type(value), id(value)
    return type(value), value
