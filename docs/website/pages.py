"""The pages of the site, gathered from where they are written, with links that hold.

`docs/` has most of them. Results of benchmarks, notebooks and the files at the top of
the repository join them, so that a link to one of these leads to a page.
"""

import os
import re
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

from docs.website import notebooks


ROOT = Path(__file__).parents[2]
PAGES_AND_PICTURES = {".md", ".png", ".gif", ".svg"}
LINK = re.compile(r"(?P<before>!?\[(?:[^\[\]]|\[[^\]]*\])*\])\((?P<to>[^)\s]+)\)")
# Fenced blocks and code in a line, which hold no links.
CODE = re.compile(r"(^ *```.*?^ *```$|`+[^`]+?`+)", re.MULTILINE | re.DOTALL)


def sources(root: Path = ROOT) -> dict[str, str]:
    """The place of each page and picture in the site, by its path in the repository."""
    found = {}
    docs = root / "docs"
    for path in sorted(docs.rglob("*.*")):
        if path.suffix in PAGES_AND_PICTURES:
            place = path.relative_to(docs).as_posix()
            found[f"docs/{place}"] = place
    results = root / "benchmarks" / "results"
    for path in sorted(results.rglob("*.*")):
        if path.suffix in PAGES_AND_PICTURES:
            place = path.relative_to(results).as_posix()
            found[f"benchmarks/results/{place}"] = f"results/{place}"
    for path in sorted((root / "notebooks").glob("*.ipynb")):
        found[f"notebooks/{path.name}"] = f"notebooks/{path.stem}.md"
    found["CHANGELOG.md"] = "changelog.md"
    found["CONTRIBUTING.md"] = "contributing.md"
    return found


def write(
    folder: Path, root: Path = ROOT, *, notebook: Callable[[Path], Any] = notebooks.read
) -> None:
    """Write all pages but those of the API, and copy pictures, into a fresh folder.

    `notebook` reads a notebook from its path: as it is, without outputs, or run.
    """
    shutil.rmtree(folder, ignore_errors=True)
    places = sources(root)
    for source, place in places.items():
        target = folder / place
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix != ".md":
            shutil.copyfile(root / source, target)
            continue
        if source.endswith(".ipynb"):
            text, pictures = notebooks.page(notebook(root / source), source)
            for name, picture in pictures.items():
                (target.parent / name).write_bytes(picture)
        else:
            text = (root / source).read_text(encoding="utf-8")
        target.write_text(moved(text, source, places), encoding="utf-8")


def moved(text: str, source: str, places: dict[str, str]) -> str:
    """A page with its links turned into those between places of the site.

    Links to what has no place, and to what is not there, are left as they are, for the
    generator to complain of; `dead_links` finds them without it.
    """
    start = PurePosixPath(places[source]).parent

    def turned(to: str) -> str:
        path, mark, anchor = to.partition("#")
        place = places.get(resolved(path, source))
        if not path or place is None:
            return to
        return os.path.relpath(place, start) + mark + anchor

    return _each_link(text, turned)


def _each_link(text: str, change: Callable[[str], str]) -> str:
    """Change where each link that is no code leads to."""

    def link(match: re.Match[str]) -> str:
        return f"{match['before']}({change(match['to'])})"

    # Code inside the text of a link is part of it: hide it, and put it back.
    kept: list[str] = []

    def hide(match: re.Match[str]) -> str:
        kept.append(match[0])
        return f"\x00{len(kept) - 1}\x00"

    changed = LINK.sub(link, CODE.sub(hide, text))
    return re.sub(r"\x00(\d+)\x00", lambda match: kept[int(match[1])], changed)


def resolved(path: str, source: str) -> str:
    """The path in the repository that a link of a page leads to."""
    return os.path.normpath(str(PurePosixPath(source).parent / path))


def is_outside(to: str) -> bool:
    """Whether a link leads to another site."""
    return re.match(r"[a-z]+:", to) is not None


def dead_links(text: str, source: str, root: Path = ROOT) -> list[str]:
    """The links of a page to files and headings that are not there."""
    dead: list[str] = []

    def check(to: str) -> str:
        path, _, anchor = to.partition("#")
        target = root / resolved(path, source) if path else root / source
        if is_outside(to):
            return to
        if not target.is_file() or (
            anchor and anchor not in anchors(target.read_text(encoding="utf-8"))
        ):
            dead.append(to)
        return to

    _each_link(text, check)
    return dead


def anchors(text: str) -> set[str]:
    """The anchors of the headings of a page, as the generator makes them."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {slug(heading) for heading in headings}


def slug(heading: str) -> str:
    """What Python-Markdown makes of a heading: ASCII, with hyphens."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
    split = unicodedata.normalize("NFKD", plain)
    ascii_only = split.encode("ascii", "ignore").decode()
    words = re.sub(r"[^\w\s-]", "", ascii_only).strip().lower()
    return re.sub(r"[-\s]+", "-", words)


def titles(root: Path = ROOT) -> dict[str, str]:
    """The anchor of the title of each page in `docs/`, by its path.

    Docstrings name pages by their paths, as they are in the repository.
    """
    found = {}
    for path in sorted((root / "docs").glob("*.md")):
        title = path.read_text(encoding="utf-8").split("\n", 1)[0]
        found[f"docs/{path.name}"] = slug(title.removeprefix("# "))
    return found
