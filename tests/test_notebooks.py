"""The notebooks run at small size, and are stored with the outputs of their code."""

import io
import json

import pytest
from PIL import Image

from docs import notebooks
from support.notebook_runs import FITS, NOTEBOOKS, run_notebook


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(NOTEBOOKS.keys() - FITS))
def test_notebook_runs_without_error(name, tmp_path):
    run_notebook(name, tmp_path)


@pytest.mark.parametrize("name", sorted(NOTEBOOKS))
def test_notebook_outputs_are_those_of_its_code(name):
    notebook = notebooks.read(name)
    assert notebook["metadata"] == {
        "kernelspec": {
            "display_name": "Python 3",
            "language": "python",
            "name": "python3",
        },
        "language_info": {"name": "python"},
        "nhjax": {"code": notebooks.code_hash(notebook)},
    }, f"the code was edited: run `python -m docs.notebooks {name}`"


@pytest.mark.parametrize("name", sorted(NOTEBOOKS))
def test_notebook_outputs_are_small_and_equal_in_each_run(name):
    notebook = notebooks.read(name)
    pictures = notebooks.figures(notebook)
    assert pictures
    for picture in pictures:
        assert len(picture) <= notebooks.LARGEST_FIGURE
        assert Image.open(io.BytesIO(picture)).info.keys() <= {"dpi", "transparency"}
    assert (
        len((notebooks.THUMBNAILS / f"{name}.png").read_bytes())
        <= notebooks.LARGEST_THUMBNAIL
    )
    for cell in notebook["cells"]:
        for output in cell.get("outputs", []):
            assert output.get("name") != "stderr"
            assert output["output_type"] != "error"
            assert output.get("data", {}).keys() <= {"image/png", "text/plain"}
            text = json.dumps(
                [output.get("text"), output.get("data", {}).get("text/plain")]
            )
            assert " at 0x" not in text
            assert "/tmp" not in text


def test_notebooks_page_lists_all_notebooks_as_they_are():
    names = [name for group in notebooks.GROUPS.values() for name in group]
    assert sorted(names) == sorted(NOTEBOOKS)
    written = (notebooks.DOCS / "notebooks.md").read_text(encoding="utf-8")
    assert written == notebooks.page(), "run `python -m docs.notebooks --text`"
