"""The trees that a file holds: their description in JSON, and their arrays."""

import dataclasses
import json
import math
import reprlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._errors import DTypeError, is_traced
from .._integrate import Checkpoint, DenseInterpolation, EventLog, Solution
from .._results import result_codes, RESULTS
from .._system import State


# The classes that a file may name; by their fields, so that a later release can add to
# them what has a default.
_CLASSES: dict[str, type] = {
    kind.__name__: kind for kind in (State, Solution, Checkpoint, EventLog)
}
_ADVICE = (
    "A file holds states, solutions, checkpoints, and tuples, lists and dictionaries "
    "of arrays, numbers and strings."
)


def described(tree: Any, arrays: dict[str, np.ndarray], path: str = "") -> Any:
    """Describe a tree in terms of JSON, and collect its arrays by name in `arrays`."""
    kind = type(tree).__name__
    where = f"`{path.strip('.')}`" if path else "what is to be saved"
    if is_traced(tree):
        raise TypeError(
            f"{where} has no value yet: call `nhjax.save` outside of jit, vmap and "
            "grad."
        )
    if tree is None or type(tree) in (bool, int, str):
        return {"kind": "value", "value": tree}
    if type(tree) is float:
        # JSON itself has no infinite numbers.
        value = tree if math.isfinite(tree) else None
        return {"kind": "float", "value": value, "text": repr(tree)}
    if isinstance(tree, type(RESULTS.successful)) and tree._enumeration is RESULTS:
        codes = described(tree._value, arrays, path)
        return {"kind": "RESULTS", "codes": codes, "names": result_codes()}
    if isinstance(tree, jax.Array | np.ndarray | np.generic):
        return {"kind": "array", "name": _kept(tree, arrays, path, where)}
    if isinstance(tree, DenseInterpolation):
        raise TypeError(
            f"{where} is the dense output of a run, which holds the functions of the "
            "system, and these cannot be written to a file. Evaluate it and save what "
            "you need, or leave it out: `dataclasses.replace(sol, interpolation=None)`."
        )
    if _CLASSES.get(kind) is type(tree):
        items = [(x.name, getattr(tree, x.name)) for x in dataclasses.fields(tree)]
        parts = {name: described(x, arrays, f"{path}.{name}") for name, x in items}
        return {"kind": kind, "parts": parts}
    if isinstance(tree, tuple | list) and type(tree) in (tuple, list):
        parts = [described(x, arrays, f"{path}[{i}]") for i, x in enumerate(tree)]
        return {"kind": kind, "parts": parts}
    if type(tree) is dict:
        parts = [
            [_key(key, where), described(x, arrays, f"{path}[{key!r}]")]
            for key, x in tree.items()
        ]
        return {"kind": kind, "parts": parts}
    raise TypeError(
        f"{where} is {reprlib.repr(tree)} of type {kind}, which cannot be saved. "
        f"{_ADVICE}"
    )


def _key(key: Any, where: str) -> str | int:
    if type(key) in (str, int):
        return key
    raise TypeError(
        f"{where} has the key {key!r} of type {type(key).__name__}, but the keys of a "
        "dictionary in a file are strings or ints."
    )


def _kept(x: Any, arrays: dict[str, np.ndarray], path: str, where: str) -> str:
    """Put an array among the others, under its path; return the name that it has."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        raise TypeError(
            f"{where} is a key of random numbers: save `jax.random.key_data` of it."
        )
    array = np.asarray(x)
    if array.dtype.kind not in "biufc":
        raise TypeError(
            f"{where} has dtype {array.dtype}, which NumPy's files do not hold; "
            "convert it to one of NumPy's numbers."
        )
    name = path.strip(".") or "array"
    while name in arrays:
        name += "_"
    arrays[name] = array
    return name


def rebuilt(description: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Make the tree of a description again."""
    kind = description["kind"]
    if kind == "value":
        return description["value"]
    if kind == "float":
        return float(description["text"])
    if kind == "array":
        return _array(description["name"], arrays[description["name"]])
    if kind == "RESULTS":
        return _results(rebuilt(description["codes"], arrays), description["names"])
    parts = description["parts"]
    if kind in ("tuple", "list"):
        made = [rebuilt(part, arrays) for part in parts]
        return tuple(made) if kind == "tuple" else made
    if kind == "dict":
        return {key: rebuilt(part, arrays) for key, part in parts}
    if kind not in _CLASSES:
        raise ValueError(
            f"it names the kind {kind!r}, which this release does not know"
        )
    return _instance(kind, {name: rebuilt(x, arrays) for name, x in parts.items()})


def _instance(kind: str, parts: dict[str, Any]) -> Any:
    fields = {x.name for x in dataclasses.fields(_CLASSES[kind])}
    unknown = sorted(set(parts) - fields)
    if unknown:
        raise ValueError(
            f"its {kind} has the parts {', '.join(unknown)}, which this release does "
            "not know"
        )
    return _CLASSES[kind](**parts)


def _array(name: str, array: np.ndarray) -> Array:
    made = jnp.asarray(array)
    if made.dtype != array.dtype:
        raise DTypeError(
            f"`{name}` has dtype {array.dtype} in the file, but JAX would round it to "
            f'{made.dtype}: run `jax.config.update("jax_enable_x64", True)` first.'
        )
    return made


def _results(codes: Array, names: dict[str, int]) -> PyTree[Array]:
    """Make results of codes, which another release may have counted differently."""
    unknown = sorted(set(names) - set(result_codes()))
    if unknown:
        raise ValueError(f"it names the results {', '.join(unknown)}, not known here")
    table = np.zeros(max(names.values()) + 1, np.int32)
    for name, code in names.items():
        table[code] = result_codes()[name]
    ours = jnp.asarray(table[np.asarray(codes)])
    return eqx.tree_at(lambda result: result._value, RESULTS.successful, ours)


def as_text(header: dict[str, Any]) -> np.ndarray:
    """Write a header as the bytes of JSON, which NumPy's files can hold."""
    text = json.dumps(header, allow_nan=False)
    return np.frombuffer(text.encode("utf-8"), np.uint8)


def from_text(array: np.ndarray) -> dict[str, Any]:
    """Read the header of a file from its text."""
    header = json.loads(array.tobytes().decode("utf-8"))
    kinds = {"format": int, "nhjax": str, "tree": dict}
    if not isinstance(header, dict) or any(
        not isinstance(header.get(name), kind) for name, kind in kinds.items()
    ):
        raise ValueError(f"its header lacks {', '.join(kinds)}")
    return header
