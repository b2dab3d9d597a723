"""Evaluation of JAX functions in 50 digits, by an interpreter of their jaxprs.

Arrays of floating-point numbers become arrays of mpmath numbers. If an operation only
moves numbers, such as a transposition, JAX applies it to their indices.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
import mpmath
import numpy as np
from jax import Array

from nhjax.lanes._builder import called_program, CALLS


DIGITS = 50

_MP = mpmath.mp.clone()
_MP.dps = DIGITS


def _each(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that applies `function` to each entry of arrays."""
    on_arrays = np.frompyfunc(function, function.__code__.co_argcount, 1)
    return lambda *arrays: np.asarray(on_arrays(*arrays), object)


_ONE = {
    "neg": lambda x: -x,
    "sin": lambda x: _MP.sin(x),
    "cos": lambda x: _MP.cos(x),
    "tan": lambda x: _MP.tan(x),
    "tanh": lambda x: _MP.tanh(x),
    "sinh": lambda x: _MP.sinh(x),
    "cosh": lambda x: _MP.cosh(x),
    "asin": lambda x: _MP.asin(x),
    "acos": lambda x: _MP.acos(x),
    "atan": lambda x: _MP.atan(x),
    "exp": lambda x: _MP.exp(x),
    "expm1": lambda x: _MP.expm1(x),
    "log": lambda x: _MP.log(x),
    "log1p": lambda x: _MP.log1p(x),
    "sqrt": lambda x: _MP.sqrt(x),
    "rsqrt": lambda x: 1 / _MP.sqrt(x),
    "log2": lambda x: _MP.log(x) / _MP.log(2),
    "square": lambda x: x * x,
    "one_minus_square": lambda x: (1 + x) * (1 - x),
    "abs": lambda x: abs(x),
    "sign": lambda x: _MP.sign(x),
    "round": lambda x: _MP.nint(x),
    "floor": lambda x: _MP.floor(x),
}
_TWO = {
    "add": lambda x, y: x + y,
    "add_any": lambda x, y: x + y,
    "sub": lambda x, y: x - y,
    "mul": lambda x, y: x * y,
    "div": lambda x, y: x / y,
    "max": lambda x, y: max(x, y),
    "min": lambda x, y: min(x, y),
    "pow": lambda x, y: _MP.power(x, y),
    "atan2": lambda x, y: _MP.atan2(x, y),
}
_COMPARED = {
    "lt": lambda x, y: x < y,
    "le": lambda x, y: x <= y,
    "gt": lambda x, y: x > y,
    "ge": lambda x, y: x >= y,
    "eq": lambda x, y: x == y,
    "ne": lambda x, y: x != y,
    "is_finite": lambda x: _MP.isfinite(x),
}
_MOVES = {
    "broadcast_in_dim",
    "concatenate",
    "convert_element_type",
    "copy",
    "dynamic_slice",
    "dynamic_update_slice",
    "expand_dims",
    "gather",
    "optimization_barrier",
    "pad",
    "reshape",
    "rev",
    "scatter",
    "select_n",
    "slice",
    "split",
    "squeeze",
    "stack",
    "transpose",
    "unstack",
}


def evaluate(function: Callable[..., Any], *arguments: Any) -> Any:
    """Evaluate a function of JAX at float64 arguments, in `DIGITS` digits.

    The result is a tree of NumPy arrays. Floating-point numbers in it are mpmath
    numbers.
    """
    program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    leaves = [_exact(np.asarray(x)) for x in jax.tree.leaves(arguments)]
    results = _run(program.jaxpr, program.consts, leaves)
    return jax.tree.unflatten(jax.tree.structure(shape), results)


def to_float(array: np.ndarray) -> np.ndarray:
    """Round an array of mpmath numbers to float64."""
    return np.asarray(array, float)


def _exact(x: np.ndarray) -> np.ndarray:
    if not np.issubdtype(x.dtype, np.floating):
        return x
    return np.asarray(np.frompyfunc(_MP.mpf, 1, 1)(x), object)


def _is_float(variable: Any) -> bool:
    return np.issubdtype(variable.aval.dtype, np.floating)


def _run(jaxpr: Any, consts: list, arguments: list) -> list:
    known = {
        variable: _exact(np.asarray(x))
        for variable, x in zip(jaxpr.constvars, consts, strict=True)
    }
    known |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(variable: Any) -> np.ndarray:
        if isinstance(variable, jax.extend.core.Literal):
            return _exact(np.asarray(variable.val))
        return known[variable]

    for equation in jaxpr.eqns:
        found = _results(equation, [read(x) for x in equation.invars])
        known |= dict(zip(equation.outvars, found, strict=True))
    return [read(x) for x in jaxpr.outvars]


def _results(equation: Any, x: list) -> list:
    name, params = equation.primitive.name, equation.params
    if name in CALLS:
        return _called(equation, x)
    if name == "batched_call":
        return _for_each_member(equation, x)
    if not any(_is_float(v) for v in equation.invars):
        found = _by_jax(equation, x)
        return [
            _exact(y) if _is_float(v) else y
            for v, y in zip(equation.outvars, found, strict=True)
        ]
    if name in _ONE or name in _TWO:
        return [_each((_ONE | _TWO)[name])(*x)]
    if name in _COMPARED:
        return [np.asarray(_each(_COMPARED[name])(*x), bool)]
    if name == "integer_pow":
        return [_each(lambda y: y ** params["y"])(x[0])]
    if name == "dot_general":
        return [_dot_general(x[0], x[1], params["dimension_numbers"])]
    if name == "small_product":
        subscripts = "{first},{second}->{result}".format(**params)
        return [_array(np.einsum(subscripts, *x))]
    if name == "reduce_sum":
        total = x[0].sum(axis=tuple(params["axes"]))
        return [_array(total)]
    if name in ("reduce_max", "reduce_min"):
        reduce = np.maximum if name == "reduce_max" else np.minimum
        total = x[0]
        for axis in sorted(params["axes"], reverse=True):
            total = reduce.reduce(total, axis=axis)
        return [_array(total)]
    if name == "scatter-add":
        return [_scatter_add(equation, *x)]
    if name == "convert_element_type" and not _is_float(equation.outvars[0]):
        return _by_jax(equation, [to_float(x[0])])
    return _moved(equation, x)


def _called(equation: Any, x: list) -> list:
    inner = called_program(equation)
    return _run(getattr(inner, "jaxpr", inner), getattr(inner, "consts", []), x)


def _for_each_member(equation: Any, x: list) -> list:
    marks = equation.params["is_batched"]
    members = x[marks.index(True)].shape[0]
    rows = [
        _called(
            equation, [y[k] if mark else y for y, mark in zip(x, marks, strict=True)]
        )
        for k in range(members)
    ]
    return [np.stack(column) for column in zip(*rows, strict=True)]


def _array(x: Any) -> np.ndarray:
    return np.asarray(x, object)


def _by_jax(equation: Any, x: list) -> list:
    found = equation.primitive.bind(*map(jnp.asarray, x), **equation.params)
    if not equation.primitive.multiple_results:
        found = [found]
    return [np.asarray(y) for y in found]


def _moved(equation: Any, x: list) -> list:
    """Apply a primitive that only moves numbers.

    JAX applies it to the places of the numbers in one list of all operands.
    """
    pool, places = [], []
    for variable, y in zip(equation.invars, x, strict=True):
        if _is_float(variable):
            count = math.prod(y.shape)
            place = np.arange(len(pool), len(pool) + count, dtype=variable.aval.dtype)
            pool += list(y.reshape(-1))
            places.append(place.reshape(y.shape))
        else:
            places.append(y)
    numbers = np.empty(len(pool), object)
    numbers[:] = pool
    name = equation.primitive.name
    if name not in _MOVES:
        raise NotImplementedError(f"{name} in {DIGITS} digits")
    found = _by_jax(equation, places)
    return [
        _array(numbers[y.astype(int)]) if _is_float(variable) else y
        for variable, y in zip(equation.outvars, found, strict=True)
    ]


def _scatter_add(equation: Any, x: np.ndarray, places: np.ndarray, more: np.ndarray):
    """Add updates to an array, by a matrix of zeros and ones that maps their places."""

    def added(more: Array) -> Array:
        zero = jnp.zeros(x.shape)
        return equation.primitive.bind(
            zero, jnp.asarray(places), more, **equation.params
        )

    matrix = np.asarray(jax.jacfwd(added)(jnp.zeros(more.shape)))
    matrix = matrix.reshape(x.size, more.size).astype(int)
    return x + _array(matrix.astype(object) @ more.reshape(-1)).reshape(x.shape)


def _dot_general(a: np.ndarray, b: np.ndarray, numbers: Any) -> np.ndarray:
    (of_a, of_b), (batch_a, batch_b) = numbers
    a = np.moveaxis(a, batch_a, range(len(batch_a)))
    b = np.moveaxis(b, batch_b, range(len(batch_b)))

    def moved(axis: int, batch: tuple[int, ...]) -> int:
        """Find the index of an axis after the batch axes have moved to the front."""
        return len(batch) + axis - sum(other < axis for other in batch)

    k = len(batch_a)
    axes_a = [moved(i, batch_a) - k for i in of_a]
    axes_b = [moved(i, batch_b) - k for i in of_b]
    shape = a.shape[:k]
    pairs = [
        _array(np.tensordot(a[index], b[index], axes=(axes_a, axes_b)))
        for index in np.ndindex(shape)
    ]
    return np.stack(pairs).reshape((*shape, *pairs[0].shape))
