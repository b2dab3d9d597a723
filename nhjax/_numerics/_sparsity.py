"""The sparsity pattern of a Jacobian, found from the program of the function.

Each element of an intermediate array has the set of inputs that it depends on. These
sets are propagated through the operations of the program, from the inputs to the
results.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend
import numpy as np
from jaxtyping import Array, Bool, Float

from ..lanes import CALLING, ELEMENTWISE, SMALL_PRODUCT


# These operations rearrange the elements of their operands. NumPy rearranges the sets
# of inputs in the same way. For a gather, the values of its indices must be known.
_REARRANGING = """
    broadcast_in_dim concatenate copy copy_p expand_dims gather pad reshape rev slice
    split squeeze transpose
""".split()  # noqa: SIM905
# Integers and booleans may be indices. Their values are computed if the array has at
# most this many elements.
_LONGEST_INDEX = 10_000


def jacobian_sparsity(
    function: Callable[[Array], Array], u: Float[Array, " n"]
) -> Bool[np.ndarray, "l n"]:
    """Return which entries ∂f_a/∂u_i of a Jacobian may differ from zero at some u.

    Sets of inputs are propagated through the program that computes the derivative in a
    direction du at u; the inputs are the entries of du. False therefore marks an entry
    that is zero for all u. If an operation is a loop, a branch or unknown, each of its
    results counts as dependent on all its inputs.
    """

    def push(du):
        return jax.jvp(function, (u,), (du,))[1]

    program, n = jax.make_jaxpr(push)(u), u.shape[0]
    if program.effects:
        return np.ones((jax.eval_shape(push, u).size, n), bool)
    consts = [_known(const) for const in program.consts]
    with jax.ensure_compile_time_eval():
        inputs = [(np.eye(n, dtype=bool), None)]
        ((found, _),) = _followed(program.jaxpr, consts, inputs, n)
    return found.reshape(-1, n)


# For an array: the sets of inputs of its elements, as booleans of shape (..., n), and
# the value of the array, or None if the value is not known.
_Value = tuple[np.ndarray, np.ndarray | None]


def _known(x: Any) -> np.ndarray | None:
    """Return the value of a constant if indices may depend on it, otherwise None."""
    if isinstance(x, jax.core.Tracer) or np.size(x) > _LONGEST_INDEX:
        return None
    return np.asarray(x) if _may_be_index(np.asarray(x).dtype) else None


def _may_be_index(dtype: Any) -> bool:
    return np.issubdtype(dtype, np.integer) or np.issubdtype(dtype, np.bool_)


def _followed(
    program: Any, consts: Sequence[Any], inputs: Sequence[_Value], n: int
) -> list[_Value]:
    """Return the sets of a program's results from the sets of its inputs."""
    values = dict(zip(program.invars, inputs, strict=True))
    for variable, const in zip(program.constvars, consts, strict=True):
        values[variable] = (np.zeros((*variable.aval.shape, n), bool), const)

    def read(variable: Any) -> _Value:
        if isinstance(variable, jax.extend.core.Literal):
            return np.zeros((*np.shape(variable.val), n), bool), _known(variable.val)
        return values[variable]

    for equation in program.eqns:
        found = _results(equation, [read(x) for x in equation.invars], n)
        values |= zip(equation.outvars, found, strict=True)
    return [read(variable) for variable in program.outvars]


def _results(equation: Any, inputs: list[_Value], n: int) -> list[_Value]:
    name, params = equation.primitive.name, equation.params
    shapes = [x.aval.shape for x in equation.outvars]
    known = [value for _, value in inputs]
    constant = all(value is not None for value in known) and all(
        _may_be_index(x.aval.dtype) and x.aval.size <= _LONGEST_INDEX
        for x in equation.outvars
    )
    if name in CALLING:
        inner = params.get("jaxpr", params.get("call_jaxpr"))
        consts = [_known(const) for const in getattr(inner, "consts", ())]
        return _followed(getattr(inner, "jaxpr", inner), consts, inputs, n)
    if constant and not equation.effects:
        out = _applied(equation, known)
        return [(np.zeros((*x.shape, n), bool), x) for x in out]
    if not inputs:
        # Operations without operands, such as `iota`, depend on no input.
        return [(np.zeros((*shape, n), bool), None) for shape in shapes]
    sets = [s for s, _ in inputs]
    found = _sets(equation, sets, known, shapes)
    if found is not None:
        found = [s.reshape(*shape, n) for s, shape in zip(found, shapes, strict=True)]
    if found is None or equation.effects:
        whole = functools.reduce(np.logical_or, [s.reshape(-1, n).any(0) for s in sets])
        found = [np.broadcast_to(whole, (*shape, n)) for shape in shapes]
    return [(s, None) for s in found]


def _applied(equation: Any, operands: Sequence[Any]) -> list[np.ndarray]:
    """Evaluate the operation of an equation."""
    operands = [np.asarray(x) for x in operands]
    bound = equation.primitive.get_bind_params(equation.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = equation.primitive.bind(
        *functions, *map(jax.numpy.asarray, operands), **params
    )
    out = out if equation.primitive.multiple_results else [out]
    return [np.asarray(x) for x in out]


def _sets(
    equation: Any,
    sets: list[np.ndarray],
    known: list[np.ndarray | None],
    shapes: list[tuple[int, ...]],
) -> list[np.ndarray] | None:
    """Return the sets of an operation's results; None if the operation is unknown."""
    name, params, n = equation.primitive.name, equation.params, sets[0].shape[-1]
    if name in ELEMENTWISE:
        whole = [np.broadcast_to(s, (*shapes[0], n)) for s in sets]
        return [functools.reduce(np.logical_or, whole)]
    if name in _REARRANGING:
        return _rearranged(name, params, sets, known)
    if name.startswith("reduce_") and "axes" in params:
        return [np.asarray(sets[0].any(axis=tuple(params["axes"])))]
    if name == SMALL_PRODUCT:
        return [_of_product(params, *sets)]
    if name == "dot_general":
        (left, right), (on_left, on_right) = params["dimension_numbers"]
        parts = []
        for side, (summed, batch) in enumerate(((left, on_left), (right, on_right))):
            free = [k for k in range(sets[side].ndim - 1) if k not in (*summed, *batch)]
            part = sets[side].any(axis=tuple(summed), keepdims=True)
            part = np.transpose(part, (*batch, *free, *summed, part.ndim - 1))
            keep = part.shape[: len(batch) + len(free)]
            parts.append((part.reshape(*keep, n), len(batch), len(free)))
        (first, batch, free), (second, _, others) = parts
        first = first.reshape(*first.shape[:-1], *(1,) * others, n)
        split = second.shape[:batch], second.shape[batch:-1]
        second = second.reshape(*split[0], *(1,) * free, *split[1], n)
        return [first | second]
    return None


def _of_product(
    params: dict[str, Any], first: np.ndarray, second: np.ndarray
) -> np.ndarray:
    """For each element of a small product, unite the sets of its factors."""
    result, parts = params["result"], []
    for indices, part in ((params["first"], first), (params["second"], second)):
        summed = [k for k, index in enumerate(indices) if index not in result]
        part = part.any(axis=tuple(summed))
        kept = [index for index in indices if index in result]
        order = [kept.index(index) for index in result if index in kept]
        part = np.transpose(part, (*order, part.ndim - 1))
        missing = [k for k, index in enumerate(result) if index not in kept]
        parts.append(np.expand_dims(part, missing))
    return parts[0] | parts[1]


def _rearranged(
    name: str,
    params: dict[str, Any],
    sets: list[np.ndarray],
    known: list[np.ndarray | None],
) -> list[np.ndarray] | None:
    """Rearrange sets as an operation rearranges elements; None if this is unknown."""
    x, n = sets[0], sets[0].shape[-1]
    last = x.ndim - 1
    if name in ("copy", "copy_p"):
        return [x]
    if name in ("expand_dims", "reshape", "squeeze"):
        # These operations do not change the order of the elements.
        return None if params.get("dimensions") and name == "reshape" else [x]
    if name == "transpose":
        return [np.transpose(x, (*params["permutation"], last))]
    if name == "rev":
        return [np.flip(x, params["dimensions"])]
    if name == "concatenate":
        return [np.concatenate(sets, axis=params["dimension"])]
    if name == "split":
        cuts = np.cumsum(params["sizes"])[:-1]
        return list(np.split(x, cuts, axis=params["axis"]))
    if name == "broadcast_in_dim":
        lengths = [1] * len(params["shape"])
        for axis, length in zip(
            params["broadcast_dimensions"], x.shape[:-1], strict=True
        ):
            lengths[axis] = length
        return [np.broadcast_to(x.reshape(*lengths, n), (*params["shape"], n))]
    if name == "slice":
        strides = params["strides"] or (1,) * last
        bounds = params["start_indices"], params["limit_indices"], strides
        return [x[tuple(slice(*one) for one in zip(*bounds, strict=True))]]
    if name == "pad":
        return [_padded(x, sets[1], params["padding_config"])]
    return _gathered(params, x, known[1])


def _padded(x: np.ndarray, filled: np.ndarray, config: Any) -> np.ndarray:
    shape = [
        low + high + length + max(length - 1, 0) * inner
        for length, (low, high, inner) in zip(x.shape[:-1], config, strict=True)
    ]
    out = np.broadcast_to(filled, (*shape, x.shape[-1])).copy()
    to, of = [], []
    for length, target, (low, _, inner) in zip(
        x.shape[:-1], shape, config, strict=True
    ):
        places = low + (inner + 1) * np.arange(length)
        of.append(np.flatnonzero((places >= 0) & (places < target)))
        to.append(places[of[-1]])
    out[np.ix_(*to)] = x[np.ix_(*of)]
    return out


def _gathered(
    params: dict[str, Any], x: np.ndarray, index: np.ndarray | None
) -> list[np.ndarray] | None:
    """Rearrange sets like a gather along one axis; None for all other gathers."""
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    (axis, *others) = numbers.start_index_map
    if index is None or others or numbers.operand_batching_dims:
        return None
    whole = [k for k in range(len(sizes)) if k != axis]
    if sizes[axis] != 1 or any(sizes[k] != x.shape[k] for k in whole):
        return None
    if numbers.collapsed_slice_dims != (axis,):
        return None
    places = index[..., 0]
    # An index out of range is clamped, or gives a constant, for which any set is valid.
    picked = np.take(x, np.clip(places, 0, x.shape[axis] - 1), axis=axis)
    first = list(range(axis, axis + places.ndim))
    rest = [k for k in range(picked.ndim - 1) if k not in first]
    shape_axes: list[int] = [0] * (picked.ndim - 1)
    batch = [k for k in range(picked.ndim - 1) if k not in numbers.offset_dims]
    for target, source in zip(batch, first, strict=True):
        shape_axes[target] = source
    for target, source in zip(numbers.offset_dims, rest, strict=True):
        shape_axes[target] = source
    return [np.transpose(picked, (*shape_axes, picked.ndim - 1))]
