"""The points of work-precision diagrams, and who is first to an accuracy."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ._report import markdown_table, number


# The errors for which the fastest of each kind is looked for.
ACCURACIES = (1e-5, 1e-8, 1e-11)


@dataclass
class Run:
    """One point of a diagram; `call` repeats it."""

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
        """All but the call."""
        return {key: x for key, x in vars(self).items() if key != "call"}


@dataclass
class Measured:
    """All runs of a system over a time, of one or many members."""

    name: str
    t: float
    members: int
    runs: list[Run]
    note: str = ""

    @property
    def title(self) -> str:
        """System, members and time in words."""
        count = "one trajectory" if self.members == 1 else f"{self.members} members"
        return f"{self.name}, {count}, t = {self.t:g}"

    @property
    def quality(self) -> str:
        """What runs are judged by: the energy where no trajectory can be followed."""
        known = any(math.isfinite(run.error) for run in self.runs)
        return "error" if known else "energy_error"

    def section(self) -> str:
        """The tables of the report."""
        parts = [f"## {self.title}", contest_table(self), run_table(self.runs)]
        return "\n\n".join([*parts, self.note] if self.note else parts)

    def data(self) -> dict[str, Any]:
        """For the JSON file."""
        return vars(self) | {
            "runs": [run.figures() for run in self.runs],
            "contest": contests(self),
        }


def kept(path: Path) -> dict[str, Measured]:
    """The cases in a JSON file by title, if there is one."""
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
    """The ladders."""
    ladders: dict[str, list[Run]] = {}
    for run in runs:
        ladders.setdefault(run.method, []).append(run)
    return ladders


def seconds_at(
    ladder: list[Run], accuracy: float, quality: str, of: str
) -> tuple[float, float]:
    """Time of an error, between rungs by powers, and the rung next to it.

    Infinite where no rung is as accurate; a ladder that starts more accurate counts
    with its first rung. A rung that is accurate by chance, while finer ones are not,
    does not count: errors are the largest of the rung and of all finer ones.
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
    """What competes as one: a package, that on several cores apart."""
    words = method.split()
    return " ".join([words[0], *(x for x in words if x in ("devices", "threads"))])


def contests(case: Measured) -> list[dict[str, Any]]:
    """For each accuracy the fastest of each kind, and nhjax's time over it.

    "others" is the fastest of all that is not nhjax, under the fastest of nhjax.
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
    """The method that is the fastest of all others, and nhjax's best time over its."""
    mine = [entry for name, entry in best.items() if name.startswith("nhjax")]
    names = [name for name in best if not name.startswith("nhjax")]
    found: dict[str, Any] = {}
    for of in ("seconds", "fastest"):
        if not names:
            break
        name = min(names, key=lambda name, of=of: best[name][of])
        seconds = best[name][of]
        # The method is that of the median.
        found.setdefault("method", best[name]["method"])
        found[of] = seconds
        found[f"ratio_{of}"] = quotient(min(entry[of] for entry in mine), seconds)
    return found


def contest_table(case: Measured) -> str:
    """`contests`, with the ratios of the fastest times in brackets."""
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
    """The ratio of medians, and that of the fastest in brackets, or nothing."""
    ratio, other = entry["ratio_seconds"], entry["ratio_fastest"]
    return "" if math.isnan(ratio) else f"{ratio:.2f} ({other:.2f})"


def quotient(a: float, b: float) -> float:
    """a / b of times, or NaN where one was not reached."""
    return a / b if math.isfinite(a) and math.isfinite(b) else math.nan


def ms(seconds: float) -> str:
    """Milliseconds, or nothing."""
    return f"{1e3 * seconds:.3g}" if math.isfinite(seconds) else ""


def run_table(runs: list[Run]) -> str:
    """Every rung."""
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
    """Error against time, a panel for each case; energy error where there is none."""
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
            # The darker, the higher s.
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
            # One name for all tolerances of an s, and one for all that is spread.
            label = kind(method) if mine and spread else method.split(",")[0]
            style |= {"label": None if label in named else label}
            named.add(label)
            ax.loglog(x, np.maximum(y, 1e-17), **style)
        ax.set_title(case.title, fontsize="medium")
        ax.set_xlabel("run [ms]")
        ax.set_ylabel(case.quality.replace("_", " "))
        ax.legend(fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(path, dpi=110)
