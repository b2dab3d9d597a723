"""Arrays in memory, operands and results, in lanes that go different ways."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from support import lanes_run
from support.lanes_samples import (
    assert_as_jax,
    count,
    MEMBERS,
    repeated,
    sample,
    WIDTHS,
)


# Memory


@WIDTHS
def test_lanes_masked_store_leaves_other_members_unchanged(width):
    def function(times, x):
        rows = jnp.full((60, 3), jnp.nan)
        return repeated(
            times, lambda k, rows: rows.at[k].set(x * k.astype(float)), rows
        )

    assert_as_jax(function, width, count(60), sample(3))


@WIDTHS
def test_lanes_stores_in_branches_change_only_members_of_the_branch(width):
    def function(p, i, x):
        x = repeated(3, lambda k, x: x.at[k + i].add(1.0), x)
        x = lax.cond(p, lambda x: x.at[i].set(7.0), lambda x: x.at[i + 1].mul(3.0), x)
        return x, x[i]

    assert_as_jax(function, width, np.arange(MEMBERS) % 2 == 0, count(4), sample(9))


@WIDTHS
def test_lanes_scatter_with_function_applies_it_at_an_index(width):
    def function(i, x):
        x = x.at[1].apply(jnp.sin)
        x = x.at[jnp.stack([i, i + 1])].apply(lambda x: 2 * x + 1, mode="drop")
        # Twice at the same place.
        return x.at[jnp.stack([i, i])].apply(jnp.cos, mode="clip")

    assert_as_jax(function, width, count(6), sample(4))


@WIDTHS
def test_lanes_reduction_of_many_numbers_in_memory_is_a_loop(width):
    def function(i, x):
        rows = lax.dynamic_update_index_in_dim(jnp.ones((2500, 2)), x, i, 0)
        once = jnp.sum(rows), jnp.max(rows)
        # The first number changes after the sum.
        return *once, jnp.sum(rows.at[0, 0].add(x[1]))

    assert_as_jax(function, width, 500 * count(5), sample(2))


@WIDTHS
def test_lanes_array_updated_twice_keeps_both_versions(width):
    def function(i, x):
        changed = x.at[i].set(7.0)
        again = changed.at[i + 1].set(8.0)
        return x, changed, again, changed[i] + again[i + 1] + x[i]

    assert_as_jax(function, width, count(4), sample(9))


@WIDTHS
def test_lanes_array_used_after_loop_is_not_changed_by_it(width):
    def function(x):
        def body(k, state):
            old, new = state
            return new, old.at[k].set(new[k + 1] * 2)

        start = (x, x)
        for _ in range(2):
            start = repeated(8, body, start)
        return x, start

    assert_as_jax(function, width, sample(300))


@WIDTHS
def test_lanes_arrays_swapped_in_loop_keep_their_values(width):
    def function(times, x, y):
        def body(k, state):
            x, y, z = state
            return y.at[k].set(1.0), z.at[k].add(2.0), x

        return repeated(times, body, (x, y, x))

    assert_as_jax(function, width, count(7), sample(9), sample(9, seed=1))


@WIDTHS
def test_lanes_scan_rows_of_changing_array_keep_their_values(width):
    def function(i, x):
        def step(x, k):
            return x.at[k + i].add(1.0), x

        return lax.scan(step, x, jnp.arange(12)), lax.scan(step, x, jnp.arange(4))

    assert_as_jax(function, width, count(3), sample(20))


@WIDTHS
def test_lanes_large_arrays_in_loops_are_copied(width):
    def function(i, x):
        whole = jnp.concatenate([x, x[::-1] * 2, jnp.zeros((3, 60))])
        part = lax.dynamic_slice(whole, (i, i), (4, 50)).T
        padded = lax.pad(part, x[0, 0], [(1, 0, 1), (-2, 3, 0)])
        return padded, jnp.where(whole > 0, whole, -whole), whole[2:, ::3]

    assert_as_jax(function, width, count(9), sample(4, 60))


@WIDTHS
def test_lanes_constant_array_at_divergent_index_is_read(width):
    table = np.sin(np.linspace(0, 3, 400))

    def function(i, x):
        at_random = jnp.asarray(table)[i % 400]
        return jnp.interp(x, jnp.linspace(-3, 3, 50), table[:50]), at_random, x[i % 5]

    assert_as_jax(function, width, count(500), sample(5))


# Operands and results


@WIDTHS
def test_lanes_shared_operands_in_memory_are_read(width):
    def function(x, table, i):
        return jnp.asarray(table)[i] + x, table, x * table.sum()

    shapes = [jax.ShapeDtypeStruct(s, np.float64) for s in ((3,), (9, 3))]
    program = jax.make_jaxpr(function)(*shapes, jax.ShapeDtypeStruct((), np.int64))
    x, table, i = sample(3), sample(9, 3)[0], count(9)
    expected = jax.vmap(function, in_axes=(0, None, 0))(x, table, i)
    got = lanes_run.run(program, [x, table, i], [True, False, True], width)
    for one, other in zip(got, expected, strict=True):
        other = np.broadcast_to(other, one.shape)
        np.testing.assert_allclose(one, other, rtol=1e-14)


@WIDTHS
def test_lanes_operand_that_is_a_result_is_copied(width):
    def function(x, y, z):
        return y, x, x, z, z.at[3].set(1.0)

    assert_as_jax(function, width, sample(3), sample(2, 2), sample(300))


@WIDTHS
def test_lanes_arrays_without_elements_in_memory_equal_jax(width):
    def function(x):
        nothing = x[:0]
        carry, rows = lax.scan(lambda c, y: (c + y, c), x, jnp.zeros((0, 3)))
        table = repeated(2, lambda k, n: n * 2, nothing)
        return (
            nothing,
            jnp.sum(nothing),
            jnp.concatenate([nothing, x]),
            carry,
            rows,
            table,
        )

    assert_as_jax(function, width, sample(3))


@WIDTHS
def test_lanes_scratch_memory_larger_than_stack_is_allocated(width):
    def function(i, x):
        rows = jnp.zeros((3000, 3))
        rows = repeated(40, lambda k, rows: rows.at[i + k].set(x), rows)
        return rows[i + 7], jnp.stack([rows[2999], rows[i]])

    assert_as_jax(function, width, count(2000), sample(3))
