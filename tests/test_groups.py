"""Lie groups: axioms, retractions and their tangents, to the last digits everywhere."""

from functools import cache
from math import pi, sqrt

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree

from nhjax._errors import ShapeError
from nhjax._manifold import (
    AbstractLieGroup,
    AbstractRetraction,
    Cayley,
    Euclidean,
    Exponential,
    ProductGroup,
    SE2,
    SE3,
    SO2,
    SO3,
)
from nhjax._manifold._series import arctan_ratio, stumpff


RETRACTIONS = (Cayley(), Exponential())
SIMPLE = [group(r) for r in RETRACTIONS for group in (SO2, SO3, SE2, SE3)]
MIXED = ProductGroup(SO3(), Euclidean(2), ProductGroup(SE2(Exponential()), SO2()))
GROUPS = [*SIMPLE, Euclidean(3), MIXED]

# Angles at zero, tiny, at each side of where a formula changes, and at the edge of the
# chart. The series in θ² ends at 2; some functions are evaluated at θ²/4.
SWITCHES = [sqrt(2), 2 * sqrt(2)]
INSIDE = [0.0, 1e-12, 1e-8, 1e-4, 0.01, 0.3, 1.0, 3.0]
INSIDE += [s * (1 + e) for s in SWITCHES for e in (-1e-9, 1e-9)]
EDGE = {Cayley: [20.0, 66.0], Exponential: [4.5, 6.2]}


def name_of(group):
    retraction = getattr(group, "retraction", None)
    suffix = f"-{type(retraction).__name__}" if retraction else ""
    return type(group).__name__ + suffix


def over(groups):
    return pytest.mark.parametrize("group", groups, ids=name_of)


def rotation_part(group):
    """The slice of the algebra vector that turns; the rest translates."""
    return {
        SO2: slice(0, 1), SO3: slice(0, 3), SE2: slice(2, 3), SE3: slice(3, 6)
    }.get(type(group), slice(0, 0))  # fmt: skip


def vectors(group, angles, seed=0):
    """Vectors of the algebra, one for each angle; translations are of order one."""
    if isinstance(group, ProductGroup):
        parts = [vectors(g, angles, seed + k) for k, g in enumerate(group.factors)]
        return np.concatenate(parts, axis=1)
    xi = np.random.default_rng(seed).normal(size=(len(angles), group.dim))
    turning = rotation_part(group)
    norm = np.linalg.norm(xi[:, turning], axis=1, keepdims=True)
    xi[:, turning] *= np.asarray(angles)[:, None] / np.where(norm > 0, norm, 1.0)
    return xi


def chart(group, seed=0):
    """Vectors over the whole chart."""
    edge = EDGE.get(type(getattr(group, "retraction", None)), [])
    return vectors(group, INSIDE + edge, seed)


def directions(group, like, seed):
    return np.random.default_rng(seed).normal(size=(len(like), group.dim))


def elements(group, seed):
    """Elements of the group anywhere, of translations of order one."""
    xi, zeta = vectors(group, np.linspace(0, 2, 16), seed), vectors(group, 16 * [1.0])
    return _elements(group)(xi, zeta)


@cache
def _elements(group):
    return batched(lambda x, z: group.act(group.retract(x), z))


def distance(a, b):
    """The largest difference relative to the size (at least 1) of the values."""
    a, b = ravel_pytree(a)[0], ravel_pytree(b)[0]
    size = np.maximum(1.0, np.max(np.abs(b)))
    return float(np.max(np.abs(a - b)) / size)


def batched(function):
    # Compilation takes most of the time, and half as much without optimisation.
    quick = {"xla_backend_optimization_level": 0}
    return jax.jit(jax.vmap(function), compiler_options=quick)


def tau_of_matrix(group, X):
    """τ by its definition on matrices; also of complex ones."""
    if isinstance(group.retraction, Exponential):
        return scipy.linalg.expm(X)
    identity = np.eye(len(X))
    return np.linalg.solve(identity - X / 2, identity + X / 2)


def seeded(test):
    """The test with drawn directions, at every scale of `INSIDE` and the edge."""
    drawn = hypothesis.given(seed=st.integers(0, 2**20))(test)
    return hypothesis.settings(max_examples=5, deadline=None)(drawn)


@cache
def compiled(group, *names):
    """The composition of maps of a group by name, the last one first, over a batch."""
    *outer, inner = (getattr(group, name) for name in names)

    def composition(x, y):
        y = inner(x, y)
        for apply in reversed(outer):
            y = apply(x, y)
        return y

    return batched(composition)


# The group


@over(GROUPS)
@seeded
def test_axioms(group, seed):
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
def test_matrix_is_a_homomorphism(group):
    g, h = elements(group, 1), elements(group, 2)
    product = batched(lambda g, h: group.matrix(group.compose(g, h)))(g, h)
    matrix = batched(group.matrix)
    assert distance(product, matrix(g) @ matrix(h)) < 1e-14


@over(GROUPS)
@seeded
def test_local_inverts_the_retraction(group, seed):
    # Exponential: the shorter of two rotation vectors, hence less than π.
    xi = vectors(group, [*INSIDE, 3.1], seed)
    assert distance(_round_trip(group)(xi), xi) < 1e-14


@cache
def _round_trip(group):
    return batched(lambda xi: group.local(group.retract(xi)))


@pytest.mark.parametrize("retraction", RETRACTIONS, ids=repr)
def test_local_of_opposite_quaternions_is_the_same(retraction):
    group = SO3(retraction)
    q = group.retract(jnp.array([0.3, -0.5, 1.0]))
    assert distance(group.local(-q), group.local(q)) < 1e-15


@over(SIMPLE)
def test_retraction_is_the_matrix_function(group):
    xi = chart(group)
    matrix = batched(lambda x: group.matrix(group.retract(x)))(xi)
    hat = np.asarray(batched(group.hat)(xi))
    expected = np.stack([tau_of_matrix(group, X) for X in hat])
    assert distance(matrix, expected) < 1e-14


@over(SIMPLE)
def test_retraction_keeps_relative_accuracy_of_tiny_vectors(group):
    xi = 1e-200 * directions(group, range(4), 5)
    back = batched(lambda x: group.local(group.retract(x)))(xi)
    np.testing.assert_allclose(back, xi, rtol=1e-14)


# Tangents


@over(SIMPLE)
@seeded
def test_dtau_is_the_left_trivialised_derivative_of_the_matrix(group, seed):
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
def test_dtau_inv_inverts_dtau(group, seed):
    xi = chart(group, seed)
    eta = directions(group, xi, seed + 2)
    back = compiled(group, "dtau", "dtau_inv")(xi, eta)
    # Near the edge dτ⁻¹ is large.
    assert distance(back[: len(INSIDE)], eta[: len(INSIDE)]) < 1e-14
    assert distance(back, eta) < 1e-11


@over(GROUPS)
@seeded
def test_dtau_at_minus_xi_is_the_right_trivialised_one(group, seed):
    xi = chart(group, seed)
    eta = directions(group, xi, seed + 3)
    left, right = compiled(group, "dtau")(xi, eta), _right_trivialised(group)(xi, eta)
    assert distance(left, right) < 1e-13


@cache
def _right_trivialised(group):
    return batched(lambda x, y: group.Ad(group.retract(-x), group.dtau(-x, y)))


@over(GROUPS)
@seeded
def test_ddtau_is_the_second_tangent(group, seed):
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
def test_tangent_is_the_velocity_of_the_retraction(group):
    g = elements(group, 3)
    eta = directions(group, range(16), 7)
    expected = batched(lambda g, y: AbstractLieGroup.tangent(group, g, y))(g, eta)
    assert distance(batched(group.tangent)(g, eta), expected) < 1e-14


@over(GROUPS)
def test_left_gradient_is_the_derivative_along_the_retraction(group):
    g = elements(group, 4)

    def function(g):
        return jnp.sum(jnp.sin(group.matrix(g)))

    def along(g):
        return jax.grad(lambda x: function(group.act(g, x)))(jnp.zeros(group.dim))

    actual = batched(lambda g: group.left_gradient(function, g))(g)
    assert distance(actual, batched(along)(g)) < 1e-14


@over([g for g in GROUPS if not isinstance(g, Euclidean)])
@seeded
def test_adjoint_maps_are_those_of_matrices(group, seed):
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
def test_covectors_are_carried_along_the_retraction(group):
    xi = chart(group, 3)
    mu = directions(group, range(len(xi)), 4)
    g = batched(group.retract)(xi)
    seen = batched(group.Ad_dual)(g, mu)
    assert distance(batched(group.to_end)(xi, mu), seen) < 1e-14
    assert distance(batched(group.to_end_change)(xi, mu), seen - mu) < 1e-14
    assert distance(batched(group.to_start)(xi, seen), mu) < 1e-13


@pytest.mark.parametrize("retraction", RETRACTIONS, ids=repr)
@pytest.mark.parametrize("kind", [SO3, SE2, SE3])
def test_change_of_a_covector_keeps_relative_accuracy_of_tiny_motions(kind, retraction):
    group = kind(retraction)
    xi = 1e-9 * np.eye(group.dim)
    mu = directions(group, range(group.dim), 5)
    expected = batched(group.ad_dual)(xi, mu)
    np.testing.assert_allclose(
        batched(group.to_end_change)(xi, mu), expected, rtol=0, atol=2e-17
    )


@over(GROUPS)
@seeded
def test_duals_are_the_transposed_maps(group, seed):
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
def test_dtau_and_its_derivatives_are_right_to_the_last_digits(group):
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
def test_stumpff_functions_and_their_derivatives(s):
    n = 4

    def value(s):
        return stumpff(jnp.asarray(s), n)

    def third(s):
        return jax.jacfwd(jax.jacrev(jax.jacfwd(value)))(s)

    def exact(k, order):
        # j (j - 1) ... (j - order + 1) s^(j - order), written to hold at s = 0.
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
def test_arctan_ratio_and_its_second_derivative(x):
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
def test_second_derivatives_at_the_identity(group):
    eta, delta = directions(group, range(2), 17)
    zero = jnp.zeros(group.dim)
    D, Y = (np.asarray(group.hat(v)) for v in (delta, eta))

    def bracket(a, b):
        return a @ b - b @ a

    if isinstance(group.retraction, Exponential):
        expected = bracket(D, bracket(D, Y)) / 3
    else:
        expected = (bracket(D, bracket(D, Y)) + D @ Y @ D) / 2
    # In reverse mode; forward mode is that of the test above.
    hessian = jax.jacrev(jax.jacrev(lambda x: group.dtau(x, eta)))
    actual = group.hat(batched(hessian)(zero[None])[0] @ delta @ delta)
    assert distance(actual, expected) < 1e-14


@over([SO3(Cayley()), SE2(Exponential()), SE3(Exponential())])
def test_gradients_of_every_map_are_finite_at_the_identity(group):
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
def test_a_million_steps_stay_on_the_group(group):
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
def test_compensated_steps_add_up_to_the_exact_motion(retraction):
    # Many equal screw motions, of which the sum is known.
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
    # The increments are rounded relative to themselves: the same way each time.
    assert distance(matrix, expected) < 1e-13


def test_advance_is_the_action():
    for group in GROUPS:
        q = jax.tree.map(lambda x: x[3], elements(group, 7))
        xi = vectors(group, [0.7])[0]
        advanced, compensation = group.advance(q, xi, group.no_compensation(q))
        assert distance(advanced, group.act(q, xi)) < 1e-15
        assert jax.tree.structure(compensation) == jax.tree.structure(q)


# Form


@over(GROUPS)
def test_single_precision_is_kept(group):
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


def test_flat_groups_are_those_without_curvature():
    assert Euclidean(2).is_flat
    assert SO2(Exponential()).is_flat
    assert ProductGroup(Euclidean(2), SO2(Exponential())).is_flat
    for group in (SO2(), SO3(Exponential()), SE2(), SE3(), MIXED):
        assert not group.is_flat


def test_factors_without_curvature_cost_nothing():
    group = ProductGroup(Euclidean(2), SO2(Exponential()), Euclidean(3))
    x = jnp.ones(6)
    for function in (group.dtau, group.dtau_inv, group.dtau_dual):
        primitives = {e.primitive.name for e in jax.make_jaxpr(function)(x, x).eqns}
        assert primitives <= {"slice", "concatenate"}


@over(SIMPLE)
def test_maps_compile_to_arithmetic_only(group):
    x = jnp.ones(group.dim)
    g = group.retract(x)
    twice = ((group.dtau, x), (group.to_end, x), (group.to_start, x), (group.act, g))
    for function, a in (*twice, (group.ddtau_dual, None)):
        arguments = (x, x, x) if a is None else (a, x)
        text = jax.jit(function).lower(*arguments).as_text()
        for operation in ("gather", "scatter", "custom_call", "dot_general", "while"):
            assert operation not in text


def test_products_act_factor_by_factor():
    group = ProductGroup(SO3(), Euclidean(2))
    assert group.dim == 5
    xi = jnp.arange(5.0) / 5
    q, x = group.retract(xi)
    assert distance(q, SO3().retract(xi[:3])) == 0
    assert distance(x, xi[3:]) == 0
    assert group.matrix((q, x)).shape == (6, 6)


def test_the_chart_ends_where_the_tangent_is_singular():
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


def test_defect_is_the_error_of_the_norm_and_normalise_removes_it():
    q = 1.25 * SO3().retract(jnp.array([0.1, 0.2, 0.3]))
    pose = jnp.concatenate([q, jnp.ones(3)])
    group = ProductGroup(SO3(), Euclidean(1), SE3())
    element = (q, jnp.ones(1), pose)
    assert group.distance_to_group(element) == pytest.approx(0.25)
    assert group.distance_to_group(group.normalise(element)) < 1e-15
    assert distance(group.normalise(element)[2][4:], np.ones(3)) == 0


def test_equal_groups_are_equal_and_without_leaves():
    assert SO3() == SO3(retraction=Cayley())
    assert SO3() != SO3(Exponential())
    assert SO3() != SE3()
    assert ProductGroup(SO3(), Euclidean(2)) == ProductGroup(SO3(), Euclidean(2))
    assert ProductGroup(SO3(), Euclidean(2)) != ProductGroup(SO3(), Euclidean(3))
    for group in GROUPS:
        assert not jax.tree.leaves(group)
        assert isinstance(hash(group), int)


# Errors


@pytest.mark.parametrize("group", [SO2, SO3, SE2, SE3])
@pytest.mark.parametrize("retraction", [Cayley, "cayley", None, np.ones(3)])
def test_retraction_must_be_an_instance(group, retraction):
    with pytest.raises(TypeError, match=r"`retraction` must be one of Cayley\(\)"):
        group(retraction=retraction)


def test_a_class_as_retraction_is_named_as_such():
    with pytest.raises(TypeError, match="It is the class; call it"):
        SO3(retraction=Exponential)  # pyright: ignore[reportArgumentType]


def test_unknown_retraction_is_refused_with_advice():
    class Mine(AbstractRetraction):
        angle = rate = plane_rotation = half_rotation = None  # pyright: ignore
        rotation_vector = None  # pyright: ignore
        dtau_coefficients = dtau_inv_coefficients = in_chart = None  # pyright: ignore

    with pytest.raises(ValueError, match=r"`retraction` is .*subclass `AbstractLie"):
        SO3(retraction=Mine())


@pytest.mark.parametrize(
    ("group", "q", "message"),
    [
        (SO2(), jnp.zeros(()), r"`q` has shape \(\), but the manifold SO2 needs"),
        (SO3(), jnp.zeros(3), r"manifold SO3 needs shape \(4,\)"),
        (SE2(), jnp.zeros((2, 3)), r"use `jax.vmap`"),
        (SE3(), jnp.zeros(6), r"manifold SE3 needs shape \(7,\)"),
        (SO3(), (jnp.zeros(4),), r"`q` is \(f64\[4\],\), but the manifold SO3 needs"),
        (MIXED, jnp.zeros(9), r"`q` must be a tuple of 3 elements.* got f64\[9\]"),
        (MIXED, (jnp.zeros(4),), r"tuple of 3 elements.* got \(f64\[4\],\)"),
        (
            MIXED,
            (jnp.zeros(4), jnp.zeros(2), (jnp.zeros(3), jnp.zeros(2))),
            r"`q\[2\]\[1\]` has shape \(2,\), but the manifold SO2 needs",
        ),
    ],
)  # fmt: skip
def test_wrong_elements_are_named(group, q, message):
    with pytest.raises(ShapeError, match=message):
        group.check(q)


def test_right_elements_pass():
    for group in GROUPS:
        q = group.identity()
        assert group.check(q) is q


@pytest.mark.parametrize(
    ("factors", "error", "message"),
    [
        ((), ValueError, "at least one factor"),
        ((SO3(), 2), TypeError, "factor 1 must be a Lie group"),
        ((SO3,), TypeError, "factor 0 must be a Lie group"),
    ],
)
def test_products_are_of_groups(factors, error, message):
    with pytest.raises(error, match=message):
        ProductGroup(*factors)
