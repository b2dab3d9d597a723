"""Every feature with the flags that users have: the other tests switch them off."""

import os
import subprocess
import sys

import pytest

from oracles import as_users_run


@pytest.fixture(scope="module")
def lines():
    """What a program of its own prints, which covers all features."""
    quick = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    environment = {key: x for key, x in os.environ.items() if key not in quick}
    done = subprocess.run(
        [sys.executable, as_users_run.__file__],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.splitlines()


@pytest.mark.parametrize("name", as_users_run.FEATURES)
def test_feature(name, lines):
    assert name in lines, next(line for line in lines if line.startswith(name))
