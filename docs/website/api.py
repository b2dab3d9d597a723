"""The pages of the API: one for each public name, and one for each group in `api.toml`.

The generator fills the pages from the docstrings.
"""

import importlib
import inspect
import tomllib
from pathlib import Path
from typing import Any

from nhjax._results import messages, result_codes


GROUPS = tomllib.loads(Path(__file__).with_name("api.toml").read_text(encoding="utf-8"))
OVERVIEW = """# API

Every public name has a page, which is made from its docstring. `import nhjax` gives all
names except those in its modules `nhjax.systems`, `nhjax.plot` and `nhjax.lanes`.
Equations use the notation of the paper, as [the theory](../theory.md) explains it.
"""


def public_names(space: str) -> dict[str, Any]:
    """Return the public functions and classes of a module by their names.

    Packages import their public names; other modules define them.
    """
    module = importlib.import_module(space)
    home = "nhjax" if hasattr(module, "__path__") else space
    return {
        name: value
        # Some names of nhjax are loaded when they are first used.
        for name, value in ((name, getattr(module, name)) for name in dir(module))
        if not name.startswith("_") and callable(value)
        if getattr(value, "__module__", "").startswith(home)
    }


def documented() -> dict[str, list[tuple[str, Any]]]:
    """Return the public names of each group, as paths with their objects."""
    found = {}
    for title, group in GROUPS.items():
        space = group.get("space", "nhjax")
        public = public_names(space)
        names = group.get("names", public)
        found[title] = [(f"{space}.{name}", public[name]) for name in names]
    listed = [path for pairs in found.values() for path, _ in pairs]
    missing = {f"nhjax.{name}" for name in public_names("nhjax")} - set(listed)
    twice = {path for path in listed if listed.count(path) > 1}
    if missing or twice:
        raise ValueError(
            f"List each public name once in docs/website/api.toml: missing are "
            f"{sorted(missing)}, listed twice are {sorted(twice)}."
        )
    return found


def pages() -> dict[str, dict[str, str]]:
    """Return the pages of each group: the overview of the group and one for each name.

    The keys of each group are the places of the pages in the site.
    """
    groups, places = {}, set()
    for title, pairs in documented().items():
        folder = "api/" + title.lower().replace(" ", "-")
        written, rows = {}, []
        for path, value in pairs:
            place = f"{folder}/{path.rpartition('.')[2]}"
            # Names that differ only in case would be one file on some systems.
            place += "_class" if place.lower() in places else ""
            places.add(place.lower())
            written[f"{place}.md"] = f"::: {path}\n"
            name = path.rpartition(".")[2]
            rows.append((f"[`{name}`][{path}]", _first_sentence(value)))
            if path == "nhjax.RESULTS":
                # The ways in which a run can end have no docstrings.
                ends = [
                    (f"`{code}`", message or "The run came to its end.")
                    for code, message in zip(result_codes(), messages(), strict=True)
                ]
                table = _table(("`sol.result`", "message"), ends)
                written[f"{place}.md"] += f"\n{table}\n"
        text = f"# {title}\n\n{GROUPS[title]['text']}\n\n{_table(('', ''), rows)}\n"
        groups[title] = {f"{folder}/index.md": text} | written
    return groups


def links() -> dict[str, str]:
    """Return the paths of public names, by the text in backquotes that refers to them.

    A name without its module refers to it unless it could be an ordinary word.
    """
    found = {"integrate": "nhjax.integrate"}
    for path, value in (pair for pairs in documented().values() for pair in pairs):
        name = path.rpartition(".")[2]
        is_a_word = name.islower() and "_" not in name
        if not is_a_word and not path.startswith("nhjax.plot"):
            found[name] = path
        found[path] = path
        for member, content in vars(value).items() if inspect.isclass(value) else ():
            is_method = isinstance(content, property) or inspect.isroutine(content)
            if is_method and content.__doc__ and not member.startswith("_"):
                found[f"{name}.{member}"] = f"{path}.{member}"
    return found


def _first_sentence(value: Any) -> str:
    first = " ".join((inspect.getdoc(value) or "").split("\n\n")[0].split())
    return first.split(". ")[0].rstrip(".") + "."


def _table(header: tuple[str, str], rows: list[tuple[str, str]]) -> str:
    """Return a Markdown table of two columns, whose cells may contain bars."""
    cells = [[cell.replace("|", "\\|") for cell in line] for line in rows]
    lines = [header, ("---", "---"), *cells]
    return "\n".join(f"| {first} | {second} |" for first, second in lines)
