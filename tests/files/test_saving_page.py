"""The code of the page about results runs as printed."""

from support.pages import run_page


def test_saving_page_code_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = run_page("saving")
    assert namespace["whole"].ys.q.shape == (100, 4)
