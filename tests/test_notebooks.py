"""The notebooks run from top to bottom, at small size."""

import pytest

from support.notebook_runs import FITS, NOTEBOOKS, run_notebook


pytestmark = pytest.mark.long


@pytest.mark.parametrize("name", sorted(NOTEBOOKS.keys() - FITS))
def test_notebook_runs_without_error(name, tmp_path):
    run_notebook(name, tmp_path)
