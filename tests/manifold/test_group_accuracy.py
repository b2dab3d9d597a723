"""Accuracy of the Lie groups: derivatives, long products, single precision."""

from math import pi

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from nhjax._manifold import (
    Cayley,
    Euclidean,
    Exponential,
    ProductGroup,
    SE2,
    SE3,
    SO2,
    SO3,
)
from nhjax._manifold._retraction import arctan_ratio, stumpff
from support.group_samples import (
    batched,
    directions,
    distance,
    elements,
    GROUPS,
    INSIDE,
    MIXED,
    over,
    RETRACTIONS,
    SIMPLE,
    vectors,
)


# Derivatives of the tangents, against 60 digits


def exact_hat(group, vector):
    matrix = np.asarray(group.hat(jnp.asarray(vector)))
    return np.vectorize(mp.mpf, otypes=[object])(matrix)


def exact_dtau(group, X, Y):
    """dτ on matrices: Σ (-ad)^k/(k+1)!, or (I + X/2)⁻¹ Y (I - X/2)⁻¹ for Cayley."""
    if isinstance(group.retraction, Cayley):
        n = len(X)
        plus, minus = (mp.eye(n) + s * mp.matrix(X) / 2 for s in (1, -1))
        product = plus**-1 * mp.matrix(Y) * minus**-1
        return np.array(product.tolist(), dtype=object)
    total, term = Y, Y
    for k in range(1, 90):
        term = -(X.dot(term) - term.dot(X)) / (k + 1)
        total = total + term
    return total


@over([g for g in SIMPLE if not isinstance(g, SO2)])
def test_group_dtau_and_its_derivatives_are_accurate_to_round_off(group):
    xi = vectors(group, [0.0, *INSIDE[1:4], *INSIDE[6:], 5.0], 14)
    eta, delta = directions(group, xi, 15), directions(group, xi, 16)

    def jet(x, y, d):
        def first(x):
            return jax.jvp(lambda x: group.dtau(x, y), (x,), (d,))

        (value, slope), (_, curvature) = jax.jvp(first, (x,), (d,))
        return [group.hat(value), group.hat(slope), group.hat(curvature)]

    actual = batched(jet)(xi, eta, delta)
    with mp.workdps(60):
        h = mp.mpf(10) ** -15
        for i in range(len(xi)):
            X, Y, D = (exact_hat(group, v[i]) for v in (xi, eta, delta))
            low, mid, high = (exact_dtau(group, X + k * h * D, Y) for k in (-1, 0, 1))
            exact = [mid, (high - low) / (2 * h), (high - 2 * mid + low) / h**2]
            for value, expected in zip(actual, exact, strict=True):
                assert distance(value[i], expected.astype(float)) < 1e-14


@pytest.mark.parametrize("s", [0.0, 1e-300, 1e-16, 0.5, 1.999999, 2.0, 9.0, 39.0])
def test_stumpff_functions_and_derivatives_are_accurate_to_round_off(s):
    n = 4

    def value(s):
        return stumpff(jnp.asarray(s), n)

    def third(s):
        return jax.jacfwd(jax.jacrev(jax.jacfwd(value)))(s)

    def exact(k, order):
        # j (j - 1) ... (j - order + 1) s^(j - order), in a form that is valid at s = 0.
        return mp.nsum(
            lambda j: (
                (-1) ** (int(j) + order)
                * mp.rf(j + 1, order)
                * mp.mpf(s) ** int(j)
                / mp.factorial(2 * (j + order) + k)
            ),
            [0, 60],
        )

    with mp.workdps(50):
        for order, function in ((0, value), (3, third)):
            expected = [float(exact(k, order)) for k in range(n)]
            np.testing.assert_allclose(function(s), expected, rtol=0, atol=3e-16)


@pytest.mark.parametrize("x", [0.0, 1e-300, 1e-8, 0.3, 1.0])
def test_arctan_ratio_and_second_derivative_are_accurate(x):
    def exact(x):
        root = mp.sqrt(x)
        return mp.mpf(1) if x == 0 else mp.atan(root) / root

    second = jax.grad(jax.grad(arctan_ratio))(x)
    with mp.workdps(40):
        # At zero Σ (-x)^j/(2j + 1) gives 2/5.
        expected = mp.diff(exact, x, 2) if x > 1e-3 else mp.mpf(2) / 5 - 6 * x / 7
        np.testing.assert_allclose(arctan_ratio(x), float(exact(x)), rtol=3e-16)
        np.testing.assert_allclose(second, float(expected), rtol=2e-14)


@over([g for g in SIMPLE if not isinstance(g, SO2)])
def test_group_second_derivatives_at_the_identity_are_exact(group):
    eta, delta = directions(group, range(2), 17)
    zero = jnp.zeros(group.dim)
    D, Y = (np.asarray(group.hat(v)) for v in (delta, eta))

    def bracket(a, b):
        return a @ b - b @ a

    if isinstance(group.retraction, Exponential):
        expected = bracket(D, bracket(D, Y)) / 3
    else:
        expected = (bracket(D, bracket(D, Y)) + D @ Y @ D) / 2
    # This test uses reverse mode; the test above uses forward mode.
    hessian = jax.jacrev(jax.jacrev(lambda x: group.dtau(x, eta)))
    actual = group.hat(batched(hessian)(zero[None])[0] @ delta @ delta)
    assert distance(actual, expected) < 1e-14


@over([SO3(Cayley()), SE2(Exponential()), SE3(Exponential())])
def test_group_gradients_at_the_identity_are_finite(group):
    zero, ones = jnp.zeros(group.dim), jnp.ones(group.dim)

    def everything(x):
        g = group.retract(x)
        vectors = [
            group.local(g),
            group.dtau_inv(x, ones),
            group.Ad(g, ones),
            ravel_pytree(group.tangent(g, ones))[0],
        ]
        return sum(jnp.sum(v) for v in vectors)

    def twice(x, direction):
        return jax.jvp(jax.grad(everything), (x,), (direction,))

    assert np.all(np.isfinite(batched(twice)(zero[None], ones[None])))


# Long runs


@over([SO3(Exponential()), SE3(Cayley())])
def test_group_advance_after_a_million_steps_stays_on_the_group(group):
    direction = jnp.asarray(directions(group, [0], 18)[0])

    def step(k, carry):
        q, compensation, worst = carry
        xi = 0.1 * jnp.sin(k.astype(float) + direction)
        q, compensation = group.advance(q, xi, compensation)
        return q, compensation, jnp.maximum(worst, group.distance_to_group(q))

    q = group.identity()
    start = (q, group.no_compensation(q), jnp.zeros(()))
    run = jax.jit(lambda start: jax.lax.fori_loop(0, 10**6, step, start))
    q, _, worst = run(start)
    assert worst < 1e-15
    rotation = np.asarray(group.matrix(q))[:3, :3]
    assert np.max(np.abs(rotation.T @ rotation - np.eye(3))) < 1e-14


@pytest.mark.parametrize("retraction", RETRACTIONS, ids=repr)
def test_group_advance_with_compensation_agrees_with_exact_motion(retraction):
    # The product of many equal screw motions has a closed form.
    group, num_steps = SE3(retraction), 10**5
    xi = jnp.array([0.001, -0.002, 0.003, 0.001, 0.002, -0.001])

    def step(_, carry):
        q, compensation = carry
        return group.advance(q, xi, compensation)

    q = group.identity()
    start = (q, group.no_compensation(q))
    run = jax.jit(lambda start: jax.lax.fori_loop(0, num_steps, step, start))
    matrix = np.asarray(group.matrix(run(start)[0]))
    with mp.workdps(50):
        X, identity = mp.matrix(np.asarray(group.hat(xi)).tolist()), mp.eye(4)
        if isinstance(retraction, Cayley):
            one = (identity - X / 2) ** -1 * (identity + X / 2)
        else:
            one = mp.expm(X)
        expected = np.array((one**num_steps).tolist(), dtype=float)
    # Each equal increment has the same rounding error.
    assert distance(matrix, expected) < 1e-13


def test_group_advance_agrees_with_act():
    for group in GROUPS:
        q = jax.tree.map(lambda x: x[3], elements(group, 7))
        xi = vectors(group, [0.7])[0]
        advanced, compensation = group.advance(q, xi, group.no_compensation(q))
        assert distance(advanced, group.act(q, xi)) < 1e-15
        assert jax.tree.structure(compensation) == jax.tree.structure(q)


@pytest.mark.parametrize(
    ("dtype", "most_turns"), [(jnp.float64, 2**24), (jnp.float32, 2**12)]
)
def test_group_wrapped_angle_of_many_turns_is_accurate(dtype, most_turns):
    turns = np.random.default_rng(0).uniform(-most_turns, most_turns, 200)
    angles = jnp.asarray(2 * np.pi * turns, dtype)[:, None]
    compensations = jnp.asarray(np.linspace(-1e-9, 1e-9, 200), dtype)[:, None]
    found = np.asarray(jax.vmap(SO2().wrapped)(angles, compensations))[:, 0]
    with mp.workdps(50):
        sums = [
            mp.mpf(float(x)) + mp.mpf(float(c))
            for x, c in zip(angles[:, 0], compensations[:, 0], strict=True)
        ]
        expected = np.array(
            [float(x - 2 * mp.pi * mp.nint(x / 2 / mp.pi)) for x in sums]
        )
    difference = np.mod(found - expected + np.pi, 2 * np.pi) - np.pi
    eps = float(jnp.finfo(dtype).eps)
    assert np.max(np.abs(difference)) < 2 * np.pi * eps
    assert np.max(np.abs(found)) < np.pi * (1 + 4 * eps)
    poses = jax.vmap(SE2().wrapped)(
        *(jnp.pad(x, ((0, 0), (2, 0))) for x in (angles, compensations))
    )
    np.testing.assert_array_equal(np.asarray(poses)[:, 2], found)


# Form


@over(GROUPS)
def test_group_maps_in_single_precision_keep_dtype(group):
    xi = jnp.asarray(vectors(group, [0.0, 1e-3, 1.0, 1.5, 3.0]), jnp.float32)

    def everything(x):
        g = group.act(group.retract(x), x)
        advanced = group.advance(g, x, group.no_compensation(g))
        vectors = [group.local(g), group.dtau(x, x), group.dtau_inv(x, x)]
        vectors += [group.ddtau(x, x, x), group.ddtau_dual(x, x, x), group.Ad(g, x)]
        vectors += [group.dtau_dual(x, x), group.Ad_dual(g, x), group.ad(x, x)]
        vectors += [group.to_end(x, x), group.to_end_change(x, x), group.to_start(x, x)]
        other = [
            group.tangent(g, x),
            group.matrix(g),
            group.hat(x),
            group.distance_to_group(g),
        ]
        other += [group.inverse(g), group.identity(x.dtype), group.normalise(g)]
        return advanced, vectors, other

    kept = jax.eval_shape(jax.vmap(everything), xi)
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(kept))

    def some(x):
        q = ravel_pytree(group.retract(x))[0]
        return jnp.concatenate([q, group.dtau(x, x[::-1]), group.dtau_inv(x, x[::-1])])

    single, double = batched(some)(xi), batched(some)(xi.astype(float))
    assert single.dtype == jnp.float32
    assert distance(single.astype(float), double) < 1e-6


def test_group_without_curvature_is_flat():
    assert Euclidean(2).is_flat
    assert SO2(Exponential()).is_flat
    assert ProductGroup(Euclidean(2), SO2(Exponential())).is_flat
    for group in (SO2(), SO3(Exponential()), SE2(), SE3(), MIXED):
        assert not group.is_flat


def test_product_group_of_flat_factors_compiles_without_tangent_maps():
    group = ProductGroup(Euclidean(2), SO2(Exponential()), Euclidean(3))
    x = jnp.ones(6)
    for function in (group.dtau, group.dtau_inv, group.dtau_dual):
        primitives = {e.primitive.name for e in jax.make_jaxpr(function)(x, x).eqns}
        assert primitives <= {"slice", "concatenate"}


@over(SIMPLE)
def test_group_maps_compiled_contain_arithmetic_only(group):
    x = jnp.ones(group.dim)
    g = group.retract(x)
    twice = ((group.dtau, x), (group.to_end, x), (group.to_start, x), (group.act, g))
    for function, a in (*twice, (group.ddtau_dual, None)):
        arguments = (x, x, x) if a is None else (a, x)
        text = jax.jit(function).lower(*arguments).as_text()
        for operation in ("gather", "scatter", "custom_call", "dot_general", "while"):
            assert operation not in text


def test_product_group_maps_act_on_each_factor():
    group = ProductGroup(SO3(), Euclidean(2))
    assert group.dim == 5
    xi = jnp.arange(5.0) / 5
    q, x = group.retract(xi)
    assert distance(q, SO3().retract(xi[:3])) == 0
    assert distance(x, xi[3:]) == 0
    assert group.matrix((q, x)).shape == (6, 6)


def test_group_chart_ends_where_dtau_is_singular():
    def inside(group, angle):
        return bool(group.in_chart(jnp.asarray(vectors(group, [angle])[0])))

    for group in (SO3, SE2, SE3):
        assert inside(group(Exponential()), 2 * pi - 0.1)
        assert not inside(group(Exponential()), 2 * pi - 0.01)
        assert not inside(group(Exponential()), 7.0)
        assert not inside(group(Exponential()), np.nan)
    for group in (SO2, SO3, SE2, SE3):
        assert inside(group(), 2 * np.tan((pi - 0.06) / 2))
        assert not inside(group(), 2 * np.tan((pi - 0.04) / 2))
    assert inside(SO2(Exponential()), 100.0)
    assert inside(Euclidean(3), 0.0)
    assert not MIXED.in_chart(jnp.full(MIXED.dim, 100.0))
    assert MIXED.in_chart(jnp.ones(MIXED.dim))


def test_group_normalise_removes_the_distance_to_the_group():
    q = 1.25 * SO3().retract(jnp.array([0.1, 0.2, 0.3]))
    pose = jnp.concatenate([q, jnp.ones(3)])
    group = ProductGroup(SO3(), Euclidean(1), SE3())
    element = (q, jnp.ones(1), pose)
    assert group.distance_to_group(element) == pytest.approx(0.25)
    assert group.distance_to_group(group.normalise(element)) < 1e-15
    assert distance(group.normalise(element)[2][4:], np.ones(3)) == 0


def test_equal_groups_compare_equal_and_have_no_leaves():
    assert SO3() == SO3(retraction=Cayley())
    assert SO3() != SO3(Exponential())
    assert SO3() != SE3()
    assert ProductGroup(SO3(), Euclidean(2)) == ProductGroup(SO3(), Euclidean(2))
    assert ProductGroup(SO3(), Euclidean(2)) != ProductGroup(SO3(), Euclidean(3))
    for group in GROUPS:
        assert not jax.tree.leaves(group)
        assert isinstance(hash(group), int)
