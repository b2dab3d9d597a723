"""The gallery on groups and with holonomic constraints against an independent oracle.

The oracle is the index-reduced ODE, by SciPy, with brackets and tangents of the groups
written out there.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from nhjax._manifold import Cayley, Exponential
from nhjax.systems import (
    FreeRigidBody,
    HeavyTop,
    HeavyTopSE3,
    RollingDisc,
    Suslov,
    TurntableBall,
    Unicycle,
    Veselova,
)
from support.group_gallery import (
    assert_close,
    GALLERY,
    KINDS,
    over,
    SOLVED,
    UNSOLVED,
)
from support.group_oracle import (
    acceleration_and_multiplier,
    constraints_of,
    oracle,
    velocity_of,
)


@over(SOLVED)
def test_exact_solution_starts_at_the_initial_data(example):
    q, v, multiplier = example.exact(0.0)
    assert_close(q, example.q0, rtol=0, atol=5e-16)
    np.testing.assert_allclose(v, example.v0, rtol=0, atol=2e-15)
    expected = acceleration_and_multiplier(example.system, example.q0, example.v0)[1]
    np.testing.assert_allclose(multiplier, expected, rtol=1e-13, atol=1e-14)


@over(SOLVED)
@pytest.mark.parametrize("t", [3.0, -1.0])
def test_exact_solution_agrees_with_the_index_reduced_ode(example, t):
    expected = oracle(example, t)[:3]
    assert_close(example.exact(t), expected, rtol=1e-11, atol=1e-11)


@over(SOLVED)
def test_exact_velocity_equals_derivative_of_exact_position(example):
    # A long time, where quadratures and linear flows take many panels.
    t, h = 40.0, 1e-3
    q = {k: ravel_pytree(example.exact(t + k * h)[0])[0] for k in (-2, -1, 1, 2)}
    slope = (8 * (q[1] - q[-1]) - (q[2] - q[-2])) / (12 * h)
    q, v, _ = jax.tree.map(jnp.asarray, example.exact(t))
    expected, _ = ravel_pytree(velocity_of(example.system.manifold, q, v))
    np.testing.assert_allclose(slope, expected, rtol=1e-9, atol=1e-9)


@over(SOLVED)
def test_invariants_are_constant_along_the_exact_solution(example):
    start = example.invariants(0.0, example.q0, example.v0)
    q, v, _ = jax.tree.map(jnp.asarray, example.exact(40.0))
    for name, value in example.invariants(0.0, q, v).items():
        assert value == pytest.approx(float(start[name]), rel=1e-11, abs=1e-11), name


@over(UNSOLVED)
def test_invariants_are_constant_along_the_motion(example):
    _, _, _, states = oracle(example, np.linspace(0.0, 3.0, 4))
    start = example.invariants(0.0, *states[0])
    assert start
    for q, v in states[1:]:
        for name, value in example.invariants(0.0, q, v).items():
            expected = pytest.approx(float(start[name]), rel=1e-11, abs=1e-11)
            assert value == expected, name


@over(GALLERY)
def test_initial_data_satisfy_the_constraints(example):
    violations = constraints_of(example.system, example.q0, example.v0)
    np.testing.assert_allclose(jnp.concatenate(violations), 0.0, rtol=0, atol=5e-16)


@over(KINDS)
def test_initial_state_has_the_multiplier_of_the_continuous_system(example):
    y0 = example.initial_state()
    expected = acceleration_and_multiplier(example.system, example.q0, example.v0)[1]
    np.testing.assert_allclose(y0.multiplier, expected, rtol=1e-12, atol=1e-13)


@over(KINDS)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_system_computes_in_precision_of_the_state(example, dtype):
    system = example.system
    q, v = jax.tree.map(lambda x: x.astype(dtype), (example.q0, example.v0))
    t = jnp.zeros((), dtype)
    assert system.lagrangian(t, q, v, None).dtype == dtype
    if system.nonholonomic is not None:
        assert system.nonholonomic(t, q, v, None).dtype == dtype
    if system.holonomic is not None:
        assert system.holonomic(t, q, None).dtype == dtype
    for value in example.invariants(t, q, v).values():
        assert value.dtype == dtype


@over(KINDS)
def test_gradients_in_parameters_are_finite(example):
    q, v = example.q0, 0.9 * example.v0

    def value(system):
        constraints = jnp.concatenate(constraints_of(system, q, v))
        return system.lagrangian(0.0, q, v, None) + jnp.sum(constraints)

    leaves = jax.tree.leaves(jax.grad(value)(example.system))
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in leaves)
    # The first parameter is a mass, a radius or moments of inertia.
    assert jnp.any(leaves[0] != 0)


@over(KINDS)
def test_parameters_are_leaves_of_the_system(example):
    assert len(jax.tree.leaves(example)) <= len(jax.tree.leaves(example.system))


@pytest.mark.parametrize("retraction", [Cayley(), Exponential()])
@pytest.mark.parametrize(
    "kind",
    [
        Unicycle,
        TurntableBall,
        Suslov,
        Veselova,
        RollingDisc,
        FreeRigidBody,
        HeavyTop,
        HeavyTopSE3,
    ],
)
def test_retraction_of_a_group_example_is_set_in_its_manifold(kind, retraction):
    manifold = kind(retraction=retraction).system.manifold
    factors = getattr(manifold, "factors", (manifold,))
    assert factors[0].retraction == retraction
