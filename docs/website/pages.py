"""The written pages, gathered in one folder: `docs/`, results and notebooks."""

import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any

from markdown.extensions.toc import slugify


ROOT = Path(__file__).parents[2]
# Links between pages, and their replacements in the site.
MOVED = (
    (r"\]\(\.\./benchmarks/results/", "](results/"),
    (r"\]\(\.\./notebooks/(\w+)\.ipynb", r"](notebooks/\1.md"),
    (r"\]\(docs/", "]("),
)


def sources() -> dict[str, Path]:
    """Return the file of each page and picture, by its place in the site."""
    found = {"changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}
    written = {place: ROOT / name for place, name in found.items()}
    for folder, prefix in (("docs", ""), ("benchmarks/results", "results/")):
        for path in sorted((ROOT / folder).rglob("*.*")):
            if path.suffix in (".md", ".png", ".gif", ".svg"):
                place = path.relative_to(ROOT / folder).as_posix()
                written[prefix + place] = path
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        written[f"notebooks/{path.stem}.md"] = path
    return written


def write(folder: Path) -> None:
    """Write all pages except the API pages into a folder."""
    for place, path in sources().items():
        target = folder / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            text = path.read_text(encoding="utf-8")
        elif path.suffix == ".ipynb":
            text = notebook_page(read(path), target)
        else:
            shutil.copyfile(path, target)
            continue
        for pattern, new in MOVED:
            text = re.sub(pattern, new, text)
        target.write_text(text, encoding="utf-8")


def read(path: Path) -> dict[str, Any]:
    """Read a notebook with the outputs that `docs/notebooks.py` has stored."""
    return json.loads(path.read_text(encoding="utf-8"))


def notebook_page(notebook: dict[str, Any], target: Path) -> str:
    """Return the page of a notebook, and write its pictures next to it."""
    parts: list[str] = []
    pictures = 0
    for cell in notebook["cells"]:
        if "remove-cell" in cell.get("metadata", {}).get("tags", ()):
            continue
        text = "".join(cell["source"])
        is_text = cell["cell_type"] == "markdown"
        parts.append(text if is_text else f"```python\n{text}\n```")
        printed = ""
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            shown = output.get("text") or data.get("text/plain")
            if "image/png" in data:
                pictures += 1
                name = f"{target.stem}-{pictures}.png"
                (target.parent / name).write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![Picture {pictures}]({name})")
            elif shown and output.get("name") != "stderr":
                printed += "".join(shown).rstrip() + "\n"
        if printed:
            parts.append(f"```text\n{printed}```")
    where = f"*The notebook is `notebooks/{target.stem}.ipynb` in the repository.*"
    return "\n\n".join([parts[0], where, *parts[1:]]) + "\n"


def titles() -> dict[str, str]:
    """Return the anchor of the title of each page in `docs/`, by its path.

    Docstrings name pages by their paths in the repository.
    """
    return {
        f"docs/{path.name}": slugify(
            path.read_text(encoding="utf-8").split("\n", 1)[0].strip("# `"), "-"
        )
        for path in sorted((ROOT / "docs").glob("*.md"))
    }
