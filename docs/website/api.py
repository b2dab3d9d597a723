"""The pages of the API: one for each public name, and one for each group of them.

What they say is in the docstrings. A name that is missing from the groups, or is in one
and no longer public, fails the build and the tests.
"""

import importlib
import inspect
import re
from typing import Any

from docs.website.groups import GROUPS
from nhjax._results import messages, result_codes


OVERVIEW = (
    "# API",
    "",
    "Every public name has a page, which is made from its docstring. `import nhjax` "
    "gives all but those of `nhjax.systems` and `nhjax.plot`, which are modules of it. "
    "Equations are in the notation of the paper, as [the theory](../theory.md) "
    "explains it.",
    "",
)


def public_names(space: str) -> dict[str, Any]:
    """The public functions and classes of a module by their names.

    `nhjax` and `nhjax.systems` name theirs by importing them; the others define them.
    """
    module = importlib.import_module(space)
    gathers = hasattr(module, "__path__")
    return {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_") and (inspect.isclass(value) or callable(value))
        if getattr(value, "__module__", "").startswith("nhjax" if gathers else space)
    }


def misplaced() -> list[str]:
    """What is public and in no group, and what is in a group and not public."""
    complaints = []
    for space in sorted({group.space for group in GROUPS}):
        grouped = [n for group in GROUPS if group.space == space for n in group.names]
        public = public_names(space)
        complaints += [
            f"{space}.{n} is in no group" for n in public if n not in grouped
        ]
        complaints += [f"{space}.{n} is not public" for n in grouped if n not in public]
        twice = {name for name in grouped if grouped.count(name) > 1}
        complaints += [f"{space}.{n} is in two groups" for n in sorted(twice)]
    return complaints


def summary(value: Any) -> str:
    """The first sentence of a docstring."""
    first = " ".join((inspect.getdoc(value) or "").split("\n\n")[0].split())
    return first.split(". ")[0].rstrip(".") + "."


def page_names() -> dict[str, str]:
    """The places of the pages in the site, by the paths of what they document.

    Names that differ in their case alone would be one file on some systems.
    """
    places: dict[str, str] = {}
    for group in GROUPS:
        for name in group.names:
            place = f"api/{group.slug}/{name}"
            if place.lower() in {other.lower() for other in places.values()}:
                place += "_class"
            places[f"{group.space}.{name}"] = place
    return {path: f"{place}.md" for path, place in places.items()}


def links() -> dict[str, str]:
    """What is written in backquotes of each name, and the path that it stands for.

    A name without its module counts if it cannot be another word.
    """
    found = {}
    for path in page_names():
        name = path.rpartition(".")[2]
        found[path] = path
        is_a_word = name.islower() and "_" not in name
        if not is_a_word and not path.startswith("nhjax.plot"):
            found[name] = path
        for member in _members(public_names(path.rpartition(".")[0])[name]):
            found[f"{name}.{member}"] = f"{path}.{member}"
    found["integrate"] = "nhjax.integrate"
    return found


def _members(value: Any) -> list[str]:
    """The public methods and properties that a class defines itself."""
    if not inspect.isclass(value):
        return []
    return [
        name
        for name, member in vars(value).items()
        if not name.startswith("_") and getattr(member, "__doc__", None)
        if isinstance(member, property) or inspect.isroutine(getattr(value, name))
    ]


def pages() -> dict[str, str]:
    """The text of each page, by its place in the site."""
    places = page_names()
    written = {path: f"::: {name}\n" for name, path in places.items()}
    ends = _table(("`sol.result`", "message"), _messages())
    written[places["nhjax.RESULTS"]] += f"\n{ends}\n"
    for group in GROUPS:
        public = public_names(group.space)
        rows = [
            (f"[`{name}`][{group.space}.{name}]", summary(public[name]))
            for name in group.names
        ]
        table = _table(("", ""), rows)
        text = f"# {group.title}\n\n{group.text}\n\n{table}\n"
        written[f"api/{group.slug}/index.md"] = text
    listed = [f"- [{g.title}]({g.slug}/index.md): {_plain(g.text)}" for g in GROUPS]
    written["api/index.md"] = "\n".join([*OVERVIEW, *listed, ""])
    return written


def _table(header: tuple[str, str], rows: list[tuple[str, str]]) -> str:
    """A Markdown table of two columns, whose cells may hold bars."""
    lines = [header, ("---", "---"), *rows]
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "\n".join(f"| {first} | {second} |" for first, second in cells)


def _messages() -> list[tuple[str, str]]:
    """The ways in which a run can end, which have no docstrings, and their messages."""
    return [
        (f"`{name}`", message or "The run came to its end.")
        for name, message in zip(result_codes(), messages(), strict=True)
    ]


def _plain(text: str) -> str:
    """The first sentence of what a group begins with, without its links."""
    without = re.sub(r"(: )?\[[^]]*\]\([^)]*\)", "", text)
    return without.split(". ")[0].rstrip(".:;") + "."


def navigation() -> list[dict[str, Any] | str]:
    """The part of the navigation that leads to these pages."""
    places = page_names()
    parts: list[dict[str, Any] | str] = ["api/index.md"]
    for group in GROUPS:
        of_names = [{n: places[f"{group.space}.{n}"]} for n in group.names]
        parts.append({group.title: [f"api/{group.slug}/index.md", *of_names]})
    return parts
