"""The notebooks run from top to bottom, at small size."""

import pytest
from notebook_runs import NOTEBOOKS, run_notebook
from test_fitting import FITS


@pytest.mark.parametrize("name", sorted(NOTEBOOKS.keys() - FITS))
def test_notebook(name, tmp_path):
    run_notebook(name, tmp_path)
