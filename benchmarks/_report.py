"""Functions of the benchmarks that measure runs, and write and read reports."""

import argparse
import datetime
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

import nhjax


RESULTS = Path(__file__).parent / "results"


def least_time(
    call: Callable[[], Any],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Call a function `rounds` times, and return the least time in seconds."""
    times = []
    for _ in range(rounds):
        start = clock()
        jax.block_until_ready(call())
        times.append(clock() - start)
    return min(times)


def end_of(sol: nhjax.Solution) -> np.ndarray:
    """Return (q, v) at the end of a run, or NaN if it failed."""
    end = jax.tree.map(lambda x: x[-1], sol.ys)
    y = np.asarray(ravel_pytree((end.q, end.v))[0])
    return y if sol.result == nhjax.RESULTS.successful else np.full_like(y, np.nan)


def from_fresh_process(
    name: str, *arguments: str, environment: Mapping[str, str] | None = None
) -> Any:
    """Run a benchmark in a fresh process; return the JSON of its last printed line."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *arguments],
        env=os.environ | (environment or {}),
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """Write a Markdown table; cells may contain bars, as in |Φ|."""
    lines = [header, ["---"] * len(header), *rows]
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells)


def number(x: float) -> str:
    """Format a number for the tables, with two significant digits."""
    return f"{x:.1e}"


def _finite(x: Any) -> Any:
    """Convert `x` for JSON: arrays to lists, infinities and NaN to None."""
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        x = x.tolist()
    if isinstance(x, dict):
        return {key: _finite(value) for key, value in x.items()}
    if isinstance(x, list | tuple):
        return [_finite(value) for value in x]
    return x if not isinstance(x, float) or math.isfinite(x) else None


def write(name: str, title: str, text: str, data: dict[str, Any]) -> None:
    """Print a report, and save it as Markdown and JSON."""
    about = {
        "date": datetime.date.today().isoformat(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "nhjax": nhjax.__version__,
        "command": " ".join([f"python -m benchmarks.{name}", *sys.argv[1:]]),
    }
    heading = f"# {title}\n\n" + ", ".join(f"{k}: {v}" for k, v in about.items())
    report = f"{heading}\n\n{text}\n"
    print(report)
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.md").write_text(report)
    (RESULTS / f"{name}.json").write_text(
        json.dumps(_finite(about | data), indent=1, allow_nan=False) + "\n"
    )


def add_keep(parser: argparse.ArgumentParser) -> None:
    """Add the option `--keep`, for which `with_saved` reads the saved table."""
    parser.add_argument(
        "--keep",
        action="store_true",
        help="keep the rows of the saved table that are not measured now",
    )


def with_saved(name: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a saved table, updated by new rows.

    A new row replaces the saved rows with the same system and number of stages.
    """
    measured = {(row["system"], row["stages"]) for row in rows}
    saved = json.loads((RESULTS / f"{name}.json").read_text())["rows"]
    others = [row for row in saved if (row["system"], row["stages"]) not in measured]
    return others + rows
