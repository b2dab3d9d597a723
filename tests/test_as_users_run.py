"""Every feature in brief, with the flags of users and with all shapes checked.

The other tests switch the compiler's optimisation off, and take annotations on trust.
The checks act while programs are traced, and leave the programs as they are.
"""

import os
import subprocess
import sys

import pytest

from oracles import as_users_run, shapes


pytestmark = pytest.mark.long


QUICK = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")


@pytest.fixture(scope="module")
def lines():
    """The lines that a program of its own prints, which runs all features."""
    done = subprocess.run(
        [sys.executable, shapes.__file__],
        env={key: x for key, x in os.environ.items() if key not in QUICK},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.parametrize("name", as_users_run.FEATURES)
def test_a_feature_with_flags_of_users_and_shapes_checked(name, lines):
    assert name in lines, [line for line in lines if line.startswith(f"{name}:")]
