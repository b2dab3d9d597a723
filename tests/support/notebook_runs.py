"""Running the notebooks of the repository."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient


NOTEBOOKS = {
    path.stem: path
    for path in sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
}
# Notebooks whose results are compared with the true values.
FITS = {"fitting", "learning_potential", "rattleback", "steering_unicycle"}


def run_notebook(name: str, folder: Path) -> list:
    """The outputs of the notebook `name`, at small size, run in `folder`."""
    notebook = nbformat.read(NOTEBOOKS[name], as_version=4)
    for cell in notebook.cells:
        # Only outputs of this run count.
        if cell.cell_type == "code":
            cell.outputs = []
    resources = {"metadata": {"path": str(folder)}}
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("NHJAX_SMALL", "1")
        # Of the flags of the tests, keep only the one that saves a third of the time.
        environment.delenv("XLA_FLAGS", raising=False)
        environment.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
        # The kernel chooses the backend that puts figures into the notebook.
        environment.delenv("MPLBACKEND", raising=False)
        NotebookClient(notebook, timeout=300, resources=resources).execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    kinds = {mime for out in outputs for mime in out.get("data", {})}
    assert "image/png" in kinds
    return outputs
