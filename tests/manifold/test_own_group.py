"""A user's own group: seven methods; all others follow by differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._manifold import AbstractLieGroup, ProductGroup, SO3
from support.long import long
from support.own_groups import (
    Heisenberg,
    SL2,
)


XI, ETA, DELTA, MU = (
    jnp.asarray(v) for v in np.random.default_rng(0).normal(size=(4, 3))
)


def close(a, b):
    np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)


def test_own_group_heisenberg_maps_agree_with_closed_forms():
    group = Heisenberg()
    bracket = jnp.array([0.0, 0.0, XI[0] * ETA[1] - XI[1] * ETA[0]])
    close(group.ad(XI, ETA), bracket)
    close(group.Ad(XI, ETA), ETA + bracket)
    close(group.dtau(XI, ETA), ETA - 0.5 * bracket)
    close(group.dtau_inv(XI, ETA), ETA + 0.5 * bracket)
    other = jnp.array([0.0, 0.0, DELTA[0] * ETA[1] - DELTA[1] * ETA[0]])
    close(group.ddtau(XI, ETA, DELTA), -0.5 * other)
    close(group.tangent(XI, ETA), ETA + 0.5 * bracket)


def test_own_group_sl2_tangents_agree_with_matrices():
    group = SL2()
    X, Y, one = group.hat(XI), group.hat(ETA), jnp.eye(2)
    g = group.act(group.retract(DELTA), XI)
    close(jnp.linalg.det(g), 1)
    close(group.local(group.retract(XI)), XI)
    close(group.retract(XI), jnp.linalg.solve(one - X / 2, one + X / 2))
    close(group.hat(group.ad(XI, ETA)), X @ Y - Y @ X)
    close(group.hat(group.Ad(g, ETA)), g @ Y @ jnp.linalg.inv(g))
    expected = jnp.linalg.inv(one + X / 2) @ Y @ jnp.linalg.inv(one - X / 2)
    close(group.hat(group.dtau(XI, ETA)), expected)
    close(group.hat(group.dtau_inv(XI, ETA)), (one + X / 2) @ Y @ (one - X / 2))
    close(group.tangent(g, ETA), g @ Y)


@pytest.mark.parametrize(
    "group", [Heisenberg(), long(SL2())], ids=["Heisenberg", "SL2"]
)
def test_own_group_derived_maps_are_consistent(group):
    g = group.retract(DELTA)
    slope = jax.jvp(lambda x: group.dtau(x, ETA), (XI,), (DELTA,))[1]
    second = group.ddtau(XI, ETA, DELTA)
    close(group.dtau(XI, second), slope)
    close(group.ddtau_dual(XI, ETA, MU) @ DELTA, MU @ second)
    close(group.dtau_dual(XI, MU) @ ETA, MU @ group.dtau(XI, ETA))
    close(group.dtau_inv_dual(XI, MU) @ ETA, MU @ group.dtau_inv(XI, ETA))
    close(group.Ad_dual(g, MU) @ ETA, MU @ group.Ad(g, ETA))
    close(group.ad_dual(XI, MU) @ ETA, MU @ group.ad(XI, ETA))
    at_end = group.to_end(DELTA, MU)
    close(at_end @ ETA, MU @ group.Ad(g, ETA))
    close(group.to_end_change(DELTA, MU), at_end - MU)
    close(group.to_start(DELTA, at_end), MU)

    def function(q):
        return jnp.sum(jnp.sin(q))

    along = jax.grad(lambda x: function(group.act(g, x)))(jnp.zeros(3))
    close(group.left_gradient(function, g), along)


def test_own_group_advance_returns_compensation_unchanged():
    group = SL2()
    q, compensation = group.advance(
        group.identity(), XI, group.no_compensation(jnp.eye(2))
    )
    close(q, group.retract(XI))
    close(compensation, jnp.zeros((2, 2)))
    assert not group.is_flat
    assert group.in_chart(XI)
    close(group.distance_to_group(q), 0)
    close(group.normalise(q), q)


def test_own_group_in_a_product_group_works_as_factor():
    group = ProductGroup(SO3(), SL2())
    xi = jnp.concatenate([XI, ETA])
    close(group.local(group.retract(xi)), xi)
    close(group.dtau(xi, group.dtau_inv(xi, xi[::-1])), xi[::-1])


def test_own_group_without_matrix_raises_saying_what_to_define():
    with pytest.raises(NotImplementedError, match=r"define `Heisenberg\.matrix`"):
        Heisenberg().matrix(XI)
    with pytest.raises(NotImplementedError, match=r"define `Heisenberg\.hat`"):
        Heisenberg().hat(XI)


def test_own_group_with_missing_methods_raises_naming_them():
    class Unfinished(AbstractLieGroup):
        pass

    with pytest.raises(TypeError, match="compose"):
        Unfinished()  # pyright: ignore[reportAbstractUsage]
