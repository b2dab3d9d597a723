"""Jacobians, which are computed as diagonals where the function's program allows it."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.extend
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._compile import CALLING, ELEMENTWISE
from ._contraction import Matrix


class _Aligned(NamedTuple):
    """The dependence of a vector whose element i depends on u_{i + offset} alone.

    A number counts as the element i = 0.
    """

    offset: int


class _Unknown(NamedTuple):
    """The dependence of a value that may depend on all elements of u."""


# The dependence of a value on u; None if it does not depend on u at all.
_Dependence: TypeAlias = _Aligned | _Unknown | None


def jacobian(function: Callable[[Array], Array], u: Float[Array, " n"]) -> Matrix:
    """Compute ∂f_i/∂u_j, or its diagonal alone if each f_i depends on u_i alone.

    The mass matrices of most Lagrangians that one writes down are diagonal; their
    products with vectors then cost n instead of n² operations. Whether the Jacobian is
    diagonal is decided when the function is traced, from the operations of its
    derivative and not from values. A function whose operations are not understood
    counts as dense.
    """

    def push(u, du):
        return jax.jvp(function, (u,), (du,))[1]

    ones = jnp.ones_like(u)
    program = jax.make_jaxpr(push)(u, ones)
    if program.out_avals[0].shape == u.shape and not program.effects:
        (found,) = _followed(program.jaxpr, [_Aligned(0), _Aligned(0)])
        if found is None or found == _Aligned(0):
            return jax.extend.core.jaxpr_as_fun(program)(u, ones)[0]
    return jax.vmap(push, in_axes=(None, 0), out_axes=1)(
        u, jnp.eye(u.shape[0], dtype=u.dtype)
    )


def _followed(program: Any, inputs: Sequence[_Dependence]) -> list[_Dependence]:
    """Find the dependences of a program's results, given those of its inputs."""
    known = dict.fromkeys(program.constvars)
    known |= zip(program.invars, inputs, strict=True)

    def read(variable):
        is_literal = isinstance(variable, jax.extend.core.Literal)
        return None if is_literal else known[variable]

    for equation in program.eqns:
        found = _dependences(equation, [read(x) for x in equation.invars])
        known |= zip(equation.outvars, found, strict=True)
    return [read(variable) for variable in program.outvars]


def _dependences(equation: Any, inputs: list[_Dependence]) -> list[_Dependence]:
    outputs = equation.outvars
    if equation.effects:
        return [_Unknown()] * len(outputs)
    if all(x is None for x in inputs):
        return [None] * len(outputs)
    name, params = equation.primitive.name, equation.params
    if name in CALLING:
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        return _followed(getattr(inner, "jaxpr", inner), inputs)
    if name == "split" and isinstance(inputs[0], _Aligned):
        starts = itertools.accumulate(params["sizes"][:-1], initial=0)
        return [_Aligned(inputs[0].offset + start) for start in starts]
    return [_dependence(name, equation, inputs)] * len(outputs)


def _dependence(name: str, equation: Any, inputs: list[_Dependence]) -> _Dependence:
    """Find the dependence of an operation's result, if some input depends on u."""
    params, shape = equation.params, equation.outvars[0].aval.shape
    shapes = [x.aval.shape for x in equation.invars]
    moving = [k for k, x in enumerate(inputs) if x is not None]
    found = {inputs[k] for k in moving}
    if _Unknown() in found or len(shape) > 1:
        return _Unknown()
    if not shape and name in ("slice", "pad"):
        return _Unknown()
    (first, *others) = (x for x in inputs if isinstance(x, _Aligned))
    is_same = not any(x != first for x in others)
    keeps_length = all(math.prod(shapes[k]) == math.prod(shape) for k in moving)
    if name in ELEMENTWISE or _is_scaling(name, params, shapes):
        return first if is_same and keeps_length else _Unknown()
    if name in ("reshape", "squeeze", "broadcast_in_dim", "transpose", "copy"):
        return first if keeps_length else _Unknown()
    if name == "slice" and (params["strides"] or (1,)) == (1,):
        return _Aligned(first.offset + params["start_indices"][0])
    if name == "pad" and moving == [0]:
        ((low, _, inner),) = params["padding_config"]
        return _Unknown() if inner else _Aligned(first.offset - low)
    if name == "concatenate":
        starts = itertools.accumulate((x[0] for x in shapes[:-1]), initial=0)
        offsets = {
            x.offset - start
            for x, start in zip(inputs, starts, strict=True)
            if isinstance(x, _Aligned)
        }
        return _Aligned(offsets.pop()) if len(offsets) == 1 else _Unknown()
    return _Unknown()


def _is_scaling(name: str, params: dict[str, Any], shapes: list[Any]) -> bool:
    """Tell if it is a product or sum over no index, as derivatives of v·v contain."""
    if name == "reduce_sum":
        return params["axes"] == ()
    if name != "dot_general":
        return False
    summed, _ = params["dimension_numbers"]
    return summed == ((), ()) and () in shapes
