"""The claims of the paper's sections 5 and 7, each measured, with a verdict.

The command writes the table to `benchmarks/results/verdicts.md` and `.json`, and into
the page `docs/experiments.md`, whose figures go to `docs/experiments/`. It takes about
seven minutes on one core. With `--quick` all parts run in a small form, which tests
that they run, but does not decide any claim. With `--only` some parts run alone. With
one of these options no file is written; but `--only` with `--keep` writes the files,
and takes the other parts from the saved table.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import jax
import matplotlib

from nhjax.studies import colour_blind_safe

from ._report import markdown_table, RESULTS, write
from ._verdicts import _ball, _chaotic, _errata, _orders, _ours, _transmission
from ._verdicts._claim import Claim, Found


PARTS = {x.PART: x for x in (_orders, _transmission, _chaotic, _ball, _ours, _errata)}
DOCS = Path(__file__).parents[1] / "docs"
PAGE, PICTURES = DOCS / "experiments.md", DOCS / "experiments"
HEADER = ["claim (section)", "measured", "command", "verdict"]


def measure(
    parts: list[str], quick: bool
) -> tuple[dict[str, list[Claim]], dict[str, Any], dict[str, Any]]:
    """Run some parts; return their claims by part, their data and their figures."""
    claims, data, figures = {}, {}, {}
    for part in parts:
        start = time.process_time()
        with colour_blind_safe():
            found: Found = PARTS[part].found(quick)
        claims[part] = found.claims
        data |= found.data
        figures |= found.figures
        data[f"{part}_cpu_seconds"] = time.process_time() - start
        # Each compiled program uses memory maps, and a process can have only a limited
        # number of them.
        jax.clear_caches()
    return claims, data, figures


def table(claims: list[Claim]) -> str:
    """Write the table."""
    return markdown_table(HEADER, [claim.row() for claim in claims])


def filled(page: str, claims: dict[str, list[Claim]]) -> str:
    """Put the tables into a page, between the marks of each part."""
    for part, lines in claims.items():
        start, end = f"<!-- verdicts: {part} -->\n", "<!-- end -->"
        before, _, rest = page.partition(start)
        _, _, after = rest.partition(end)
        page = f"{before}{start}\n{table(lines)}\n\n{end}{after}"
    return page


def with_saved(
    claims: dict[str, list[Claim]], data: dict[str, Any]
) -> tuple[dict[str, list[Claim]], dict[str, Any]]:
    """Add the claims and data of parts that were not measured from the saved table."""
    saved = json.loads((RESULTS / "verdicts.json").read_text(encoding="utf-8"))
    others = {
        part: [Claim(**line) for line in lines]
        for part, lines in saved.pop("claims").items()
    }
    about = ("date", "device", "jax", "nhjax", "command")
    return others | claims, {k: x for k, x in saved.items() if k not in about} | data


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="short runs; no files")
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, help="these parts; no files"
    )
    parser.add_argument(
        "--keep", action="store_true", help="keep the other parts of the saved table"
    )
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    parts = asked.only or list(PARTS)
    claims, data, figures = measure(parts, asked.quick)
    if asked.keep:
        claims, data = with_saved(claims, data)
    text = table([claim for lines in claims.values() for claim in lines])
    if asked.quick or (asked.only and not asked.keep):
        print(text)
        return
    data["claims"] = {
        part: [dataclasses.asdict(claim) for claim in lines]
        for part, lines in claims.items()
    }
    write("verdicts", "The claims of the paper, measured", text, data)
    PICTURES.mkdir(exist_ok=True)
    with colour_blind_safe():
        for name, figure in figures.items():
            figure.savefig(PICTURES / f"{name}.png", dpi=75)
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), claims), encoding="utf-8")


if __name__ == "__main__":
    main()
