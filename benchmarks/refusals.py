"""How often `initial_state(..., project=True)` refuses a state near the constraints.

Every system of the gallery that has constraints is given states that are off by offsets
from nothing to 1e-2, in random directions: in q (in its entries, as a user would have
them rounded, and along the group), in v, and in v at rest. None may be refused below
1e-3. Unit vectors that were rounded to ten digits are a case of their own.
"""

import argparse
import json
import logging
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems
from nhjax.systems._base import AbstractExample

from . import _refusals_near_zero
from ._report import markdown_table, RESULTS, write


OFFSETS = (0.0, *(10.0**k for k in range(-16, -1)))
LARGEST_THAT_MUST_PASS = 1e-4
KEPT = "directions", "offsets", "rounded_unit_vectors_refused", "rows"


def examples() -> Iterator[AbstractExample]:
    """The systems with constraints, with their default parameters."""
    for name in vars(systems):
        kind = getattr(systems, name)
        if isinstance(kind, type) and issubclass(kind, AbstractExample):
            example = kind()  # pyright: ignore[reportCallIssue]
            system = example.system
            if system.nonholonomic is not None or system.holonomic is not None:
                yield example


def cast(tree: Any, dtype: Any) -> Any:
    """The arrays of `tree` in a precision."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)


def direction(rng: np.random.Generator, like: Any) -> Any:
    """A random direction, of length one, of the shape of a tree."""
    parts = jax.tree.map(lambda x: rng.normal(size=x.shape), like)
    size = np.sqrt(sum(np.sum(x**2) for x in jax.tree.leaves(parts)))
    return jax.tree.map(lambda x: x / size, parts)


def disturbed(
    system: Any, kind: str, q: Any, v: Any, offset: float, rng: np.random.Generator
) -> tuple[Any, Any]:
    """(q, v) off by `offset` in a random direction."""
    dtype = v.dtype
    if kind == "q":
        step = cast(direction(rng, q), dtype)
        return jax.tree.map(lambda x, dx: x + offset * dx, q, step), v
    along = offset * cast(direction(rng, v), dtype)
    if kind == "q, along the group":
        return system.manifold_of(q).act(q, along), v
    return q, v + along


def kinds(example: AbstractExample) -> list[str]:
    """What may be off; at rest where constraints are linear in v."""
    flat = example.system.manifold_of(example.q0).is_flat
    along = [] if flat else ["q, along the group"]
    rest = [] if isinstance(example, systems.Appell) else ["v, at rest", "q, at rest"]
    return ["q", *along, "v", *rest]


def refused(start: Callable[[Any, Any], Any], q: Any, v: Any) -> bool:
    """Whether a state is refused, or is not finite."""
    try:
        y = start(q, v)
        return not all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(y))
    except (RuntimeError, ValueError):  # which of them is up to JAX
        return True


def count(
    example: AbstractExample, dtype: Any, directions: int, offsets=OFFSETS
) -> dict[str, list[int]]:
    """For each kind of disturbance and offset, how many states are refused."""
    system, rng = cast_system(example, dtype), np.random.default_rng(0)
    start = jax.jit(lambda q, v: nhjax.initial_state(system, q, v, project=True))
    q0, v0 = cast(example.q0, dtype), cast(example.v0, dtype)
    there = start(q0, v0)
    away = start(*disturbed(system, "q", there.q, there.v, 0.2, rng))
    table = {}
    for kind in kinds(example):
        table[kind] = []
        for offset in offsets:
            given = []
            for i in range(directions):
                base = (there, away)[i % 2]
                v = jnp.zeros_like(base.v) if kind.endswith("rest") else base.v
                what = kind.removesuffix(", at rest")
                given.append(disturbed(system, what, base.q, v, offset, rng))
            table[kind].append(sum(refused(start, q, v) for q, v in given))
    return table


def cast_system(example: AbstractExample, dtype: Any) -> Any:
    """The system with its parameters in a precision."""
    return jax.tree.map(
        lambda x: x.astype(dtype) if isinstance(x, jax.Array) else x, example.system
    )


def rounded_unit_vectors(number: int) -> int:
    """How many unit vectors, rounded to ten digits, a spherical pendulum refuses."""
    system, rng = systems.SphericalPendulum().system, np.random.default_rng(0)
    start = jax.jit(lambda q, v: nhjax.initial_state(system, q, v, project=True))
    return sum(
        refused(
            start, jnp.asarray(np.round(direction(rng, np.zeros(3)), 10)), jnp.zeros(3)
        )
        for _ in range(number)
    )


def near_constraints(directions: int) -> dict[str, Any]:
    """Count refusals of all systems of the gallery, and of rounded unit vectors."""
    rows = []
    for example in examples():
        name = type(example).__name__
        for dtype in (jnp.float64, jnp.float32):
            table = count(example, dtype, directions)
            for kind, counts in table.items():
                about = {"system": name, "dtype": dtype.__name__, "disturbed": kind}
                rows.append(about | {"refused": counts})
                print(rows[-1], flush=True)
        jax.clear_caches()
    return {
        "directions": directions,
        "offsets": OFFSETS,
        "rounded_unit_vectors_refused": rounded_unit_vectors(1000),
        "rows": rows,
    }


def near_zero(directions: int) -> list[dict[str, Any]]:
    """Count refusals of states near zero."""
    return [
        {"constraint": name} | row
        for name, case in _refusals_near_zero.CASES.items()
        for row in _refusals_near_zero.count(case, directions)
    ]


def report(data: dict[str, Any]) -> str:
    """Write both tables."""
    worst = max(
        x
        for row in data["rows"]
        for offset, x in zip(OFFSETS, row["refused"], strict=True)
        if offset <= LARGEST_THAT_MUST_PASS
    )
    tables = [
        markdown_table(
            ["system", "dtype", "disturbed", *(f"{x:.0e}" for x in OFFSETS)],
            [
                [row["system"], row["dtype"], row["disturbed"]]
                + [str(x) for x in row["refused"]]
                for row in data["rows"]
            ],
        ),
        markdown_table(
            [
                "constraint",
                "size of q",
                *(f"{k} units" for k in _refusals_near_zero.UNITS),
            ],
            [
                [row["constraint"], f"{row['size']:.0e}"]
                + [str(x) for x in row["refused"].values()]
                for row in data["near_zero"]
            ],
        ),
    ]
    number = data["near_zero"][0]["number"]
    return "\n\n".join(
        [
            f"Refused of {data['directions']}, by offset. At most {worst} below 1e-3. "
            "Of 1000 unit vectors rounded to ten digits "
            f"{data['rounded_unit_vectors_refused']} are refused.",
            tables[0],
            f"{(_refusals_near_zero.__doc__ or '').strip()} Refused of {number}:",
            tables[1],
        ]
    )


def main() -> None:
    """Print and save the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--directions", type=int, default=50)
    parser.add_argument(
        "--near-zero",
        action="store_true",
        help="measure states near zero alone, and keep the rest of the saved tables",
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # Each refusal would be a line.
    logging.getLogger("jax._src.callback").disabled = True
    if options.near_zero:
        data = json.loads((RESULTS / "refusals.json").read_text(encoding="utf-8"))
        data = {k: data[k] for k in KEPT}
    else:
        data = near_constraints(options.directions)
    data["near_zero"] = near_zero(options.directions)
    title = "States near the constraints that are refused"
    write("refusals", title, report(data), data)


if __name__ == "__main__":
    main()
