"""The page about ensembles keeps its word: its code runs as printed."""

from oracles.pages import run_page


def test_the_code_of_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page("ensembles")
    assert namespace["again"].values.ys.q.shape == (1, 1, 7)
