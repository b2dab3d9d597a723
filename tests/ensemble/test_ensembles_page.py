"""The page about ensembles keeps its word: its code runs as printed."""

from pathlib import Path

from oracles.pages import blocks


PAGE = Path(__file__).parents[2] / "docs" / "ensembles.md"


def test_the_code_of_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for block in blocks(PAGE.read_text(encoding="utf-8")):
        exec(compile(block, PAGE.name, "exec"), namespace)
    assert namespace["again"].values.ys.q.shape == (1, 1, 7)
