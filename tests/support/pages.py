"""The blocks of code in pages of the documentation, and the figures that they quote."""

import json
import re
from pathlib import Path
from typing import Any


ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def blocks(text: str, language: str = "python") -> list[str]:
    """The blocks of one language, as printed."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def page(name: str) -> str:
    """The text of the page `name` of the documentation."""
    return (DOCS / f"{name}.md").read_text(encoding="utf-8")


def run_page(name: str) -> dict[str, Any]:
    """Run the blocks of a page as printed; return the names that they define."""
    namespace: dict[str, Any] = {"__name__": name}
    for block in blocks(page(name)):
        exec(compile(block, f"{name}.md", "exec"), namespace)
    return namespace


def results(name: str) -> dict[str, Any]:
    """The committed results of the benchmark `name`."""
    path = ROOT / "benchmarks" / "results" / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))


NUMBER = r"(\d+(?: \d{3})*(?:\.\d+)?(?:e-?\d+)?)"


def quoted(text: str, sentence: str) -> tuple[str, ...]:
    """Return the numbers in the places `{}` of a sentence that a text contains once.

    `…` stands for any words. Line breaks of the text do not count.
    """
    pattern = re.escape(sentence).replace(r"\{\}", NUMBER).replace("…", ".*?")
    found = re.findall(pattern, " ".join(text.split()))
    assert len(found) == 1, f"found {len(found)} times: {sentence}"
    return found[0] if isinstance(found[0], tuple) else (found[0],)


def rows_of(text: str, *headings: str) -> list[list[str]]:
    """The cells of the only table of a page whose first headings are these."""
    cells = [
        [
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in table.splitlines()
        ]
        for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    ]
    (table,) = [x for x in cells if tuple(x[0][: len(headings)]) == headings]
    return table[2:]


def assert_agree(printed: Any, measured: Any) -> None:
    """Each printed number is the measured one, rounded to the digits that are printed.

    Zeros at the end of a whole number above 100 are not digits: 600 may mean 598.
    """
    for text, value in zip(printed, measured, strict=True):
        mantissa, _, exponent = text.partition("e")
        _, _, decimals = mantissa.partition(".")
        zeros = 0
        if not decimals and not exponent and abs(float(text)) >= 100:
            zeros = len(mantissa) - len(mantissa.rstrip("0"))
        unit = 10.0 ** (int(exponent or 0) - len(decimals) + zeros)
        assert abs(float(text) - value) <= 0.5001 * unit, (printed, measured)
