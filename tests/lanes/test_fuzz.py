"""Random programs in lanes, against the same programs in JAX, number by number.

JAX runs them one operation after the other, so that nothing is fused or reordered, and
the results have to be equal to the last bit, except for the sign of a NaN. To run
thousands: `NHJAX_FUZZ=5000 pytest tests/lanes/test_fuzz.py`.
"""

import os
import sys

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, strategies as st

from nhjax.lanes import _builder
from support import lanes_run
from support.random_programs import programs
from support.random_steps import evaluate, numbers


EXAMPLES = int(os.environ.get("NHJAX_FUZZ", "100"))
MEMBERS = 6


def assert_identical(got, expected, name):
    assert got.dtype == expected.dtype
    assert got.shape == expected.shape
    if got.dtype.kind == "f":
        is_nan = np.isnan(expected)
        np.testing.assert_array_equal(np.isnan(got), is_nan, err_msg=name)
        bits = f"int{8 * got.dtype.itemsize}"
        got, expected = (np.where(is_nan, 0, x).view(bits) for x in (got, expected))
    np.testing.assert_array_equal(got, expected, err_msg=name)


def fuzzed(examples):
    """Make a test of a function that is given programs with their data."""
    settings = hypothesis.settings(
        max_examples=examples,
        deadline=None,
        derandomize="NHJAX_FUZZ" not in os.environ,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    given = hypothesis.given(
        programs(),
        st.integers(0, 2**32),
        st.sampled_from((1, 4, 8)),
        st.lists(st.booleans(), min_size=6, max_size=6),
    )
    return lambda test: settings(given(test))


def compare(program, seed, width, batched):
    kinds, steps = program
    # At least one operand has the members.
    is_batched = [True, *batched][: len(kinds)]
    operands = [numbers(kind, MEMBERS, seed + i) for i, kind in enumerate(kinds)]
    operands = [x if b else x[0] for x, b in zip(operands, is_batched, strict=True)]

    def function(*values):
        return evaluate(steps, list(values))[len(kinds) :]

    axes = [0 if b else None for b in is_batched]
    with jax.disable_jit():
        expected = jax.vmap(function, in_axes=axes)(*map(jnp.asarray, operands))
    shapes = [jax.ShapeDtypeStruct(kind.shape, kind.dtype) for kind in kinds]
    closed = jax.make_jaxpr(function)(*shapes)
    got = lanes_run.run(closed, operands, is_batched, width, contract=False)
    names = [step.name for step in steps for _ in step.kinds]
    for name, one, other in zip(names, got, expected, strict=True):
        assert_identical(one, np.asarray(other), name)


@pytest.mark.long
@fuzzed(EXAMPLES)
def test_random_program_in_lanes_equals_jax(program, seed, width, batched):
    compare(program, seed, width, batched)


@pytest.mark.long
@fuzzed(max(EXAMPLES // 4, 1))
def test_lanes_random_program_with_arrays_in_memory_equals_jax(
    program, seed, width, batched
):
    names = [name for name in sys.modules if name.startswith("nhjax.lanes.")]
    with pytest.MonkeyPatch.context() as patch:
        # With this limit, nearly all arrays count as large and are copied in loops.
        patch.setattr(_builder, "_LONGEST_UNROLLED", 1)
        for name in names:
            if hasattr(sys.modules[name], "MOST_IN_REGISTERS"):
                patch.setattr(sys.modules[name], "MOST_IN_REGISTERS", 1)
        compare(program, seed, width, batched)
