"""The points of work-precision diagrams, and the fastest method for each accuracy."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ._report import markdown_table, number


# For each of these errors, the tables give the fastest method of each package.
ACCURACIES = (1e-5, 1e-8, 1e-11)


@dataclass
class Run:
    """One point of a diagram; `call` repeats its run."""

    method: str
    rung: float
    call: Callable[[], Any] | None
    compile: float = math.nan
    seconds: float = math.nan
    fastest: float = math.nan
    error: float = math.nan
    median_error: float = math.nan
    violation: float = math.nan
    energy_error: float = math.nan
    iterations: float = math.nan  # per step of nhjax

    def figures(self) -> dict[str, Any]:
        """Return all fields except `call`."""
        return {key: x for key, x in vars(self).items() if key != "call"}


@dataclass
class Measured:
    """All runs of one system to the time `t`, with one or many members."""

    name: str
    t: float
    members: int
    runs: list[Run]
    note: str = ""

    @property
    def title(self) -> str:
        """Return the system, the number of members and the time in words."""
        count = "one trajectory" if self.members == 1 else f"{self.members} members"
        return f"{self.name}, {count}, t = {self.t:g}"

    @property
    def quality(self) -> str:
        """Return the quantity by which runs are judged.

        It is the error of the state, or the energy error if there is no reference for
        the state, because the motion is chaotic.
        """
        known = any(math.isfinite(run.error) for run in self.runs)
        return "error" if known else "energy_error"

    def section(self) -> str:
        """Return the tables of this system for the report."""
        parts = [f"## {self.title}", contest_table(self), run_table(self.runs)]
        return "\n\n".join([*parts, self.note] if self.note else parts)

    def data(self) -> dict[str, Any]:
        """Return the data for the JSON file."""
        return vars(self) | {
            "runs": [run.figures() for run in self.runs],
            "contest": contests(self),
        }


def kept(path: Path) -> dict[str, Measured]:
    """Read the cases of a JSON file by title; without the file there are none."""
    if not path.exists():
        return {}
    cases = {}
    for case in json.loads(path.read_text())["cases"]:
        del case["contest"]
        runs: list[dict[str, Any]] = [
            {key: math.nan if x is None else x for key, x in run.items()}
            for run in case.pop("runs")
        ]
        measured = Measured(**case, runs=[Run(call=None, **run) for run in runs])
        cases[measured.title] = measured
    return cases


def by_method(runs: list[Run]) -> dict[str, list[Run]]:
    """Group runs by method, so that each list is a ladder."""
    ladders: dict[str, list[Run]] = {}
    for run in runs:
        ladders.setdefault(run.method, []).append(run)
    return ladders


def seconds_at(
    ladder: list[Run], accuracy: float, quality: str, of: str
) -> tuple[float, float]:
    """Interpolate the time for an error in a ladder; return also the nearest rung.

    A rung is a step size or a tolerance. Between two rungs, the time is taken as a
    power of the error. The time is infinite if no rung is accurate enough. If the first
    rung is more accurate already, the result is its time. The error of a rung is the
    largest of its own error and of the errors of all finer rungs, so that a rung which
    is accurate by chance does not count.
    """
    best = (math.inf, math.nan)
    coarser = None
    errors = np.maximum.accumulate([getattr(run, quality) for run in ladder[::-1]])
    for run, error in zip(ladder, errors[::-1].tolist(), strict=True):
        seconds = getattr(run, of)
        if error <= accuracy:
            found = seconds
            if coarser is not None and coarser[0] > accuracy and error > 0:
                part = math.log(coarser[0] / accuracy) / math.log(coarser[0] / error)
                found = coarser[1] * (seconds / coarser[1]) ** part
            best = min(best, (found, run.rung))
        coarser = error, seconds
    return best


def kind(method: str) -> str:
    """Return the name of the group of a method.

    A group has the methods of one package. Its runs on several cores, with the word
    "devices" or "threads" in their names, form a separate group.
    """
    words = method.split()
    return " ".join([words[0], *(x for x in words if x in ("devices", "threads"))])


def contests(case: Measured) -> list[dict[str, Any]]:
    """Find the fastest method of each group for each accuracy.

    Each entry also has the ratio of nhjax's time to the time of this method. The entry
    "others" is the fastest method of all other packages; its ratio uses nhjax's best
    time.
    """
    ladders = by_method(case.runs)
    kinds = list(dict.fromkeys(kind(method) for method in ladders))
    outcomes = []
    for accuracy in ACCURACIES:
        best: dict[str, dict[str, Any]] = {}
        for of in ("seconds", "fastest"):
            for name in kinds:
                (seconds, rung), method = min(
                    (seconds_at(ladder, accuracy, case.quality, of), method)
                    for method, ladder in ladders.items()
                    if kind(method) == name
                )
                entry = best.setdefault(name, {"method": method, "rung": rung})
                entry[of] = seconds
                entry[f"ratio_{of}"] = quotient(best["nhjax"][of], seconds)
        others = fastest_of_others(best)
        outcomes.append({"accuracy": accuracy, "best": best, "others": others})
    return outcomes


def fastest_of_others(best: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the fastest method of other packages, and its ratio to nhjax's best time.

    The ratio is nhjax's time divided by the time of this method.
    """
    mine = [entry for name, entry in best.items() if name.startswith("nhjax")]
    names = [name for name in best if not name.startswith("nhjax")]
    found: dict[str, Any] = {}
    for of in ("seconds", "fastest"):
        if not names:
            break
        name = min(names, key=lambda name, of=of: best[name][of])
        seconds = best[name][of]
        # The named method is the method with the smallest median time.
        found.setdefault("method", best[name]["method"])
        found[of] = seconds
        found[f"ratio_{of}"] = quotient(min(entry[of] for entry in mine), seconds)
    return found


def contest_table(case: Measured) -> str:
    """Format `contests` as a table, with the ratios of fastest times in brackets."""
    rows, header = [], []
    for outcome in contests(case):
        header, row = [case.quality.replace("_", " ")], [f"{outcome['accuracy']:.0e}"]
        for name, entry in outcome["best"].items():
            reached = math.isfinite(entry["seconds"])
            words = entry["method"].split()
            method = " ".join(word for word in words if word not in name.split())
            header += [name, "[ms]"]
            if name.startswith("nhjax"):
                method += f", h = {entry['rung']:.3g}"
            row += [method if reached else "", ms(entry["seconds"])]
            if name != "nhjax":
                header.append("nhjax over it")
                row.append(ratios(entry))
        others = outcome["others"]
        if others:
            header += ["fastest of the others", "[ms]", "fastest nhjax over it"]
            reached = math.isfinite(others["seconds"])
            row += [others["method"] if reached else "", ms(others["seconds"])]
            row.append(ratios(others))
        rows.append(row)
    return markdown_table(header, rows)


def ratios(entry: dict[str, Any]) -> str:
    """Format the ratio of medians, and in brackets the ratio of fastest times.

    The result is empty if a time is missing.
    """
    ratio, other = entry["ratio_seconds"], entry["ratio_fastest"]
    return "" if math.isnan(ratio) else f"{ratio:.2f} ({other:.2f})"


def quotient(a: float, b: float) -> float:
    """Return the ratio of two times, or NaN if one of them is infinite."""
    return a / b if math.isfinite(a) and math.isfinite(b) else math.nan


def ms(seconds: float) -> str:
    """Format a time in milliseconds; an infinite time gives an empty text."""
    return f"{1e3 * seconds:.3g}" if math.isfinite(seconds) else ""


def run_table(runs: list[Run]) -> str:
    """Return a table of all runs, one row for each rung of each ladder."""
    header = [
        "method",
        "h or tolerance",
        "compile [s]",
        "run [ms]",
        "fastest",
        "error",
        "median",
    ]
    header += ["|Φ|", "energy", "iterations / step"]
    rows = []
    for run in runs:
        compile_seconds = "" if math.isnan(run.compile) else f"{run.compile:.2f}"
        row = [run.method, f"{run.rung:.3g}", compile_seconds, ms(run.seconds)]
        row.append(ms(run.fastest))
        figures = (run.error, run.median_error, run.violation, run.energy_error)
        row += ["" if math.isnan(x) else number(x) for x in figures]
        iterations = "" if math.isnan(run.iterations) else f"{run.iterations:.1f}"
        rows.append([*row, iterations])
    return markdown_table(header, rows)


def draw(cases: list[Measured], path: Path) -> None:
    """Plot error against time, with a panel for each case.

    If a case has no errors of the state, its panel shows energy errors.
    """
    columns = min(3, len(cases))
    lines = -(-len(cases) // columns)
    figure = Figure(figsize=(7.2 * columns, 4.2 * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for ax in axes[len(cases) :]:
        ax.set_visible(False)
    methods = dict.fromkeys(run.method for case in cases for run in case.runs)
    others = [method for method in methods if not method.startswith("nhjax")]
    colours = {method: f"C{k % 10}" for k, method in enumerate(others)}
    for ax, case in zip(axes, cases, strict=False):
        named: set[str] = set()
        for method, ladder in by_method(case.runs).items():
            x = [1e3 * run.seconds for run in ladder]
            y = [getattr(run, case.quality) for run in ladder]
            mine = method.startswith("nhjax")
            # Methods with more stages have darker lines.
            shade = ""
            if mine:
                stages = int(method.split("s=")[1].split(",")[0])
                shade = str(0.75 - 0.1 * (stages - 2))
            style = {"color": shade if mine else colours[method], "linewidth": 1}
            heyoka = method.startswith("heyoka")
            style |= {"marker": "o" if mine else "+" if heyoka else "x"}
            style |= {"markersize": 4}
            spread = "devices" in method or "threads" in method
            style |= {"linestyle": ":" if spread else "-"}
            # The legend has one entry for all tolerances of a number of stages, and one
            # entry for all runs of nhjax on several devices.
            label = kind(method) if mine and spread else method.split(",")[0]
            style |= {"label": None if label in named else label}
            named.add(label)
            ax.loglog(x, np.maximum(y, 1e-17), **style)
        ax.set_title(case.title, fontsize="medium")
        ax.set_xlabel("run [ms]")
        ax.set_ylabel(case.quality.replace("_", " "))
        ax.legend(fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=110)
