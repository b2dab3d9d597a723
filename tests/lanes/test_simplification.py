"""What a kernel leaves out, and what it may not leave out."""

import jax
import jax.numpy as jnp
import numpy as np

from nhjax.lanes import llvm_ir
from support import lanes_run
from support.lanes_samples import (
    repeated,
)


def test_lanes_product_with_zero_of_data_keeps_nan():
    def function(x):
        return x * 0.0, x - x, 0.0 / x, x + 0.0

    x = np.array([np.nan, np.inf, -np.inf, -0.0, 2.0])
    with np.errstate(all="ignore"):
        expected = function(x)
    for got, other in zip(lanes_run.run_batched(function, 4, x), expected, strict=True):
        np.testing.assert_array_equal(got, other)
        signs = np.signbit(got[~np.isnan(got)]), np.signbit(other[~np.isnan(other)])
        np.testing.assert_array_equal(*signs)


def test_lanes_product_with_structural_zero_is_removed():
    def function(x):
        return jnp.pad(x, (1, 1)) * jnp.concatenate([x, x])[:5] + jnp.zeros(5)

    program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((3,), np.float64))
    text = llvm_ir(program, (True,), 8)
    assert text.count("fmul") == 3
    assert text.count("fadd") == 0


def test_lanes_unused_operations_are_removed():
    def function(x):
        unused = repeated(5, lambda k, y: jnp.sin(y), x)
        return x * 2, (unused, x)[1]

    program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((3,), np.float64))
    text = llvm_ir(program, (True,), 8)
    assert "phi" not in text
    assert "nhjax.sin" not in text


def test_lanes_loop_invariant_operations_are_hoisted():
    def function(x):
        return repeated(5, lambda k, y: y + jnp.sin(x), x)

    program = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((), np.float64))
    lines = llvm_ir(program, (True,), 8).splitlines()
    call = next(i for i, line in enumerate(lines) if "call" in line and "sin" in line)
    loop = next(i for i, line in enumerate(lines) if "phi" in line)
    assert call < loop


def test_lanes_nested_loops_are_built_in_linear_time():
    """A loop is built again, but once, if a number turns out not to be constant."""
    depth, made = 6, []

    def nested(level, x):
        if level == 0:
            made.append(1)
            return x + 1.0
        return repeated(9, lambda k, y: nested(level - 1, y), x)

    program = jax.make_jaxpr(lambda x: nested(depth, jnp.zeros(())) + x)(1.0)
    text = llvm_ir(program, (True,), 4)
    assert text.count("phi double") == depth
    # Dropped numbers leave gaps.
    assert int(text.split("%v")[-1].split()[0].strip(",")) < 400
