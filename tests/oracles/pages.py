"""The blocks of code in pages of the documentation."""

import re
from pathlib import Path
from typing import Any


DOCS = Path(__file__).parents[2] / "docs"


def blocks(text: str, language: str = "python") -> list[str]:
    """The blocks of one language, as printed."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def page(name: str) -> str:
    """The text of the page `name` of the documentation."""
    return (DOCS / f"{name}.md").read_text(encoding="utf-8")


def run_page(name: str) -> dict[str, Any]:
    """Run the blocks of a page as printed; the names that they leave."""
    namespace: dict[str, Any] = {"__name__": name}
    for block in blocks(page(name)):
        exec(compile(block, f"{name}.md", "exec"), namespace)
    return namespace
