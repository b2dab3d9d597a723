"""A short test of every feature, with the flags of users and all shapes checked.

The other tests switch the compiler's optimisation off, and do not check annotations.
The checks act while programs are traced, and do not change the programs.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support import as_users_run, with_shapes


pytestmark = pytest.mark.long


QUICK = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
# Warnings are errors, except those that older releases of Zarr emit when imported.
WARNINGS = ("-W", "error", "-W", "default::DeprecationWarning:numcodecs")


@pytest.fixture(scope="module")
def lines():
    """The lines that a separate program prints; it runs all features."""
    env = {key: x for key, x in os.environ.items() if key not in QUICK}
    path = [str(Path(__file__).parent), env.get("PYTHONPATH", "")]
    env |= {"PYTHONPATH": os.pathsep.join(filter(None, path)), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, *WARNINGS, "-m", with_shapes.__name__],
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize("name", as_users_run.FEATURES)
def test_feature_runs_with_user_flags_and_checked_shapes(name, lines):
    assert name in lines, [line for line in lines if line.startswith(f"{name}:")]
