"""The pages without a test of their own run as printed, and assert what they say."""

from pathlib import Path

import pytest

from support.long import exhaustive_but
from support.pages import blocks, DOCS, page, run_page


PAGES = (
    *("index", "start", "constraints", "forces", "friction", "lie_groups", "theory"),
    *("systems", "events", "derivatives", "engines", "performance", "machines"),
    *("gallery", "robots", "step_sizes", "choosing"),
    *("first_calls", "recipe_controller", "recipe_fit", "recipe_million"),
    *("recipe_resume", "recipe_stability", "recipe_steer", "recipe_stop"),
    *("from_scipy", "from_diffrax", "from_pydy", "from_mujoco"),
)


@pytest.mark.usefixtures("closed_figures")
@pytest.mark.parametrize(
    "name", exhaustive_but(sorted({*PAGES} - {"machines", "robots"}), PAGES)
)
def test_guide_page_code_runs_as_printed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_page(name)


def test_guide_pages_with_code_are_all_tested():
    tests = "".join(
        path.read_text(encoding="utf-8") for path in Path(__file__).parent.rglob("*.py")
    )
    for name in (path.stem for path in DOCS.glob("*.md")):
        if blocks(page(name)) and name not in PAGES:
            assert f'page("{name}")' in tests, name
