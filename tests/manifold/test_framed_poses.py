"""Framed poses: planar poses with the sine and cosine of their angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._manifold import (
    Cayley,
    Euclidean,
    Exponential,
    framed,
    is_framed,
    ProductGroup,
    SE2,
    SO3,
    unframed,
)
from nhjax._manifold._planar_groups import FramedPose


XI = jnp.array([0.7, -0.3, 0.9])
POSE = jnp.array([1.3, -0.4, 2.2])
with_retractions = pytest.mark.parametrize(
    "group", [SE2(Cayley()), SE2(Exponential())], ids=["cayley", "exponential"]
)


def assert_frame_belongs_to_angle(g):
    assert isinstance(g, FramedPose)
    np.testing.assert_allclose(g.cos, np.cos(g.pose[2]), rtol=0, atol=5e-16)
    np.testing.assert_allclose(g.sin, np.sin(g.pose[2]), rtol=0, atol=5e-16)


@with_retractions
@pytest.mark.parametrize("size", [1e-9, 0.1, 1.0, 2.5])
def test_group_framed_pose_after_act_has_the_frame_of_its_angle(group, size):
    moved = group.act(framed(group, POSE), size * XI)
    np.testing.assert_allclose(moved.pose, group.act(POSE, size * XI), atol=1e-15)
    assert_frame_belongs_to_angle(moved)
    back = group.act_back(moved, size * XI)
    np.testing.assert_allclose(back.pose, POSE, rtol=0, atol=2e-15)
    assert_frame_belongs_to_angle(back)


@with_retractions
def test_group_framed_pose_tangent_equals_its_derivative(group):
    place, eta = framed(group, POSE), jnp.array([0.2, 0.5, -1.1])
    tangent = group.tangent(place, eta)
    np.testing.assert_allclose(tangent.pose, group.tangent(POSE, eta), atol=1e-15)
    _, rate = jax.jvp(lambda x: group.act(place, x), (jnp.zeros(3),), (eta,))
    for ours, derived in zip(*map(jax.tree.leaves, (tangent, rate)), strict=True):
        np.testing.assert_allclose(ours, derived, rtol=0, atol=1e-15)


@with_retractions
def test_group_framed_pose_left_gradient_equals_pose_gradient(group):
    def function(q):
        x, y, angle = unframed(q)
        return x**2 * jnp.sin(angle) + y * jnp.cos(2 * angle)

    plain = group.left_gradient(function, POSE)
    found = group.left_gradient(function, framed(group, POSE))
    np.testing.assert_allclose(found, plain, rtol=0, atol=2e-15)


def test_group_product_with_framed_poses_replaces_each_pose():
    group = ProductGroup(SO3(), ProductGroup(SE2(), Euclidean(2)))
    xi = jnp.linspace(-0.4, 0.5, group.dim)
    q = (jnp.array([0.6, 0.0, 0.8, 0.0]), (POSE, jnp.array([0.1, 0.2])))
    place = framed(group, q)
    assert [is_framed(x) for x in (place[0], *place[1])] == [False, True, False]
    for name in ("act", "act_back"):
        plain = getattr(group, name)(q, xi)
        found = unframed(getattr(group, name)(place, xi))
        for ours, theirs in zip(*map(jax.tree.leaves, (found, plain)), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-15)


def test_group_element_without_planar_poses_is_unchanged_by_framing():
    q = jnp.array([0.6, 0.0, 0.8, 0.0])
    assert framed(SO3(), q) is q
    assert unframed(q) is q
