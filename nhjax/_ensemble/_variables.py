"""The arrays of a store: their names, their axes and what is said of them."""

import hashlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .._integrate import named_arrays, Solution, units_of_coordinates
from .._results import result_codes
from ._sinks import Work
from ._verdict import codes_of_results


BATCH = ("trajectory",)


def rows_of(content: Any, count: int) -> dict[str, Any]:
    """Name the arrays of the first members of a chunk, with their axes."""
    rows = jax.tree.map(lambda x: np.asarray(x)[:count], content)
    return named_arrays(codes_of_results(rows), BATCH)


def variables_of(work: Work) -> dict[str, Any]:
    """Name the arrays of values and their axes; the arrays themselves are empty."""
    empty = jax.tree.map(lambda x: np.empty((1, *x.shape), x.dtype), work.structure)
    made = named_arrays(codes_of_results(empty), BATCH)
    for name, (dims, x) in made.items():
        if name in ("manifest", "time", *BATCH) or "/" in name or name.startswith("."):
            raise ValueError(
                f"`run` returns an array called {name!r}, a name that a store cannot "
                "give it: take another key."
            )
        if x.dtype.kind not in "biufc":
            raise TypeError(
                f"`run` returns the array {name!r} of dtype {x.dtype}, which Zarr does "
                "not hold: convert it to one of NumPy's numbers."
            )
        if len(set(dims)) < len(dims):
            raise ValueError(f"The axes of {name!r} have one name twice: {dims}.")
    return made


def attributes_of(
    structure: Any, variables: dict[str, Any], units: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """Say what the arrays are: their units, and what is known of a solution.

    Names of coordinates and their units are attributes, since Zarr has no arrays of
    strings that all releases read.
    """
    made: dict[str, dict[str, Any]] = {name: {} for name in (*variables, "time")}
    names = structure.coordinates if isinstance(structure, Solution) else None
    along = [name for name, (dims, _) in variables.items() if "coordinate" in dims]
    coordinates = names if names is not None and along else ()
    for name, unit in units.items():
        if name in made:
            made[name]["units"] = unit
        elif name not in coordinates:
            raise ValueError(
                f"`units` has the name {name!r}, but the names here are: "
                f"{', '.join([*made, *coordinates])}."
            )
    if isinstance(structure, Solution):
        codes = result_codes()
        made["result"]["flag_values"] = list(codes.values())
        made["result"]["flag_meanings"] = " ".join(codes)
    for name in along if coordinates else ():
        made[name]["coordinate_names"] = list(coordinates)
    labels = units_of_coordinates(coordinates, units)
    for name, label in (("q", "coordinate_unit"), ("v", "velocity_unit")):
        if name in along and label in labels:
            made[name]["coordinate_units"] = labels[label][1]
    return made


def common_times(rows: dict[str, Any]) -> str | None:
    """Compute a digest of the times of members, if they are the same for all."""
    if "t" not in rows:
        return None
    times = rows["t"][1]
    if not np.all(times == times[:1]):
        return None
    return hashlib.sha256(np.ascontiguousarray(times[0]).tobytes()).hexdigest()
