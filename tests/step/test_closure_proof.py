"""The proof of the order in `docs/closures.md`, lemma by lemma, in numbers.

Algebra is checked in exact rationals where the nodes are rational, and in 50 digits
elsewhere; steps are solved in 50 digits with equations written for these tests. Each
test also checks that one further condition does not hold, which shows that the test can
fail.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from support import closure_steps as steps
from support.collocation import (
    in_digits,
    largest,
    lobatto,
    MP,
    rational,
    slope,
)
from support.long import exhaustive_but, long
from support.orders import assert_order, rms, SCIPY_FLOOR, trajectories


EXACT = {
    "Lobatto, s = 2": rational("0", "1"),
    "Lobatto, s = 3": rational("0", "1/2", "1"),
    "thirds": rational("0", "1/3", "2/3", "1"),
    "quarters": rational("0", "1/4", "1/2", "3/4", "1"),
    "not symmetric, r = 0": rational("0", "2/5", "1"),
    "not symmetric, r = 1": rational("0", "1/5", "2/3", "1"),
}
METHODS = EXACT | {f"Lobatto, s = {s}": lobatto(s) for s in range(4, 9)}
STAGES = range(2, 7)

every_method = pytest.mark.parametrize("name", METHODS)
every_stages = pytest.mark.parametrize("s", exhaustive_but((2, 3, 4), STAGES))


def at_two_sizes(function, coarse=32):
    return function(MP.mpf(1) / coarse), function(MP.mpf(1) / (2 * coarse))


def slope_of(function, coarse=32):
    """The power of h in the largest entry of a function of h."""
    return slope(*(largest(value) for value in at_two_sizes(function, coarse)))


# --- assumptions and Lemma 2: the kernel ----------------------------------------------


@every_method
def test_simplifying_assumptions_hold_exactly_up_to_their_orders(name):
    m = METHODS[name]
    a, a_hat, b, c, s, r = m.a, m.a_hat, m.b, m.c, m.stages, m.r
    assert r >= 0

    def transposed(matrix, k):
        return (b * c ** (k - 1)) @ matrix - b * (1 - c**k) / k

    assert all(m.vanishes(m.defect(k)) for k in range(1, s + 1))  # C(s)
    assert all(m.vanishes(m.defect(k, True)) for k in range(1, r + 1))  # Ĉ(r)
    assert all(m.vanishes(transposed(a, k)) for k in range(1, r + 1))  # D(r)
    assert all(m.vanishes(transposed(a_hat, k)) for k in range(1, s + 1))  # D̂(s)
    assert not m.vanishes(m.defect(s + 1))
    assert not m.vanishes(m.defect(r + 1, True))
    assert not m.vanishes(transposed(a, r + 1))
    assert not m.vanishes(transposed(a_hat, s + 1))


@every_method
def test_kernel_equals_node_polynomial_slope_and_is_orthogonal(name):
    m = METHODS[name]
    w = m.kernel
    slopes = [np.prod([x - y for y in np.delete(m.c, i)]) for i, x in enumerate(m.c)]
    assert m.vanishes(w - np.array(slopes) / slopes[0])
    assert m.vanishes(m.a @ w)
    assert all(m.vanishes(m.moment(w, k)) for k in range(m.r + 1))
    assert not m.vanishes(m.moment(w, m.r + 1))
    assert m.vanishes(np.sum(m.b * w * (m.a_hat @ w)))


@pytest.mark.parametrize("s", range(2, 9))
def test_kernel_of_lobatto_equals_legendre_polynomial_at_the_nodes(s):
    m = METHODS[f"Lobatto, s = {s}"]
    assert (m.p, m.r) == (2 * s - 2, s - 2)
    c = in_digits(m).c
    legendre = np.array([MP.legendre(s - 1, 2 * x - 1) for x in c])
    assert largest(in_digits(m).kernel - legendre / legendre[0]) < 1e-40
    assert m.vanishes(m.kernel[-1] - (-1) ** (s - 1))
    method = nhjax.LobattoIIIAB(s)
    assert method.stability_at_infinity == (-1) ** (s - 1)
    np.testing.assert_allclose(method.a, m.a.astype(float), rtol=0, atol=1e-15)
    np.testing.assert_allclose(method.a_hat, m.a_hat.astype(float), rtol=0, atol=1e-15)


# --- Lemma 3: the class K -------------------------------------------------------------

# Each operation takes x in N_l to N_m: (l, m) and the images of x.


def multiplied(m, x, l):
    return [(l + k, m.c**k * x) for k in range(4)]


def integrated(m, x, l):
    return [(l + 1, m.a @ x), (l + 1, m.a_hat @ x)]


def preimages(m, x, l):
    return [(l + k, m.preimage(m.c**k * (m.a @ x), m.c[-1])) for k in range(4)]


OPERATIONS = {f.__name__: f for f in (multiplied, integrated, preimages)}


@every_method
@pytest.mark.parametrize("operation", OPERATIONS)
def test_operation_on_error_class_keeps_the_class_sharply(operation, name):
    m = METHODS[name]
    sharp = False
    for l in range(m.r + 1, 2 * m.r + 2):
        for seed in range(3):
            x = m.member(l, seed)
            assert m.contains(l, x)
            for target, image in OPERATIONS[operation](m, x, l):
                assert m.contains(target, image)
                # The next moment need not vanish.
                further = max(2 * m.r + 2 - target, 0)
                sharp |= not m.vanishes(m.moment(image, further))
    assert sharp


@every_method
def test_solution_of_constraints_is_unique_up_to_the_kernel(name):
    m = METHODS[name]
    x = m.member(m.r + 1, 0)
    g = m.c * (m.a @ x)
    one = m.c[-1]
    u, other = m.preimage(g, 0 * one), m.preimage(g, 3 * one)
    assert m.vanishes(m.a @ u - g)
    assert m.vanishes(other - u - 3 * m.kernel)


@every_method
def test_defects_of_the_exact_motion_are_in_the_error_class(name):
    m = METHODS[name]
    for k in range(m.r + 1, 2 * m.r + 3):
        assert m.contains(k, m.defect(k, conjugate=True))
        assert m.contains(k, m.defect(k))
        for power in range(3):  # Defects of the constraints are divided by h.
            preimage = m.preimage(m.c**power * m.defect(k), 0 * m.c[-1])
            assert m.contains(k - 1 + power, preimage)
    first = m.defect(m.r + 1, conjugate=True)
    assert not m.vanishes(m.moment(first, m.stages - 1))


@pytest.mark.parametrize("name", ["Lobatto, s = 3", "Lobatto, s = 5", "quarters"])
def test_moments_of_smooth_data_have_slopes_of_the_error_class(name):
    m = in_digits(METHODS[name])
    r, zero = m.r, MP.mpf(0)
    parts = [m.member(k, 10 + k) for k in range(2 * r + 4)]

    def operations(h):
        x = sum(h**k * part for k, part in enumerate(parts))
        smooth = np.array([MP.exp(t) / (1 + t**2) for t in h * m.c])
        sampled = np.array([MP.sin(1 + 2 * t) for t in h * m.c])
        rate = np.array([2 * MP.cos(1 + 2 * t) for t in h * m.c])
        off = sampled[0] - sampled + h * (m.a @ rate)
        conjugate = sampled[0] - sampled + h * (m.a_hat @ rate)
        return (
            smooth * x,
            h * (m.a @ x),
            h * (m.a_hat @ x),
            off,
            conjugate,
            m.preimage(smooth * (m.a @ x), zero),
            m.preimage(smooth * off / h, zero),
        )

    sizes = at_two_sizes(operations, coarse=4096)
    for k in range(r + 1):
        values = [[m.moment(x, k) for x in images] for images in sizes]
        found = [slope(abs(u), abs(v)) for u, v in zip(*values, strict=True)]
        assert min(found) > 2 * r + 2 - k - 0.15, found
        assert min(found) < 2 * r + 2 - k + 0.3, found


# --- Lemma 4 and the theorem: errors of a step ----------------------------------------


def assert_stage_errors_are_in_the_class(m, errors):
    """The k-th moment is O(h^(2r+2-k)) for k = 0..r+1, and not smaller."""
    for k in range(m.r + 2):
        values = [largest(m.moment(e.stages, k)) for e in errors]
        assert slope(*values) == pytest.approx(2 * m.r + 2 - k, abs=0.2)


@every_stages
def test_errors_of_a_symmetric_step_are_in_the_error_class(s):
    m = lobatto(s)
    errors = at_two_sizes(lambda h: steps.Step(m, h, (-1) ** s).errors())
    assert_stage_errors_are_in_the_class(m, errors)
    assert slope(*(largest(e.end) for e in errors)) == pytest.approx(
        2 * s - 1, abs=0.15
    )
    assert slope(*(largest(e.nu) for e in errors)) == pytest.approx(s, abs=0.15)
    multipliers = [largest(e.stages[:, -steps.COUNT :]) for e in errors]
    assert slope(*multipliers) == pytest.approx(s, abs=0.2)


@pytest.mark.parametrize(
    "name",
    ["thirds", long("quarters"), "not symmetric, r = 0", long("not symmetric, r = 1")],
)
def test_collocation_on_other_nodes_has_local_order_2r_plus_3(name):
    m = in_digits(METHODS[name])
    errors = at_two_sizes(lambda h: steps.Step(m, h).errors())
    assert_stage_errors_are_in_the_class(m, errors)
    assert slope(*(largest(e.end) for e in errors)) == pytest.approx(
        2 * m.r + 3, abs=0.15
    )


@pytest.mark.parametrize("name", ["thirds", long("quarters")])
def test_symmetric_closure_on_other_nodes_has_an_unknown_of_order_r_plus_2(name):
    m = in_digits(METHODS[name])
    sign = -round(m.kernel[-1])
    errors = at_two_sizes(lambda h: steps.Step(m, h, sign).errors())
    nu, end = (slope(*(largest(e[k]) for e in errors)) for k in (2, 1))
    assert nu == pytest.approx(m.r + 2, abs=0.15)
    assert end == pytest.approx(2 * m.r + 3, abs=0.15)


@pytest.mark.parametrize("s", [3, long(4)])
def test_multiplier_error_at_start_of_order_s_minus_1_keeps_end_order(s):
    # One power of h less in this error costs one power at the end.
    m = lobatto(s)

    def end(power):
        def errors(h):
            step = steps.Step(m, h)
            return step.errors(step.lambda0 + h**power * np.array([1, -2])).end

        return errors

    assert slope_of(end(s - 1)) == pytest.approx(2 * s - 1, abs=0.15)
    assert slope_of(end(s - 2)) == pytest.approx(2 * s - 2, abs=0.15)


@pytest.mark.parametrize("s", [2, 3, long(4)])
def test_symmetric_step_from_far_starting_values_is_the_same(s):
    m = lobatto(s)
    step = steps.Step(m, MP.mpf(1) / 32, (-1) ** s)
    *_, multipliers, nu, x = step.solve()
    far = x + np.array([MP.mpf(k % 7 - 3) / 10 for k in range(len(x))])
    step.inverse_jacobian = None
    *_, again, nu_again, _ = step.solve(guess=far)
    assert largest(nu) > 1e-9
    assert largest(nu - nu_again) < 1e-40
    assert largest(multipliers - again) < 1e-40


# --- corollary: the sensitivity to the first multiplier -------------------------------


def differences(s, first, second):
    """First and second divided differences of (q_1, p_1) in Λ^1, as functions of h."""
    m, along = lobatto(s), np.array([MP.mpf(1), MP.mpf("-0.5")])

    def both(h):
        step = steps.Step(m, h)
        at = step.end(step.lambda0)
        slopes = (step.end(step.lambda0 + first * along) - at) / first
        right, left = (step.end(step.lambda0 + x * along) for x in (second, -second))
        return slopes, (right + left - 2 * at) / second**2

    return both


@every_stages
def test_sensitivity_to_first_multiplier_has_orders_s_and_3(s):
    both = differences(s, MP.mpf(10) ** -18, MP.mpf(10) ** -9)
    coarse, fine = at_two_sizes(both)
    linear, quadratic = (
        slope(largest(a), largest(b)) for a, b in zip(coarse, fine, strict=True)
    )
    assert linear == pytest.approx(s, abs=0.1)
    assert quadratic == pytest.approx(3, abs=0.1)


@pytest.mark.parametrize("s", [4, long(5)])
def test_multiplier_error_at_start_that_is_constant_has_order_3_at_end(s):
    m, wrong = lobatto(s), np.array([MP.mpf("0.3"), MP.mpf("-0.2")])

    def change(h):
        step = steps.Step(m, h)
        return step.end(step.lambda0 + wrong) - step.end(step.lambda0)

    assert slope_of(change, coarse=128) == pytest.approx(3, abs=0.15)


# --- groups ---------------------------------------------------------------------------


@every_stages
@pytest.mark.parametrize("chart", ["start", "middle"])
def test_quadratures_of_a_step_on_a_group_are_consistent(chart, s):
    m = lobatto(s)
    errors = at_two_sizes(lambda h: steps.turn_errors(m, h, (-1) ** s, chart))
    assert_stage_errors_are_in_the_class(m, errors)
    for of in ("consistency", "end"):
        values = [largest(getattr(e, of)) for e in errors]
        assert slope(*values) == pytest.approx(2 * s - 1, abs=0.2), of
    assert slope(*(largest(e.nu) for e in errors)) == pytest.approx(s, abs=0.2)


# --- the same in the library ----------------------------------------------------------


def lagrangian(t, q, v, args):
    x, y, z, w = q
    kinetic = (
        (2 + 0.3 * y**2) * v[0] ** 2
        + (1 + x**2 / 5) * v[1] ** 2
        + (1.5 + jnp.cos(y) / 5) * v[2] ** 2
        + (1 + z**2 / 3) * v[3] ** 2
    ) / 2
    mixed = jnp.sin(x) / 5 * v[0] * v[1] + z / 7 * v[1] * v[2] + x / 10 * v[0] * v[3]
    potential = x**2 / 2 + y**2 + z**2 / 4 + w**2 / 2 + x * y * z / 5
    return kinetic + mixed - potential + x * jnp.sin(t) / 10


def constraint(t, q, v, args):
    x, y, z, _ = q
    first = v[2] - y * v[0] - v[0] * v[1] / 5 - jnp.sin(t) / 10
    return jnp.stack(
        [first, v[3] - jnp.sin(x) * v[1] - v[0] ** 2 / 10 - z * v[2] * v[1] / 6]
    )


FRESH = nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint)
T0 = float(steps.T0)


def fresh_start():
    q, v = (x.astype(float) for x in (steps.Q0, steps.initial_velocity()))
    return nhjax.initial_state(FRESH, jnp.array(q), jnp.array(v), t=T0)


@pytest.mark.parametrize("s", [long(2), 3, long(4)])
def test_step_of_the_library_equals_step_in_50_digits(s):
    h = 0.125
    Q, _, _, _, p, _, _, _, _ = steps.Step(lobatto(s), MP.mpf(h), (-1) ** s).solve()
    y = nhjax.step(FRESH, nhjax.LobattoIIIAB(s), T0, h, fresh_start())
    np.testing.assert_allclose(y.q, Q[-1].astype(float), rtol=0, atol=4e-15)
    np.testing.assert_allclose(y.p, p[-1].astype(float), rtol=0, atol=4e-15)


@pytest.mark.parametrize("chart", [long("start"), "middle"])
def test_step_of_the_library_on_a_group_equals_step_in_50_digits(chart):
    group, h, s = nhjax.SO3(), 0.125, 3
    inertia = jnp.array(steps.INERTIA.astype(float))

    def lagrangian(t, q, w, args):
        R = group.matrix(q)
        return w @ inertia @ w / 2 - 0.3 * R[2, 2] - 0.2 * R[0, 1]

    def constraint(t, q, w, args):
        R = group.matrix(q)
        return ((R @ w)[2] - 0.2 * w[0] * w[1] + 0.3 * R[0, 0] * w[2])[None]

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint, manifold=group)
    axis = np.array([0.2, -0.4, 0.5])  # of R0, by Cayley's map
    q = jnp.array([1.0, *axis / 2]) / np.sqrt(1 + axis @ axis / 4)
    np.testing.assert_allclose(group.matrix(q), steps.R0.astype(float), atol=1e-15)
    v = steps.initial_turning().astype(float)
    y0 = nhjax.initial_state(system, q, jnp.array(v))
    method = nhjax.LobattoIIIAB(s, chart=chart)
    y = nhjax.step(system, method, 0.0, h, y0)
    turn = steps.turn_of(lobatto(s), MP.mpf(h), (-1) ** s, chart)
    found = np.asarray(group.matrix(y.q))
    np.testing.assert_allclose(found, turn.R.astype(float), rtol=0, atol=4e-15)
    np.testing.assert_allclose(y.v, turn.w.astype(float), rtol=0, atol=4e-15)


# --- the theorem over many steps ------------------------------------------------------

STAGE, MASS, _, REDUCED = steps.functions(["numpy"])


def reduced(t, q, v):
    """The multiplier λ_c and the acceleration, in float64."""
    mass, rows, right, rate = map(np.array, REDUCED(t, q, v))
    right, rate = np.ravel(right), np.ravel(rate)
    inverse = np.linalg.inv(mass)
    drift = rows @ inverse @ right + rate
    multiplier = -np.linalg.solve(rows @ inverse @ rows.T, drift)
    return multiplier, inverse @ (right + rows.T @ multiplier)


@pytest.mark.parametrize(
    ("s", "closure"),
    exhaustive_but(
        [(3, "symmetric")],
        [
            *((s, "symmetric") for s in (2, 3, 4, 5)),
            *((s, closure) for s in (3, 4) for closure in ("consistent", "propagated")),
        ],
    ),
)
def test_order_on_an_independent_system_is_2s_minus_2(s, closure):
    counts = {2: (32, 64, 128), 3: (16, 32, 64), 4: (12, 16, 24), 5: (8, 12)}[s]
    method = nhjax.LobattoIIIAB(s, closure)
    errors = {"q": [], "p": [], "multiplier": []}
    y0 = fresh_start()
    for ts, y, continuous in trajectories(FRESH, method, y0, counts):
        solution = solve_ivp(
            lambda t, y: np.concatenate([y[4:], reduced(t, y[:4], y[4:])[1]]),
            (T0, ts[-1]),
            np.concatenate([y0.q, y0.v]),
            method="DOP853",
            t_eval=ts,
            rtol=1e-13,
            atol=1e-14,
        )
        q, v = np.split(solution.y.T, 2, axis=1)
        p = np.stack([np.array(MASS(*z)) @ w for *z, w in zip(ts, q, v, strict=True)])
        exact = [reduced(*z)[0] for z in zip(ts, q, v, strict=True)]
        errors["q"].append(rms(y.q - q))
        errors["p"].append(rms(y.p - p))
        errors["multiplier"].append(rms(continuous - np.stack(exact)))
        if closure != "propagated":
            np.testing.assert_allclose(y.multiplier, continuous, rtol=0, atol=1e-11)
    for found in errors.values():
        assert_order(2 * s - 2, counts, found, SCIPY_FLOOR)
