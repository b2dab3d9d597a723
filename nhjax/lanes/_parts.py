"""The parts of a program that call Python, and the part that can be compiled.

A compiled operation cannot call Python, but `jax.debug.print` and the error checks of
other libraries do. `parts` divides the operations of a program, and `evaluate` computes
the operations outside of the compiled part one by one, as JAX would without
compilation.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.extend

from ._expansion import is_foreign
from ._jaxprs import variables
from ._kernel import partition_list


_CALLBACKS = ("debug_callback", "io_callback", "pure_callback")


class Parts(NamedTuple):
    """The operations before a compiled part, inside of it and after it."""

    before: list[Any]
    inside: list[Any]
    after: list[Any]


def parts(equations: list[Any]) -> Parts:
    """Divide a program so that no operation of the part `inside` calls Python.

    If the operands of a call of Python depend on no loop and on at most a quarter of
    the operations, the call is computed before the part `inside`. An example is a check
    of the program's operands. Other calls of Python, and the operations that depend on
    them, are computed after the part `inside`. Operations that two parts need are
    computed twice.
    """
    total = sum(map(_count, equations))
    maker = {x: index for index, e in enumerate(equations) for x in e.outvars}
    before, calls, late, has_effects = set(), set(), [], False
    results_of_late: set[Any] = set()
    for index, equation in enumerate(equations):
        operands = variables(equation.invars)
        is_late = not results_of_late.isdisjoint(operands)
        if python_calls(equation):
            calls.add(index)
            needed = _needed(index, equations, maker)
            size = sum(_count(equations[i]) for i in needed)
            has_loop = any(_has_loop(equations[i]) for i in needed)
            # Effects that follow a late effect are late too, to keep their order.
            is_late |= has_loop or 4 * size > total
            is_late |= has_effects and bool(equation.effects)
            has_effects |= is_late and bool(equation.effects)
            before |= set() if is_late else needed | {index}
        if is_late:
            results_of_late.update(equation.outvars)
        late.append(is_late)
    is_after = [
        x or y for x, y in zip(late, _across_members(equations, late), strict=True)
    ]
    return Parts(
        [e for index, e in enumerate(equations) if index in before],
        [e for index, e in enumerate(equations) if not (late[index] or index in calls)],
        partition_list(is_after, equations)[0],
    )


def _needed(index: int, equations: list[Any], maker: dict[Any, int]) -> set[int]:
    """Return the indices of all operations that an operation depends on."""
    found: set[int] = set()
    waiting = [index]
    while waiting:
        for x in variables(equations[waiting.pop()].invars):
            if x in maker and maker[x] not in found:
                found.add(maker[x])
                waiting.append(maker[x])
    return found


def _across_members(equations: list[Any], is_late: list[bool]) -> list[bool]:
    """Mark operations that must be repeated after the compiled part.

    Operations of other libraries may combine members under `jax.vmap`; for instance, an
    error check computes whether any member has failed. If the part after the compiled
    part needs results that depend on such operations, JAX computes these operations
    again, unless they contain loops.
    """
    wanted: set[Any] = set()
    serves = []
    for equation, mark in zip(reversed(equations), reversed(is_late), strict=True):
        is_used = not wanted.isdisjoint(equation.outvars)
        serves.append(is_used and not (mark or _has_loop(equation)))
        if mark or serves[-1]:
            wanted.update(variables(equation.invars))
    marks, combined = [], set()
    for equation, mark in zip(equations, reversed(serves), strict=True):
        depends = not combined.isdisjoint(variables(equation.invars))
        marks.append(mark and (is_foreign(equation.primitive) or depends))
        if marks[-1]:
            combined.update(equation.outvars)
    return marks


def inlined(program: Any, *leaves: Any) -> list[Any]:
    """Compute a program; functions under `jax.jit` that call Python are inlined."""
    values = start(program, leaves)
    for equation in program.jaxpr.eqns:
        if equation.primitive.name in ("jit", "pjit") and python_calls(equation):
            operands = [read(x, values) for x in equation.invars]
            out = inlined(equation.params["jaxpr"], *operands)
            values.update(zip(equation.outvars, out, strict=True))
        else:
            evaluate([equation], values)
    return [read(x, values) for x in program.jaxpr.outvars]


def start(program: Any, leaves: Iterable[Any]) -> dict[Any, Any]:
    """Map the variables of a closed jaxpr's constants and operands to their values."""
    names = [*program.jaxpr.constvars, *program.jaxpr.invars]
    return dict(zip(names, [*program.consts, *leaves], strict=True))


def evaluate(equations: list[Any], values: dict[Any, Any]) -> None:
    """Compute operations, and add their results to the values of variables."""
    for equation in equations:
        primitive = equation.primitive
        operands = [read(x, values) for x in equation.invars]
        bound = primitive.get_bind_params(equation.params)
        # Earlier releases of JAX return functions separately from the other
        # parameters.
        functions, params = bound if isinstance(bound, tuple) else ((), bound)
        out = primitive.bind(*functions, *operands, **params)
        out = out if primitive.multiple_results else [out]
        values.update(zip(equation.outvars, out, strict=True))


def read(x: Any, values: dict[Any, Any]) -> Any:
    """Return the value of an operand."""
    return x.val if isinstance(x, jax.extend.core.Literal) else values[x]


def _count(equation: Any) -> int:
    return 1 + sum(map(_count, _inner_equations(equation)))


def python_calls(equation: Any) -> set[str]:
    """Return the names of callbacks, and of operations with effects, in an equation."""
    name = equation.primitive.name
    if name in _CALLBACKS:
        return {name}
    inner = set().union(*map(python_calls, _inner_equations(equation)))
    return inner or ({name} if equation.effects else set())


def _has_loop(equation: Any) -> bool:
    is_loop = equation.primitive.name in ("scan", "while")
    return is_loop or any(map(_has_loop, _inner_equations(equation)))


def _inner_equations(equation: Any) -> list[Any]:
    found = []
    for value in jax.tree.leaves(list(equation.params.values())):
        found += getattr(getattr(value, "jaxpr", value), "eqns", ())
    return found
