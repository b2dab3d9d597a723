"""The page about events: its blocks run as printed, and assert what they say."""

from pathlib import Path
from typing import Any

from oracles.pages import blocks


PAGE = Path(__file__).parents[2] / "docs" / "events.md"


def test_the_page_holds():
    namespace: dict[str, Any] = {"__name__": "events"}
    for block in blocks(PAGE.read_text(encoding="utf-8")):
        exec(compile(block, PAGE.name, "exec"), namespace)
