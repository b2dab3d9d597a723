"""Loops and branches whose lanes go different ways."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from nhjax.lanes import llvm_ir
from support import lanes_run
from support.lanes_samples import (
    assert_as_jax,
    count,
    MEMBERS,
    repeated,
    sample,
    WIDTHS,
)


@WIDTHS
def test_lanes_loop_that_members_leave_one_by_one_keeps_results(width):
    def function(times, x):
        return repeated(times, lambda k, x: jnp.sin(x) + k.astype(float), x)

    assert_as_jax(function, width, count(30), sample(3))


# Under `jax.vmap`, finished lanes keep running inner loops, and both sides of a branch
# run, so that JAX itself would never end here.


@WIDTHS
def test_lanes_inner_loop_of_finished_member_does_not_run(width):
    def function(times, x):
        def body(k, x):
            x = lax.while_loop(lambda y: (y > 1) | (k >= times), lambda y: y / 2, x)
            return x + 3

        return repeated(times, body, x)

    times, x = count(9), sample()
    expected = x.copy()
    for member in range(MEMBERS):
        for _ in range(times[member]):
            while expected[member] > 1:
                expected[member] /= 2
            expected[member] += 3
    got = lanes_run.run_batched(function, width, times, x)
    np.testing.assert_array_equal(got, expected)


@WIDTHS
def test_lanes_loop_in_branch_runs_for_members_of_the_branch(width):
    def function(p, x):
        def endless_elsewhere(x):
            return lax.while_loop(lambda y: (y < 50) | ~p, lambda y: y + 1, x)

        return lax.cond(p, endless_elsewhere, lambda x: x * 2, x)

    p, x = np.arange(MEMBERS) % 3 == 0, np.floor(sample())
    got = lanes_run.run_batched(function, width, p, x)
    np.testing.assert_array_equal(got, np.where(p, 50, x * 2))


@WIDTHS
def test_lanes_uniform_loop_in_branch_of_no_member_does_not_run(width):
    """All lanes share the loop's predicate, so that no mask could end the loop."""

    def function(p, x):
        def endless(x):
            return lax.while_loop(
                lambda s: s[0] < 9, lambda s: (s[0] * 2, s[1]), (0, x)
            )

        return lax.cond(p, endless, lambda x: (0, x * 2), x)

    x = sample()
    zeros, got = lanes_run.run_batched(function, width, np.zeros(MEMBERS, bool), x)
    np.testing.assert_array_equal(zeros, 0)
    np.testing.assert_array_equal(got, x * 2)


@WIDTHS
def test_lanes_uniform_value_after_divergent_loop_is_divergent(width):
    def function(times):
        return repeated(times, lambda k, x: x + k.astype(float), jnp.zeros(()))

    assert_as_jax(function, width, count(12))


def test_lanes_branch_with_uniform_predicate_is_a_jump():
    def function(p, x):
        return lax.cond(p, lambda x: jnp.sin(x), lambda x: jnp.exp(x), x)

    shapes = (jax.ShapeDtypeStruct((), bool), jax.ShapeDtypeStruct((), np.float64))
    program = jax.make_jaxpr(function)(*shapes)
    shared = llvm_ir(program, (False, True), 8)
    member = shared[shared.index("@member") : shared.index("@kernel")]
    assert "phi <8 x double>" in member
    assert "select <8 x i1>" not in member
    x = sample()
    for p in (False, True):
        got = lanes_run.run(program, [np.asarray(p), x], [False, True], 8)[0]
        np.testing.assert_allclose(got, np.sin(x) if p else np.exp(x), rtol=1e-15)
