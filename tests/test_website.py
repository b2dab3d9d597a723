"""The site: what its build would refuse is seen here, without the generator."""

import re
import tomllib

import pytest

from docs import gallery
from docs.website import api, groups, links, notebooks, pages


PAGES = {
    source: (pages.ROOT / source).read_text(encoding="utf-8")
    for source in [*pages.sources(), "README.md"]
    if source.endswith(".md")
}
PROJECT = tomllib.loads((pages.ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]


def test_every_public_name_has_a_page():
    assert api.misplaced() == []
    assert api.page_names().keys() >= {"nhjax.integrate", "nhjax.plot.energy"}
    places = [place.lower() for place in api.page_names().values()]
    assert len(set(places)) == len(places)


def test_a_name_that_is_new_or_gone_is_found(monkeypatch):
    plots = next(group for group in groups.GROUPS if group.space == "nhjax.plot")
    monkeypatch.setattr(api, "GROUPS", [plots._replace(names=("energy", "spectrum"))])
    assert "nhjax.plot.trajectory is in no group" in api.misplaced()
    assert "nhjax.plot.spectrum is not public" in api.misplaced()


@pytest.mark.parametrize("source", PAGES)
def test_no_link_is_dead(source):
    assert pages.dead_links(PAGES[source], source) == []


def test_dead_links_are_found():
    text = (
        "[a](systems.md#parameters) [b](systems.md#nowhere) [c](gone.md) "
        "[`d`](../README.md) ![e](gone.png) [f](https://example.com/gone) `[g](h.md)`"
    )
    dead = pages.dead_links(text, "docs/new.md")
    assert dead == ["systems.md#nowhere", "gone.md", "gone.png"]


@pytest.mark.parametrize("source", PAGES)
def test_rows_of_tables_have_as_many_cells_as_their_heads(source):
    # A bar in a cell, as of |Φ|, ends it, also in code.
    for table in re.findall(r"(?:^\|.*\n)+", PAGES[source], re.MULTILINE):
        counts = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
        assert len(counts) == 1, table


def test_links_lead_to_the_places_of_the_site():
    places = {
        "docs/a.md": "a.md",
        "benchmarks/results/b.md": "results/b.md",
        "CONTRIBUTING.md": "contributing.md",
    }
    text = "[b](../benchmarks/results/b.md#speed), `[b](../benchmarks/results/b.md)`"
    moved = pages.moved(text, "docs/a.md", places)
    assert moved == "[b](results/b.md#speed), `[b](../benchmarks/results/b.md)`"
    moved = pages.moved("[a](docs/a.md)", "CONTRIBUTING.md", places)
    assert moved == "[a](a.md)"


def test_a_notebook_that_was_run_shows_what_it_printed_and_drew():
    outputs = [
        {"output_type": "stream", "name": "stdout", "text": ["one\n"]},
        {"output_type": "stream", "name": "stderr", "text": "a warning"},
        {"output_type": "stream", "name": "stdout", "text": "two\n"},
        {"output_type": "display_data", "data": {"image/png": "AAEC"}},
    ]
    notebook = {
        "cells": [
            {"cell_type": "markdown", "source": ["# Title"]},
            {"cell_type": "code", "source": "f()", "outputs": outputs},
        ]
    }
    text, pictures = notebooks.page(notebook, "notebooks/n.ipynb")
    assert pictures == {"n-1.png": b"\x00\x01\x02"}
    assert text.startswith("# Title\n\n*The notebook is `notebooks/n.ipynb`")
    assert "```python\nf()\n```\n\n![Picture 1](n-1.png)" in text
    assert text.endswith("```text\none\ntwo\n```\n")


def test_every_page_is_in_the_navigation():
    settings = pages.ROOT / "docs" / "website" / "zensical.toml"
    nav = tomllib.loads(settings.read_text(encoding="utf-8"))["project"]["nav"]
    written = str(nav)
    for source, place in pages.sources().items():
        if place.endswith(".md") and not place.startswith("results/"):
            assert f"'{place}'" in written, source


def test_the_gallery_has_every_system_with_a_small_picture():
    assert gallery.page() == PAGES["docs/gallery.md"], "run python docs/gallery.py"
    for name, value in api.public_names("nhjax.systems").items():
        if hasattr(value, "initial_state"):
            assert f"](gallery/{name}.png)" in PAGES["docs/gallery.md"], name
    drawn = [path.stat().st_size for path in gallery.PICTURES.glob("*.png")]
    assert sum(drawn) < 1e6


def test_built_pages_with_dead_links_or_foreign_scripts_are_found(tmp_path):
    (tmp_path / "a.html").write_text(
        '<h1 id="top">A</h1><a href="b.html#here">b</a><a href="c.html">c</a>'
        '<a href="https://example.com">d</a><a href="#nowhere">e</a>'
        '<script src="https://example.com/f.js"></script><img src="a.html">'
    )
    (tmp_path / "b.html").write_text('<h2 id="here">B</h2><a href="a.html#top">a</a>')
    assert links.complaints(tmp_path) == [
        "a.html loads https://example.com/f.js",
        "a.html leads to c.html, which is not there",
        "a.html leads to #nowhere, an anchor that is not there",
    ]


@pytest.mark.parametrize("source", PAGES)
def test_extras_are_installed_in_one_way(source):
    # Those for users work wherever nhjax is installed, the others need the repository.
    extras = PROJECT["optional-dependencies"]
    commands = re.findall(r"pip install (?:-e )?\"?([.\w]+)\[(\w+)\]", PAGES[source])
    for name, extra in commands:
        assert extra in extras
        assert name == ("." if extra in ("docs", "dev") else "nhjax")


def test_promised_versions_are_those_of_the_package():
    start = PAGES["docs/start.md"]
    ((python, jax),) = re.findall(r"needs Python ([\d.]+) and JAX ([\d.]+), or", start)
    assert PROJECT["requires-python"] == f">={python}"
    assert f"jax>={jax}" in PROJECT["dependencies"]
    tried = set(re.findall(r"^\| (3\.\d+) \|", start, re.MULTILINE))
    classified = re.findall(r"Python :: (3\.\d+)", " ".join(PROJECT["classifiers"]))
    assert sorted(tried) == classified
