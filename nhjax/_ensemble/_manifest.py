"""What a store was made of, and what has changed since."""

import hashlib
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._files import installed_version
from ._processes import Processes
from ._program import each_reduction
from ._sinks import Work
from ._verdict import without_results


FORMAT = 1
# Entries that may differ where a run is complete: nothing is left to be computed.
_VERSIONS = ("nhjax", "jax")


def manifest(work: Work, variables: dict[str, Any]) -> dict[str, Any]:
    """Describe the parameters of a run, in terms of JSON."""
    return _common(work) | {
        "variables": {
            name: [list(dims[1:]), list(x.shape[1:]), x.dtype.name]
            for name, (dims, x) in variables.items()
        },
    }


def statistics_manifest(work: Work, reductions: Any) -> dict[str, Any]:
    """Describe the parameters of a run that is reduced."""
    return _common(work) | {"reduce": without_addresses(repr(reductions))}


def without_addresses(text: str) -> str:
    """Leave out of a text where functions lie in memory."""
    return re.sub(r"0x[0-9a-f]+", "0x", text)


def _common(work: Work) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "nhjax": installed_version(),
        "jax": jax.__version__,
        "num_members": work.members.count,
        "chunk_size": work.size,
        "members": work.members.digest(),
    }


def values_manifest(work: Work) -> dict[str, Any]:
    """Describe the parameters of a run whose values are kept in memory."""
    leaves = jax.tree.leaves(work.structure)
    return _common(work) | {"values": [f"{x.dtype}{x.shape}" for x in leaves]}


def call_of(
    made: dict[str, Any], text: str, out: bool = False, **others: Any
) -> dict[str, Any]:
    """Describe what processes must have in common that run an ensemble together.

    It is a manifest, a digest of what `program` writes, whether there is an `out`, and
    what else is given.
    """
    run = hashlib.sha256(text.encode()).hexdigest()
    return {"out": out, "reduce": None} | made | {"run": run} | others


def program(work: Work, reductions: Any = ()) -> str:
    """Write the program of one member, with digests of the arrays that it holds.

    After it comes that of the reductions. Addresses of functions, which differ from
    process to process, are left out.
    """

    def run(one):
        return work.run(work.members.make(one))

    def reduce(value):
        value, counts = without_results(value), jnp.ones(1, bool)
        chunk = jax.tree.map(lambda x: x[None], value)
        structure = without_results(work.structure)
        return each_reduction(
            lambda each: each.update(each.init(structure), chunk, counts), reductions
        )

    one = jax.tree.map(lambda x: x[0], work.members.inputs(0, 1))
    parts = [jax.make_jaxpr(run)(one), jax.make_jaxpr(reduce)(work.structure)]
    lines = []
    for closed in parts:
        lines += without_addresses(str(closed)).splitlines()
        lines += [f"array {x}" for x in _constants(closed)]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _constants(closed: Any) -> list[str]:
    found = [
        f"{np.shape(x)} {hashlib.sha256(np.asarray(x).tobytes()).hexdigest()}"
        for x in closed.consts
        if not jnp.issubdtype(x.dtype, jax.dtypes.extended)
    ]
    for equation in closed.jaxpr.eqns:
        leaves = jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: hasattr(x, "consts")
        )
        for part in leaves:
            if hasattr(part, "consts") and hasattr(part, "jaxpr"):
                found += _constants(part)
    return found


def check_resumable(
    where: str, folder: Path, names: tuple[str, ...], maker: str, resume: bool
) -> None:
    """Raise unless the run in a folder may be resumed and the folder has these files.

    `where` says which folder it is, and `maker` which call makes folders of its kind.
    """
    if not resume:
        raise FileExistsError(
            f"{where} exists: go on with it by `resume=True`, or name another one."
        )
    for name in names:
        if not (folder / name).is_file():
            raise ValueError(
                f"{where} has no {name!r}: it was not made by `{maker}`, or is "
                "damaged. Name another folder, or put the file back."
            )


def check_shared(lock: Path, token: str, processes: Processes) -> None:
    """Raise unless a file of a store has the text that process 0 has written to it."""
    if not lock.is_file() or lock.read_text() != token:
        raise ValueError(
            f"Process {processes.index} does not see the store that process 0 has "
            f"made in {str(lock.parents[1])!r}: `out` must be a folder that all "
            "processes share."
        )


def check_same_run(
    where: str,
    old: dict[str, Any],
    new: dict[str, Any],
    programs: tuple[str, str],
    is_done: bool,
) -> None:
    """Raise if two manifests or two `programs`, the old one first, differ."""
    found = _differences(old, new, is_done) or _program_difference(*programs)
    if found:
        raise ValueError(
            f"{where} is that of another run. What differs: {'; '.join(found)}. "
            "Call with the same arguments, or name another folder."
        )


def _differences(old: dict[str, Any], new: dict[str, Any], is_done: bool) -> list[str]:
    """Say in what two manifests differ, but for versions if the run is done."""
    words = {
        "members": "the arrays of `members`, or whether they are a function",
        "variables": "the names, shapes or dtypes of what `run` returns",
    }
    found = []
    for name in new:
        if old.get(name) == new[name] or (is_done and name in _VERSIONS):
            continue
        if name in words:
            found.append(words[name])
        else:
            found.append(f"`{name}`, {old.get(name)} before and {new[name]} now")
    return found


def _program_difference(old: str, new: str) -> list[str]:
    """Say where two programs differ first."""
    if old == new:
        return []
    before, now = old.splitlines(), new.splitlines()
    at = next(
        (i for i, (a, b) in enumerate(zip(before, now, strict=False)) if a != b),
        min(len(before), len(now)),
    )
    one, other = [_line(lines, at) for lines in (before, now)]
    return [
        "what `run` computes, or the numbers in it; first where its program was "
        f"{one!r} and is {other!r}"
    ]


def _line(lines: list[str], at: int) -> str:
    return " ".join(lines[at].split())[:100] if at < len(lines) else "at its end"
