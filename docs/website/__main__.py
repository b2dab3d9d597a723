"""Build the site from the pages, strictly and offline.

python -m docs.website build    writes build/website/site
python -m docs.website serve    shows it at http://localhost:8000
"""

import argparse
import contextlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from docs.website import api, pages


HERE = Path(__file__).parent


def main() -> None:
    """Build the site, and serve it if the command is `serve`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=("build", "serve"))
    parser.add_argument("--port", default="8000")
    options = parser.parse_args()
    site = build(pages.ROOT / "build" / "website")
    if found := complaints(site):
        sys.exit("\n".join(found))
    print(f"{sum(1 for _ in site.rglob('*.html'))} pages: {site / 'index.html'}")
    if options.command == "serve":
        command = [sys.executable, "-m", "http.server", options.port, "-d", site]
        with contextlib.suppress(KeyboardInterrupt):
            subprocess.run([*command, "-b", "localhost"])


def build(folder: Path) -> Path:
    """Write pages and settings, run the generator, and return the folder of the site.

    The generator stops at links to pages, headings and names that do not exist.
    """
    shutil.rmtree(folder, ignore_errors=True)
    pages.write(folder / "pages")
    groups = api.pages()
    overview = "".join(
        f"- [{title}]({next(iter(g))[4:]})\n" for title, g in groups.items()
    )
    written = {"api/index.md": f"{api.OVERVIEW}\n{overview}"}
    for of_group in groups.values():
        written |= of_group
    for name in ("style.css", "iframe-worker.js"):
        written[name] = (HERE / name).read_text(encoding="utf-8")
    for place, text in written.items():
        (folder / "pages" / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / "pages" / place).write_text(text, encoding="utf-8")
    settings = (HERE / "zensical.toml").read_text(encoding="utf-8")
    for marker, value in {
        "@api": ["api/index.md", *({t: list(g)} for t, g in groups.items())],
        "@results": [x for x in pages.sources() if re.match(r"results/\w+\.md", x)],
        "@names": api.links() | pages.titles(),
        "@root": str(pages.ROOT),
    }.items():
        settings = settings.replace(f'"{marker}"', _inline(value))
    (folder / "zensical.toml").write_text(settings, encoding="utf-8")
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    # The generator imports the extensions of this folder by their names.
    command += ["--config-file", str(folder / "zensical.toml")]
    subprocess.run(command, cwd=pages.ROOT, check=True)
    return folder / "site"


def _inline(value: Any) -> str:
    """Write a value of TOML in one line."""
    if isinstance(value, dict):
        inside = ", ".join(f"{json.dumps(k)} = {_inline(v)}" for k, v in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return json.dumps(value)


def complaints(site: Path) -> list[str]:
    """List pictures that do not exist, and files that a page loads from other sites."""
    found = []
    for path in sorted({*site.rglob("*.html")} - {site / "404.html"}):
        text = path.read_text(encoding="utf-8")
        for element in re.findall(r"<(?:script|img|iframe|source|link)\b[^>]*>", text):
            for target in re.findall(r'\b(?:src|href)="?([^"\s>]+)', element):
                is_here = (path.parent / target.partition("?")[0]).is_file()
                is_named = re.search(r"rel=\"?(canonical|next|prev)", element)
                if not (is_here or is_named or target.startswith("data:")):
                    found.append(f"{path.relative_to(site)} loads {target}")
    for path in sorted(site.rglob("*.css")):
        if re.search(
            r"@import|url\([\"']?(https?:|//)", path.read_text(encoding="utf-8")
        ):
            found.append(f"{path.relative_to(site)} loads from outside")
    return found


if __name__ == "__main__":
    main()
