"""The site: its build is strict, and it has a page for each public name."""

import re
import tomllib

import pytest
from latex2mathml.converter import convert

from docs import gallery
from docs.website import api, pages
from docs.website.__main__ import build, complaints


PAGES = {
    place: path.read_text(encoding="utf-8")
    for place, path in pages.sources().items()
    if path.suffix == ".md"
} | {"README.md": (pages.ROOT / "README.md").read_text(encoding="utf-8")}
PROJECT = tomllib.loads((pages.ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]


def test_website_builds_with_a_page_for_each_public_name(tmp_path):
    site = build(tmp_path)
    assert complaints(site) == []
    for space in ("nhjax", "nhjax.systems", "nhjax.plot"):
        for name in api.public_names(space):
            anchor = f'id="{space}.{name}"'
            found = [*site.glob(f"api/*/{name}.html"), *site.glob(f"api/*/{name}_*")]
            assert any(anchor in path.read_text(encoding="utf-8") for path in found)


def test_website_with_missing_unknown_or_repeated_name_raises(monkeypatch):
    names = api.GROUPS["Events"]["names"]
    monkeypatch.setitem(api.GROUPS, "Events", {"names": names[1:]})
    with pytest.raises(ValueError, match=r"missing are \['nhjax.Event'\]"):
        api.documented()
    monkeypatch.setitem(api.GROUPS, "Events", {"names": [*names, *names]})
    with pytest.raises(ValueError, match="listed twice are"):
        api.documented()
    monkeypatch.setitem(api.GROUPS, "Events", {"names": ["Gone"]})
    with pytest.raises(KeyError, match="Gone"):
        api.documented()


def test_website_external_files_and_missing_pictures_are_detected(tmp_path):
    (tmp_path / "a.html").write_text(
        '<a href="https://example.com">d</a><script src="https://example.com/f.js">'
        '</script><img alt="" src="gone.png"><img src=a.html>'
        '<link href="https://example.com/a" rel="canonical">'
    )
    (tmp_path / "b.css").write_text("p { background: url(//example.com/c.png) }")
    assert complaints(tmp_path) == [
        "a.html loads https://example.com/f.js",
        "a.html loads gone.png",
        "b.css loads from outside",
    ]


@pytest.mark.parametrize("place", PAGES)
def test_website_table_rows_have_as_many_cells_as_the_header(place):
    # A bar, as in |Φ|, ends a cell even in code; the generator drops surplus cells.
    for table in re.findall(r"(?:^\|.*\n)+", PAGES[place], re.MULTILINE):
        counts = {len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines()}
        assert len(counts) == 1, table


def test_website_notebook_shows_its_text_and_figures(tmp_path):
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
    text = pages.notebook_page(notebook, tmp_path / "n.md")
    assert (tmp_path / "n-1.png").read_bytes() == b"\x00\x01\x02"
    assert text.startswith("# Title\n\n*The notebook is `notebooks/n.ipynb`")
    assert "```python\nf()\n```\n\n![Picture 1](n-1.png)" in text
    assert text.endswith("```text\none\ntwo\n```\n")


def test_website_navigation_contains_every_page():
    settings = pages.ROOT / "docs" / "website" / "zensical.toml"
    nav = tomllib.loads(settings.read_text(encoding="utf-8"))["project"]["nav"]
    for place in pages.sources():
        if place.endswith(".md") and not place.startswith("results/"):
            assert f"'{place}'" in str(nav)


def test_website_gallery_has_a_small_picture_of_each_system():
    assert gallery.page() == PAGES["gallery.md"], "run python docs/gallery.py"
    for name, value in api.public_names("nhjax.systems").items():
        if hasattr(value, "initial_state"):
            assert f"](gallery/{name}.png)" in PAGES["gallery.md"], name
    drawn = [path.stat().st_size for path in gallery.PICTURES.glob("*.png")]
    assert len(drawn) == len(gallery.pictures())
    assert max(drawn) < 6e4
    assert sum(drawn) < 1.2e6


def test_website_gallery_shows_the_formulas_and_the_model_of_each_system():
    for picture in gallery.pictures():
        name = picture.name
        paragraphs, source = gallery.described(picture.example)
        assert any(re.match(r"\$\$.*(L|\\ell) ?=", x) for x in paragraphs), name
        assert source.startswith("**Source:**")
        shown = gallery.model(picture.example)
        assert shown[0].startswith("def lagrangian("), name
        system, text = picture.example.system, "\n".join(shown)
        assert ("def constraint(" in text) == (system.nonholonomic is not None), name
        assert ("def holonomic(" in text) == (system.holonomic is not None), name
        # The functions of the system are shown in full, so some excerpts are longer.
        assert sum(x.count("\n") + 2 for x in shown) <= gallery.MODEL_LINES + 12, name


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("m/2 (ẋ² + ẏ²)", r"\frac{m}{2} \left(\dot{x}^{2}+\dot{y}^{2}\right)"),
        ("k m a²/2 |ω|²", r"\frac{k m a^{2}}{2} \left|\omega \right|^{2}"),
        ("-sin θ ẋ + cos 2y", r"-\sin \theta \, \dot{x}+\cos 2 y"),
        ("sin(θ + φ_b) ẍ", r"\sin\left(\theta +\varphi _{b}\right)\, \ddot{x}"),
        ("½ ωᵀ I ω", r"\tfrac{1}{2} \omega ^{\top } I \omega"),
        ("a/√(γ·(A γ))", r"\frac{a}{\sqrt{\gamma \cdot \left(A \gamma \right)}}"),
        ("(J_s + J_m)/2 φ̇²", r"\frac{J_{s}+J_{m}}{2} \dot{\varphi}^{2}"),
        ("(R (v + ω × s))₁₂", r"\left(R \left(v+\omega \times s\right)\right)_{12}"),
        ("Σ_{i=1..m} q²_{m+1+i}", r"\sum_{i=1}^{m} q_{m+1+i}^{2}"),
        ("∇Φ/|∇Φ|", r"\frac{\nabla \Phi }{\left|\nabla \Phi \right|}"),
        ("Φ_hol = n·ṙ₁", r"\Phi _{\mathrm{hol}}=n\cdot \dot{r}_{1}"),
    ],
)
def test_website_formulas_of_docstrings_become_latex(formula, expected):
    assert gallery.latex(formula) == expected
    assert "<merror" not in convert(gallery.latex(formula))


def test_website_words_and_open_brackets_are_not_formulas():
    for text in ("m over all bodies", "(x + y", "x in space", "x ? y"):
        with pytest.raises(gallery.Unreadable):
            gallery.latex(text)


def test_website_equations_are_found_within_a_text():
    text = "If I₁ = I₂, the rate (for k = 1) is Ω; `f(x = 1)` and E = a b hold [m]."
    typeset = gallery.inline(text).replace("\0", " ")
    assert typeset.startswith("If $I_{1}=I_{2}$, the rate (for $k=1$) is Ω; `f(x = 1)`")
    paragraph = "L = m/2 v²,  Φ = v₁,  q = (x, y), with x ahead."
    formulas, rest = gallery.display(paragraph)
    assert formulas.split("\n\n") == [
        r"$$L=\frac{m}{2} v^{2}$$",
        r"$$\Phi =v_{1},\qquad q=\left(x,\;y\right)$$",
    ]
    assert rest == "with x ahead."


def test_website_supported_versions_equal_package_metadata():
    python = PROJECT["requires-python"].removeprefix(">=")
    (jax,) = [x for x in PROJECT["dependencies"] if x.startswith("jax>=")]
    expected = f"needs Python {python} and JAX {jax.removeprefix('jax>=')}, or"
    assert expected in PAGES["start.md"]
    for classifier in PROJECT["classifiers"]:
        version = classifier.removeprefix("Programming Language :: Python :: 3.")
        if version.isdecimal():
            assert f"| 3.{version} |" in PAGES["start.md"]
