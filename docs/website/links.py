"""The links of the built pages: none leads nowhere, and nothing is loaded from outside.

The generator looks at the links that pages write; this looks at what a browser would
follow and load, in all that was written.
"""

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


# Elements that a browser loads from, and the attributes that say what.
LOADED = {
    "audio": ("src",),
    "embed": ("src",),
    "iframe": ("src",),
    "img": ("src", "srcset"),
    "input": ("src",),
    "object": ("data",),
    "script": ("src",),
    "source": ("src", "srcset"),
    "video": ("src", "poster"),
}
# Relations of a `link` that are not loaded.
ONLY_NAMED = {"canonical", "next", "prev", "author", "license"}


class Page(HTMLParser):
    """What a page loads, where its links lead, and the anchors that it has."""

    def __init__(self, text: str):
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what one element loads, leads to and is called."""
        values = {name: value for name, value in attrs if value is not None}
        self.anchors |= {values[key] for key in ("id", "name") if key in values}
        self.loaded += [values[key] for key in LOADED.get(tag, ()) if key in values]
        if tag == "link" and not ONLY_NAMED & set(values.get("rel", "").split()):
            self.loaded.append(values.get("href", ""))
        if tag == "a" and "href" in values:
            self.links.append(values["href"])


def complaints(site: Path) -> list[str]:
    """What is wrong with the built pages, one line for each."""
    read = {
        path: Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")
    }
    found = []
    for path, page in sorted(read.items()):
        # It is served for any address, and so its links begin at the root.
        if path.name != "404.html":
            name = path.relative_to(site)
            found += [f"{name} {wrong}" for wrong in _wrong(path, page, read)]
    for path in sorted(site.rglob("*.css")):
        text = path.read_text(encoding="utf-8")
        if "url(http" in text or "url(//" in text or "@import" in text:
            found.append(f"{path.relative_to(site)} loads from outside")
    return found


def _wrong(path: Path, page: Page, read: dict[Path, Page]) -> list[str]:
    """What is wrong with one page, without its name."""
    found = []
    for target in page.loaded + page.links:
        parts = urlsplit(target)
        if parts.scheme or parts.netloc:
            if target in page.loaded and parts.scheme != "data":
                found.append(f"loads {target}")
            continue
        place = path
        if parts.path:
            place = (path.parent / unquote(parts.path)).resolve()
        if not place.is_file():
            found.append(f"leads to {target}, which is not there")
        elif place in read and parts.fragment:
            anchors = read[place].anchors
            # The top of a page is `#__top`, without an element of that name.
            if unquote(parts.fragment) not in anchors | {"__top"}:
                found.append(f"leads to {target}, an anchor that is not there")
    return found
