"""The code of the page about ensembles runs as printed."""

from support.pages import run_page


def test_ensemble_page_code_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page("ensembles")
    assert namespace["again"].values.ys.q.shape == (1, 1, 7)
