"""Which arrays of a loop are stored into at an index, and so belong into memory."""

from collections.abc import Iterator
from typing import Any

from jax.extend.core import Literal


_UPDATES = ("dynamic_update_slice", "scatter")
_SAME = ("reshape", "squeeze", "expand_dims", "copy", "copy_p", "optimization_barrier")


def updated(jaxpr: Any) -> frozenset[int]:
    """List the inputs of a jaxpr that it, or a program in it, updates at an index.

    An update at a place that is a number in the jaxpr does not count.
    """
    origins: dict[Any, int] = {v: i for i, v in enumerate(jaxpr.invars)}
    found: set[int] = set()
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        ins = [None if isinstance(v, Literal) else v for v in equation.invars]
        if name.startswith(_UPDATES):
            origin = origins.get(ins[0])
            is_slice = name == "dynamic_update_slice"
            places = equation.invars[2:] if is_slice else equation.invars[1:2]
            if origin is not None:
                if any(not isinstance(v, Literal) for v in places):
                    found.add(origin)
                origins[equation.outvars[0]] = origin
        elif name in _SAME:
            for before, after in zip(ins, equation.outvars, strict=True):
                if before in origins:
                    origins[after] = origins[before]
        for inner, first in inner_programs(equation):
            for index in updated(inner):
                variable = ins[first + index]
                if variable in origins:
                    found.add(origins[variable])
    return frozenset(found)


def inner_programs(equation: Any) -> Iterator[tuple[Any, int]]:
    """List the programs in an equation, and where their operands start among its own.

    Constants of loops are not overwritten, but it does no harm to list them.
    """
    params, name = equation.params, equation.primitive.name
    if name == "while":
        # The operands of the body without those of the predicate.
        yield params["body_jaxpr"].jaxpr, params["cond_nconsts"]
    elif name == "cond":
        for branch in params["branches"]:
            yield branch.jaxpr, 1
    else:
        for key in ("jaxpr", "call_jaxpr", "program", "fun_jaxpr"):
            if key in params:
                yield getattr(params[key], "jaxpr", params[key]), 0
                return
