"""Lie groups: axioms, retractions, their tangents and duals."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._manifold import (
    AbstractLieGroup,
    Euclidean,
    SE2,
    SE3,
    SO3,
)
from support.group_samples import (
    batched,
    chart,
    compiled,
    directions,
    distance,
    elements,
    GROUPS,
    INSIDE,
    over,
    RETRACTIONS,
    seeded,
    SIMPLE,
    tau_of_matrix,
    vectors,
)


# The group


@over(GROUPS)
@seeded
def test_group_composition_satisfies_the_axioms(group, seed):
    g, h, k = (elements(group, seed + i) for i in range(3))
    left, right, neutral, nothing = _axioms(group)(g, h, k)
    assert distance(left, right) < 1e-14
    assert distance(neutral, g) < 1e-15
    identity = jax.vmap(lambda _: group.identity())(jnp.arange(16))
    assert distance(nothing, identity) < 1e-14


@cache
def _axioms(group):
    def axioms(g, h, k):
        gh_k = group.compose(group.compose(g, h), k)
        g_hk = group.compose(g, group.compose(h, k))
        neutral = group.compose(group.identity(), group.compose(g, group.identity()))
        return gh_k, g_hk, neutral, group.compose(g, group.inverse(g))

    return batched(axioms)


@over(GROUPS)
def test_group_matrix_of_a_product_is_the_product_of_matrices(group):
    g, h = elements(group, 1), elements(group, 2)
    product = batched(lambda g, h: group.matrix(group.compose(g, h)))(g, h)
    matrix = batched(group.matrix)
    assert distance(product, matrix(g) @ matrix(h)) < 1e-14


@over(GROUPS)
@seeded
def test_group_local_inverts_the_retraction(group, seed):
    # `local` returns the shorter rotation vector, whose angle is less than π.
    xi = vectors(group, [*INSIDE, 3.1], seed)
    assert distance(_round_trip(group)(xi), xi) < 1e-14


@cache
def _round_trip(group):
    return batched(lambda xi: group.local(group.retract(xi)))


@pytest.mark.parametrize("retraction", RETRACTIONS, ids=repr)
def test_group_local_of_opposite_quaternions_is_equal(retraction):
    group = SO3(retraction)
    q = group.retract(jnp.array([0.3, -0.5, 1.0]))
    assert distance(group.local(-q), group.local(q)) < 1e-15


@over(SIMPLE)
def test_group_retraction_agrees_with_the_matrix_function(group):
    xi = chart(group)
    matrix = batched(lambda x: group.matrix(group.retract(x)))(xi)
    hat = np.asarray(batched(group.hat)(xi))
    expected = np.stack([tau_of_matrix(group, X) for X in hat])
    assert distance(matrix, expected) < 1e-14


@over(SIMPLE)
def test_group_retraction_of_tiny_vectors_keeps_relative_accuracy(group):
    xi = 1e-200 * directions(group, range(4), 5)
    back = batched(lambda x: group.local(group.retract(x)))(xi)
    np.testing.assert_allclose(back, xi, rtol=1e-14)


# Tangents


@over(SIMPLE)
@seeded
def test_group_dtau_agrees_with_the_derivative_of_the_matrix(group, seed):
    xi = chart(group, seed)
    eta = directions(group, xi, seed + 1)
    hat = _hat(group)
    step = 1e-30
    tau = [
        tau_of_matrix(group, X + 1j * step * Y)
        for X, Y in zip(np.asarray(hat(xi)), np.asarray(hat(eta)), strict=True)
    ]
    expected = [np.linalg.solve(np.real(t), np.imag(t) / step) for t in tau]
    assert distance(hat(compiled(group, "dtau")(xi, eta)), np.stack(expected)) < 5e-14


@cache
def _hat(group):
    return batched(group.hat)


@over(GROUPS)
@seeded
def test_group_dtau_inv_inverts_dtau(group, seed):
    xi = chart(group, seed)
    eta = directions(group, xi, seed + 2)
    back = compiled(group, "dtau", "dtau_inv")(xi, eta)
    # dτ⁻¹ is large near the boundary of the chart.
    assert distance(back[: len(INSIDE)], eta[: len(INSIDE)]) < 1e-14
    assert distance(back, eta) < 1e-11


@over(GROUPS)
@seeded
def test_group_dtau_at_minus_xi_is_right_trivialised(group, seed):
    xi = chart(group, seed)
    eta = directions(group, xi, seed + 3)
    left, right = compiled(group, "dtau")(xi, eta), _right_trivialised(group)(xi, eta)
    assert distance(left, right) < 1e-13


@cache
def _right_trivialised(group):
    return batched(lambda x, y: group.Ad(group.retract(-x), group.dtau(-x, y)))


@over(GROUPS)
@seeded
def test_group_ddtau_agrees_with_the_derivative_of_dtau(group, seed):
    xi = vectors(group, INSIDE, seed)
    eta, delta = directions(group, xi, seed + 5), directions(group, xi, seed + 6)
    actual, expected = _second_tangents(group)(xi, eta, delta)
    assert distance(actual, expected) < 2e-14


@cache
def _second_tangents(group):
    def by_definition_and_by_differentiation(x, y, d):
        derivative = jax.jvp(lambda x: group.dtau(x, y), (x,), (d,))[1]
        return group.dtau(x, group.ddtau(x, y, d)), derivative

    return batched(by_definition_and_by_differentiation)


@over(GROUPS)
def test_group_tangent_agrees_with_the_derivative_of_act(group):
    g = elements(group, 3)
    eta = directions(group, range(16), 7)
    expected = batched(lambda g, y: AbstractLieGroup.tangent(group, g, y))(g, eta)
    assert distance(batched(group.tangent)(g, eta), expected) < 1e-14


@over(GROUPS)
def test_group_left_gradient_agrees_with_the_derivative_along_act(group):
    g = elements(group, 4)

    def function(g):
        return jnp.sum(jnp.sin(group.matrix(g)))

    def along(g):
        return jax.grad(lambda x: function(group.act(g, x)))(jnp.zeros(group.dim))

    actual = batched(lambda g: group.left_gradient(function, g))(g)
    assert distance(actual, batched(along)(g)) < 1e-14


@over([g for g in GROUPS if not isinstance(g, Euclidean)])
@seeded
def test_group_adjoint_maps_agree_with_matrices(group, seed):
    g = elements(group, seed)
    xi, eta = (directions(group, range(16), seed + k) for k in (8, 9))
    hat = _hat(group)
    X, Y, matrix = hat(xi), hat(eta), _matrix(group)(g)
    conjugate = matrix @ Y @ jnp.linalg.inv(matrix)
    assert distance(hat(compiled(group, "Ad")(g, eta)), conjugate) < 1e-13
    assert distance(hat(compiled(group, "ad")(xi, eta)), X @ Y - Y @ X) < 1e-14


@cache
def _matrix(group):
    return batched(group.matrix)


@over(GROUPS)
def test_group_covector_transport_agrees_with_the_adjoint_map(group):
    xi = chart(group, 3)
    mu = directions(group, range(len(xi)), 4)
    g = batched(group.retract)(xi)
    seen = batched(group.Ad_dual)(g, mu)
    assert distance(batched(group.to_end)(xi, mu), seen) < 1e-14
    assert distance(batched(group.to_end_change)(xi, mu), seen - mu) < 1e-14
    assert distance(batched(group.to_start)(xi, seen), mu) < 1e-13


@pytest.mark.parametrize("retraction", RETRACTIONS, ids=repr)
@pytest.mark.parametrize("kind", [SO3, SE2, SE3])
def test_group_covector_change_of_tiny_motions_keeps_accuracy(kind, retraction):
    group = kind(retraction)
    xi = 1e-9 * np.eye(group.dim)
    mu = directions(group, range(group.dim), 5)
    expected = batched(group.ad_dual)(xi, mu)
    np.testing.assert_allclose(
        batched(group.to_end_change)(xi, mu), expected, rtol=0, atol=2e-17
    )


@over(GROUPS)
@seeded
def test_group_dual_maps_are_transposes(group, seed):
    g = elements(group, seed)
    xi = vectors(group, np.linspace(0, 3, 16), seed + 10)
    eta, delta, mu = (directions(group, range(16), seed + 11 + i) for i in range(3))
    assert np.max(np.abs(_dual_defects(group)(g, xi, eta, delta, mu))) < 2e-13


@cache
def _dual_defects(group):
    def defects(g, x, y, d, m):
        return jnp.stack([
            group.Ad_dual(g, m) @ y - m @ group.Ad(g, y),
            group.ad_dual(x, m) @ y - m @ group.ad(x, y),
            group.dtau_dual(x, m) @ y - m @ group.dtau(x, y),
            group.dtau_inv_dual(x, m) @ y - m @ group.dtau_inv(x, y),
            group.ddtau_dual(x, y, m) @ d - m @ group.ddtau(x, y, d),
        ])  # fmt: skip

    return batched(defects)
