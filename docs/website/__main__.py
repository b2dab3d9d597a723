"""Build the site from the pages, strictly and offline, and look at what was made.

python -m docs.website build    writes build/website/site
python -m docs.website serve    shows it at http://localhost:8000

With --run-notebooks the pages of notebooks have the outputs of runs at full size.
"""

import argparse
import contextlib
import functools
import http.server
import json
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path, PurePosixPath
from typing import Any

from docs.website import api, links, notebooks, pages


HERE = Path(__file__).parent
BUILD = pages.ROOT / "build" / "website"


def main() -> None:
    """Build the site, and serve it if that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("command", choices=("build", "serve"))
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--run-notebooks", action="store_true")
    options = parser.parse_args()
    complaints = build(options.run_notebooks)
    for complaint in complaints:
        print(complaint, file=sys.stderr)
    if complaints:
        sys.exit(1)
    site = BUILD / "site"
    print(f"{sum(1 for _ in site.rglob('*.html'))} pages: {site / 'index.html'}")
    if options.command == "serve":
        serve(site, options.port)


def build(run_notebooks: bool = False) -> list[str]:
    """Write pages and settings, run the generator, and say what is wrong."""
    complaints = api.misplaced()
    if complaints:
        return complaints
    folder = BUILD / "pages"
    pages.write(folder, notebook=notebooks.run if run_notebooks else notebooks.read)
    for place, text in api.pages().items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_text(text, encoding="utf-8")
    for name in ("style.css", "iframe-worker.js"):
        shutil.copyfile(HERE / name, folder / name)
    config = BUILD / "zensical.toml"
    config.write_text(_toml(settings()), encoding="utf-8")
    shutil.rmtree(BUILD / "site", ignore_errors=True)
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    # The generator imports the extensions of this folder by their names.
    ended = subprocess.run([*command, "--config-file", config], cwd=pages.ROOT)
    if ended.returncode:
        return ["The generator refused the pages, for the reasons above."]
    return links.complaints(BUILD / "site")


def settings() -> dict[str, Any]:
    """The settings of the generator, with what is known only from the code."""
    with (HERE / "zensical.toml").open("rb") as file:
        known = tomllib.load(file)
    project = known["project"]
    project |= {"docs_dir": "pages", "site_dir": "site"}
    parts = {
        "API": api.navigation(),
        "Benchmarks": _pages_in("results"),
    }
    project["nav"] = _filled(project["nav"], parts)
    extension = {"names": api.links() | pages.titles()}
    project["markdown_extensions"]["docs.website.extension"] = extension
    return known


def _pages_in(folder: str) -> list[str]:
    """The places of the pages in a folder of the site."""
    places = [PurePosixPath(place) for place in pages.sources().values()]
    return sorted(str(x) for x in places if x.suffix == ".md" and x.parts[0] == folder)


def _filled(nav: list[Any], parts: dict[str, list[Any]]) -> list[Any]:
    """The navigation with the parts that stand there as empty lists."""
    filled = []
    for entry in nav:
        if isinstance(entry, dict):
            ((title, value),) = entry.items()
            if value == []:
                value = parts[title]
            elif isinstance(value, list):
                value = _filled(value, parts)
            entry = {title: value}
        filled.append(entry)
    return filled


def _toml(value: Any) -> str:
    """Settings as TOML: tables at the top, and below them everything in one line."""
    lines = []
    for table, content in value.items():
        lines.append(f"[{table}]")
        lines += [f"{json.dumps(k)} = {_inline(v)}" for k, v in content.items()]
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        inside = ", ".join(f"{json.dumps(k)} = {_inline(v)}" for k, v in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return json.dumps(value)


def serve(site: Path, port: int) -> None:
    """Serve the files until a key interrupts it."""
    handler = functools.partial(
        http.server.SimpleHTTPRequestHandler, directory=str(site)
    )
    print(f"http://localhost:{port}/index.html")
    server = http.server.ThreadingHTTPServer(("localhost", port), handler)
    with server, contextlib.suppress(KeyboardInterrupt):
        server.serve_forever()


if __name__ == "__main__":
    main()
