"""Every feature in brief, as users run it, and once more with all shapes checked.

The other tests switch the compiler's optimisation off, and take annotations on trust.
"""

import os
import subprocess
import sys

import pytest

from oracles import as_users_run, shapes


QUICK = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")


def printed(program, **environment):
    """The lines that a program of its own prints, which runs all features."""
    others = {key: x for key, x in os.environ.items() if key not in QUICK}
    done = subprocess.run(
        [sys.executable, program.__file__],
        env=others | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture(scope="module")
def with_flags_of_users():
    return printed(as_users_run)


@pytest.fixture(scope="module")
def with_shapes_checked():
    flags = os.environ.get("XLA_FLAGS", "")
    return printed(shapes, XLA_FLAGS=flags, JAX_DISABLE_MOST_OPTIMIZATIONS="1")


def assert_holds(name, lines):
    assert name in lines, [line for line in lines if line.startswith(f"{name}:")]


@pytest.mark.parametrize("name", as_users_run.FEATURES)
def test_a_feature_with_the_flags_of_users(name, with_flags_of_users):
    assert_holds(name, with_flags_of_users)


@pytest.mark.parametrize("name", as_users_run.FEATURES)
def test_a_feature_with_shapes_checked(name, with_shapes_checked):
    assert_holds(name, with_shapes_checked)
