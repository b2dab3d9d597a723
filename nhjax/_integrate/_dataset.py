"""A solution as a labelled data set of xarray."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from .._errors import is_traced
from .._results import result_codes
from .._system import State


def to_dataset(
    sol: Any, coordinates: Sequence[str] | None, units: Mapping[str, str]
) -> Any:
    """Create the data set that `Solution.to_xarray` documents."""
    xarray = _xarray()
    if not isinstance(units, Mapping):
        raise TypeError(
            f"`units` must be a dictionary of units by name, got {units!r}."
        )
    if is_traced(*jax.tree.leaves(sol)):
        raise RuntimeError(
            "Solution.to_xarray() needs a computed solution, outside jit and vmap."
        )
    if sol.ts is None:
        raise ValueError(
            "The solution has no saved times: request them with `nhjax.SaveAt`, for "
            "example `steps=True`."
        )
    batch = _batch_dims(np.ndim(sol.t1))
    variables = _saved(sol.ys, (*batch, "time"))
    outcome = {f"stats_{name}": (batch, np.asarray(x)) for name, x in sol.stats.items()}
    outcome["result"] = (batch, _result_names(sol.result))
    if sol.events is not None:
        for name, x in _events(sol):
            outcome[name] = ((*batch, "event"), np.asarray(x))
    labels = _time(np.asarray(sol.ts), batch)
    for name in variables:
        if name in {*outcome, *labels, *batch, "time", "coordinate", "event"}:
            raise ValueError(
                f"`SaveAt(fn=...)` returned an array named {name!r}, which is the name "
                "of another array of the data set: choose another name."
            )
    variables |= outcome
    names = _coordinate_names(sol, coordinates, variables)
    if names is not None:
        labels["coordinate"] = ("coordinate", list(names))
        labels |= units_of_coordinates(names, units)
    made = xarray.Dataset(variables, labels)
    for name, unit in units.items():
        if name in made.variables:
            made[name].attrs["units"] = unit
        elif names is None or name not in names:
            known = [*made.variables, *(names or ())]
            raise ValueError(
                f"`units` has the name {name!r}, but the known names are: "
                f"{', '.join(map(str, known))}."
            )
    return made


def units_of_coordinates(
    names: Sequence[str], units: Mapping[str, str]
) -> dict[str, Any]:
    """Return labels of coordinates: their units and the units of their velocities.

    Momenta have no labels, because their units do not follow from the coordinates.

    **Returns:** a dictionary from names to pairs of a dimension and the units along it.
    """
    of_q, of_t = [units.get(name, "") for name in names], units.get("time", "")
    made = {"coordinate_unit": ("coordinate", of_q)} if any(of_q) else {}
    if made and of_t:
        of_t = f"({of_t})" if set(of_t) & set(" */·") else of_t
        of_v = [f"{unit}/{of_t}" if unit else "" for unit in of_q]
        made["velocity_unit"] = ("coordinate", of_v)
    return made


def _events(sol: Any) -> tuple[tuple[str, Any], ...]:
    return ("event_t", sol.events.ts), ("event_which", sol.events.which)


def named_arrays(value: Any, batch: tuple[str, ...]) -> dict[str, Any]:
    """Name the arrays of a solution or of another tree, and their axes.

    The arrays of a solution have the names of `Solution.to_xarray`, with the times in
    `t` and the codes of `Solution.result` in `result`. Arrays of another tree are named
    by their paths.

    **Returns:** a dictionary from names to pairs (dimensions, array). The dimensions
    start with `batch`.
    """
    # A `Solution` is recognised by its `stats`. Its class cannot be imported here,
    # because its module imports this module.
    if not hasattr(value, "stats"):
        return _named(value, batch, "value", None)
    made = {} if value.ts is None else _saved(value.ys, (*batch, "time"))
    others = {"result": (batch, np.asarray(value.result._value))}
    for name, x in value.stats.items():
        others[f"stats_{name}"] = (batch, np.asarray(x))
    if value.ts is not None:
        others["t"] = ((*batch, "time"), np.asarray(value.ts))
    if value.events is not None:
        for name, x in _events(value):
            others[name] = ((*batch, "event"), np.asarray(x))
    parts = _named(value.checkpoint, batch, "", None)
    others |= {f"checkpoint_{name}": x for name, x in parts.items()}
    for name in made:
        if name in others:
            raise ValueError(
                f"`SaveAt(fn=...)` returned an array named {name!r}, which is the name "
                "of another array of the data set: choose another name."
            )
    return made | others


def _xarray() -> Any:
    try:
        import xarray
    except ImportError as error:
        raise ImportError(
            "Solution.to_xarray() needs xarray, an optional dependency: "
            '`pip install "nhjax[xarray]"`.'
        ) from error
    return xarray


def _batch_dims(number: int) -> tuple[str, ...]:
    if number <= 1:
        return ("trajectory",) * number
    return tuple(f"trajectory_{i}" for i in range(number))


def _time(ts: np.ndarray, batch: tuple[str, ...]) -> dict[str, Any]:
    """Return labels of the time axis, or an array `t` if members differ in times."""
    flat = ts.reshape(-1, ts.shape[-1])
    if flat.shape[0] and np.all(flat == flat[:1]):
        return {"time": ("time", flat[0])}
    return {"t": ((*batch, "time"), ts)}


def _result_names(result: Any) -> np.ndarray:
    names = {code: name for name, code in result_codes().items()}
    codes = np.asarray(result._value)
    return np.array([names[int(code)] for code in codes.flat]).reshape(codes.shape)


def _saved(ys: Any, dims: tuple[str, ...]) -> dict[str, Any]:
    """Name the saved arrays, and their axes after the axes `dims`."""
    if not isinstance(ys, State):
        return _named(ys, dims, "value", None)
    of = ys.v.shape[-1:]
    made = _named(ys.q, dims, "q", of)
    for name, x in (("v", ys.v), ("p", ys.p)):
        made |= _named(x, dims, name, of)
    return made | {"multiplier": ((*dims, "constraint"), np.asarray(ys.multiplier))}


def _named(
    tree: Any, dims: tuple[str, ...], root: str, coordinates: tuple[int, ...] | None
) -> dict[str, Any]:
    """Name the leaves of a tree by their paths, such as q0 and q1 for a tuple q.

    If the tree is a single array whose shape, after the axes `dims`, is `coordinates`,
    its last axis is "coordinate".
    """
    made = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        parts = [_part(key) for key in path]
        name = "_".join(parts)
        if coordinates is not None or not path:
            name = root + name
        elif parts[0].isdigit():
            name = f"{root}{name}"
        if name in made:
            raise ValueError(
                f"Two parts of the value of `SaveAt(fn=...)` have the name {name!r} in "
                "the data set, which joins the keys on a path by _: rename one."
            )
        x = np.asarray(leaf)
        shape = x.shape[len(dims) :]
        inner = tuple(f"{name}_{i}" for i in range(len(shape)))
        if shape == coordinates and not path:
            inner = ("coordinate",)
        made[name] = ((*dims, *inner), x)
    return made


def _part(key: Any) -> str:
    """Format one element of a path in a tree: a key, a name or an index."""
    for attribute in ("key", "name", "idx"):
        if hasattr(key, attribute):
            return str(getattr(key, attribute))
    return str(key)


def _coordinate_names(
    sol: Any, given: Sequence[str] | None, variables: dict[str, Any]
) -> tuple[str, ...] | None:
    if isinstance(given, str):
        raise TypeError(f"`coordinates` must be a tuple of names, got {given!r}.")
    names = sol.coordinates if given is None else tuple(given)
    sizes = [
        x.shape[-1] for dims, x in variables.values() if dims[-1:] == ("coordinate",)
    ]
    if names is None or not sizes:
        return None
    if len(names) != sizes[0] or len(set(names)) != len(names):
        raise ValueError(
            f"`coordinates` has the names {names}, but {sizes[0]} different names are "
            "needed."
        )
    return names
