"""A projection keeps components bit for bit; the others are the nearest.

Mass matrices, Jacobians and the conditions for the nearest state are written in NumPy
here, and SciPy's SLSQP finds this state by another method.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

import nhjax
from nhjax import systems
from nhjax.systems import RollingDisc, VerticalRollingDisc, WhippleBicycle
from support.long import long


RNG = np.random.default_rng(3)
ROOT = RNG.normal(size=(6, 6))
MASS = ROOT @ ROOT.T + np.diag([1e-2, 1.0, 5.0, 1.0, 30.0, 1.0])
ROWS = RNG.normal(size=(3, 6))
AFFINE = np.array([0.3, -1.0, 0.2])
Q, V = RNG.normal(size=6), RNG.normal(size=6)


def bits(x):
    return np.asarray(x).view(np.int64)


def numbers(q):
    return np.concatenate([np.asarray(x) for x in jax.tree.leaves(q)])


def assert_kept(found, given, kept):
    np.testing.assert_array_equal(
        bits(found)[list(kept)], bits(jnp.asarray(given))[list(kept)]
    )


def nearest_linear(metric, rows, right, u, kept):
    """Return the w nearest to u with rows w = right, and w = u at `kept`."""
    n = len(u)
    free = [i for i in range(n) if i not in {i % n for i in kept}]
    inner, across = metric[np.ix_(free, free)], rows[:, free]
    zero = np.zeros((len(rows), len(rows)))
    matrix = np.block([[inner, across.T], [across, zero]])
    b = np.concatenate([np.zeros(len(free)), right - rows @ u])
    w = np.array(u)
    w[free] += np.linalg.solve(matrix, b)[: len(free)]
    return w


def assert_stationary(metric, rows, change, kept, tolerance=1e-12):
    """The gradient of the distance is a combination of rows and kept directions."""
    units = np.eye(len(change))[list(kept)]
    normals = np.concatenate([rows, units]).T
    gradient = metric @ change
    combination = np.linalg.lstsq(normals, gradient, rcond=None)[0]
    size = np.max(np.abs(metric)) * np.max(np.abs(change))
    np.testing.assert_allclose(normals @ combination, gradient, atol=tolerance * size)


def affine_rows(t, q):
    return ROWS + 0.3 * np.sin(t + q[0]) * np.ones((3, 6))


def affine(t, q, v, args):
    rows = ROWS + 0.3 * jnp.sin(t + q[0]) * jnp.ones((3, 6))
    return rows @ v - AFFINE * t


LAGRANGIAN = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ jnp.asarray(MASS) @ v - 0.5 * q @ q,
    nonholonomic=affine,
)
HAMILTONIAN = nhjax.HamiltonianSystem(
    lambda t, q, p, args: 0.5 * p @ jnp.asarray(np.linalg.inv(MASS)) @ p + 0.5 * q @ q,
    nonholonomic=lambda t, q, p, args: affine(
        t, q, jnp.asarray(np.linalg.inv(MASS)) @ p, args
    ),
)
SPHERE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * (v[0] ** 2 + 2 * v[1] ** 2 + 5 * v[2] ** 2) - q[2],
    holonomic=lambda t, q, args: q @ q - (1.0 + 0.1 * jnp.sin(t)) ** 2,
)


# Velocities and momenta ---------------------------------------------------------------


@pytest.mark.parametrize("kept", [(0,), (1, 4), (5, 0, 2), (-1,)])
def test_projection_with_kept_velocities_keeps_bits_and_is_nearest(kept):
    y = nhjax.initial_state(
        LAGRANGIAN, jnp.asarray(Q), jnp.asarray(V), t=0.7, project=True, keep_v=kept
    )
    assert_kept(y.v, V, kept)
    assert_kept(y.q, Q, range(6))
    rows = affine_rows(0.7, Q)
    np.testing.assert_allclose(rows @ y.v, AFFINE * 0.7, atol=2e-14)
    expected = nearest_linear(MASS, rows, AFFINE * 0.7, V, kept)
    np.testing.assert_allclose(y.v, expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(y.p, MASS @ y.v, rtol=1e-13)


@pytest.mark.parametrize("given", ["v", "p"])
@pytest.mark.parametrize("system", [LAGRANGIAN, HAMILTONIAN], ids=["L", "H"])
def test_projection_keeps_velocities_and_momenta_in_both_forms(system, given):
    # The distance is measured in velocities for a Lagrangian and in momenta for a
    # Hamiltonian: both are the same number.
    u, kept = V if given == "v" else MASS @ V, (1, 3)
    y = nhjax.initial_state(
        system,
        jnp.asarray(Q),
        **{given: jnp.asarray(u), f"keep_{given}": kept},
        t=0.7,
        project=True,
    )
    assert_kept(getattr(y, given), u, kept)
    rows, metric = affine_rows(0.7, Q), MASS
    if given == "p":
        metric = np.linalg.inv(MASS)
        rows = rows @ metric
    expected = nearest_linear(metric, rows, AFFINE * 0.7, u, kept)
    np.testing.assert_allclose(getattr(y, given), expected, rtol=1e-10, atol=1e-11)
    np.testing.assert_allclose(y.p, MASS @ y.v, rtol=1e-11, atol=1e-12)
    assert np.max(np.abs(system.constraint_violation(0.7, y))) < 1e-13


def test_projection_with_kept_velocity_satisfies_nonlinear_constraint():
    mass = np.array([1.0, 3.0, 0.2, 2.0])
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ (jnp.asarray(mass) * v),
        nonholonomic=lambda t, q, v, args: jnp.stack(
            [v[0] ** 2 + v[1] ** 2 - v[2] ** 2, v[3] - v[0] * v[1]]
        ),
    )
    u = np.array([0.7, 0.4, 1.1, -0.2])
    y = nhjax.initial_state(
        system, jnp.zeros(4), jnp.asarray(u), project=True, keep_v=[0]
    )
    v = np.asarray(y.v)
    assert_kept(v, u, [0])
    np.testing.assert_allclose(v[0] ** 2 + v[1] ** 2, v[2] ** 2, rtol=1e-15)
    np.testing.assert_allclose(v[3], v[0] * v[1], rtol=1e-15)
    rows = np.array([[2 * v[0], 2 * v[1], -2 * v[2], 0.0], [-v[1], -v[0], 0.0, 1.0]])
    assert_stationary(np.diag(mass), rows, v - u, [0])

    def all_of(free):
        return np.concatenate([u[:1], free])

    def residual(free):
        w = all_of(free)
        return [w[0] ** 2 + w[1] ** 2 - w[2] ** 2, w[3] - w[0] * w[1]]

    scipys = minimize(
        lambda free: 0.5 * mass @ (all_of(free) - u) ** 2,
        u[1:],
        method="SLSQP",
        constraints={"type": "eq", "fun": residual},
        options={"ftol": 1e-15, "maxiter": 200},
    )
    np.testing.assert_allclose(v[1:], scipys.x, atol=1e-6)


def test_disc_with_kept_speed_rolls_at_that_speed():
    disc = VerticalRollingDisc(mass=4.0, roll_inertia=0.3, radius=0.7)
    v, q = jnp.array([3.0, 0.0, 0.0, 0.2]), jnp.zeros(4)
    free = nhjax.initial_state(disc.system, q, v, project=True)
    # Without `keep_v` the speed is shared between the mass and the inertia of the roll.
    np.testing.assert_allclose(free.v[0], 3.0 * 4.0 / (4.0 + 0.3 / 0.7**2), rtol=1e-14)
    y = nhjax.initial_state(disc.system, q, v, project=True, keep_v=[0, 3])
    np.testing.assert_allclose(y.v, [3.0, 0.0, 3.0 / 0.7, 0.2], rtol=1e-15)


def test_bicycle_with_kept_rates_runs_at_these_rates():
    # The gallery solves for the pitch and five rates without a projection.
    expected = WhippleBicycle.running(3.0, 0.2, -0.1, lean=0.1, steer=0.05)
    q = jnp.zeros(8).at[jnp.array([3, 5])].set(jnp.array([0.1, 0.05]))
    v = jnp.zeros(8).at[jnp.array([3, 5, 6])].set(jnp.array([0.2, -0.1, -10.0]))
    y = nhjax.initial_state(
        expected.system,
        q,
        v,
        project=True,
        keep_q=(0, 1, 2, 3, 5, 6, 7),
        keep_v=(3, 5, 6),
    )
    np.testing.assert_allclose(y.q, expected.q0, atol=1e-14)
    np.testing.assert_allclose(y.v, expected.v0, atol=1e-13)
    assert_kept(y.v, v, (3, 5, 6))
    assert_kept(y.q, q, (0, 1, 2, 3, 5, 6, 7))


# Positions ----------------------------------------------------------------------------


def test_projection_with_kept_positions_keeps_bits_and_is_nearest():
    q, v = np.array([0.3, 0.5, 0.9]), np.array([0.1, 0.2, 0.3])
    y = nhjax.initial_state(
        SPHERE, jnp.asarray(q), jnp.asarray(v), t=1.0, project=True, keep_q=0, keep_v=1
    )
    assert_kept(y.q, q, [0])
    assert_kept(y.v, v, [1])
    radius = 1.0 + 0.1 * np.sin(1.0)
    np.testing.assert_allclose(y.q @ y.q, radius**2, rtol=2e-16)
    mass, rows = np.diag([1.0, 2.0, 5.0]), 2 * np.asarray(y.q)[None]
    assert_stationary(mass, rows, np.asarray(y.q) - q, [0])
    right = np.array([2 * radius * 0.1 * np.cos(1.0)])
    expected = nearest_linear(mass, rows, right, v, [1])
    np.testing.assert_allclose(y.v, expected, atol=1e-14)


def test_projection_keeps_positions_at_origin():
    slopes = np.array([1.0, 2.0, 3.0])
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: jnp.asarray(slopes) @ q - 1.0,
    )
    q, v = jnp.array([0.0, 0.0, -0.0]), jnp.zeros(3)
    y = nhjax.initial_state(system, q, v, project=True, keep_q=[0, 2])
    assert_kept(y.q, q, [0, 2])
    np.testing.assert_allclose(y.q[1], 0.5, rtol=1e-15)


def closed(t, q, args):
    """A crank, a rod and a slider; q has their angles and the place of the slider."""
    return jnp.stack(
        [
            jnp.cos(q[0]) + 2.0 * jnp.cos(q[1]) - q[2],
            jnp.sin(q[0]) + 2.0 * jnp.sin(q[1]),
        ]
    )


CRANK = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v, holonomic=closed)
ANGLE = 0.4
ROD = -np.arcsin(np.sin(ANGLE) / 2)
SLIDER = np.cos(ANGLE) + 2 * np.cos(ROD)


@pytest.mark.parametrize(
    ("q", "kept"),
    [
        ([ANGLE, 0.0, 3.0], [0]),
        # Only the first constraint depends on the slider; the angles satisfy the other.
        ([ANGLE, ROD, 3.0], [0, 1]),
    ],
    ids=["crank", "crank and rod"],
)
def test_linkage_with_kept_crank_angle_is_closed(q, kept):
    y = nhjax.initial_state(
        CRANK,
        jnp.array(q),
        jnp.array([2.0, 0.0, 0.0]),
        project=True,
        keep_q=kept,
        keep_v=[0],
    )
    np.testing.assert_allclose(y.q, [ANGLE, ROD, SLIDER], rtol=1e-14)
    assert_kept(y.q, q, kept)
    rate = -np.cos(ANGLE) * 2.0 / (2 * np.cos(ROD))
    speed = -np.sin(ANGLE) * 2.0 - 2 * np.sin(ROD) * rate
    np.testing.assert_allclose(y.v, [2.0, rate, speed], rtol=1e-14)


# Groups -------------------------------------------------------------------------------


def test_projection_keeps_body_velocities_on_group():
    disc = RollingDisc(radius=0.5)
    y = nhjax.initial_state(
        disc.system, disc.q0, jnp.array([3.0, 0.1, 0.2, 0.0]), project=True, keep_v=0
    )
    np.testing.assert_allclose(y.v, [3.0, 0.0, 0.2, 6.0], atol=1e-15)
    assert y.v[0] == 3.0


PLANE = np.diag([2.0, 2.0, 0.5])


def plane_body(retraction):
    """A rod in the plane, one point of which stays on an inclined line."""
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ jnp.asarray(PLANE) @ v,
        holonomic=lambda t, q, args: q[1] + jnp.sin(q[2]) - 0.3 * q[0] - 0.5,
        manifold=nhjax.SE2(retraction),
    )


@pytest.mark.parametrize("kept", [(0,), (2,), (0, 1), (1, 2)])
@pytest.mark.parametrize(
    "retraction", [nhjax.Cayley(), nhjax.Exponential()], ids=["Cayley", "Exponential"]
)
def test_projection_keeps_coordinates_of_pose_in_plane(retraction, kept):
    system, group = plane_body(retraction), nhjax.SE2(retraction)
    q = np.array([0.2, 0.1, 0.4])
    y = nhjax.initial_state(
        system, jnp.asarray(q), jnp.zeros(3), project=True, keep_q=kept
    )
    assert_kept(y.q, q, kept)
    x, z, angle = np.asarray(y.q)
    np.testing.assert_allclose(z + np.sin(angle) - 0.3 * x, 0.5, atol=1e-15)
    act = jax.jit(lambda xi: group.act(jnp.asarray(q), xi))

    def conditions(xi):
        g = np.asarray(act(xi))
        on_line = g[1] + np.sin(g[2]) - 0.3 * g[0] - 0.5
        return np.concatenate([[on_line], (g - q)[list(kept)]])

    scipys = minimize(
        lambda xi: 0.5 * xi @ PLANE @ xi,
        np.zeros(3),
        method="SLSQP",
        constraints={"type": "eq", "fun": conditions},
        options={"ftol": 1e-16, "maxiter": 300},
    )
    np.testing.assert_allclose(y.q, act(scipys.x), atol=1e-6)


def top_on_a_sphere(manifold, place):
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: place(q) @ place(q) - 1.0,
        manifold=manifold,
    )


QUATERNION = np.array([0.5, 0.1, -0.7, 0.5])
PLACE = np.array([0.5, 0.6, 0.7])


@pytest.mark.parametrize(
    ("kind", "kept"),
    [
        ("product", (0, 1, 2, 3)),
        long("product", (4, 6)),
        ("SE3", (4,)),
        long("SE3", (0, 1, 2, 3)),
        long("SE3", (4, 5, 6)),
        long("SE3", (5, 6, 0, 1, 2, 3)),
    ],
)
def test_projection_keeps_attitude_or_position_in_space(kind, kept):
    # The constraint couples both: a point of the body stays on the sphere.
    def point(attitude, place):
        w, x, y, z = attitude
        third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        return place + 0.3 * jnp.stack(third)

    if kind == "SE3":
        system = top_on_a_sphere(nhjax.SE3(), lambda q: point(q[:4], q[4:]))
        q = jnp.concatenate([jnp.asarray(QUATERNION), jnp.asarray(PLACE)])
    else:
        manifold = nhjax.ProductGroup(nhjax.SO3(), nhjax.Euclidean(3))
        system = top_on_a_sphere(manifold, lambda q: point(*q))
        q = (jnp.asarray(QUATERNION), jnp.asarray(PLACE))
    v = jnp.array([0.3, -0.2, 0.1, 0.5, 0.4, 0.3])
    y = nhjax.initial_state(system, q, v, project=True, keep_q=kept)
    given, found = numbers(q), numbers(y.q)
    assert_kept(found, given, kept)
    assert abs(np.linalg.norm(found[:4]) - 1) < 1e-15
    assert np.max(np.abs(system.constraint_violation(0.0, y))) < 1e-14
    assert np.max(np.abs(found - given)) > 1e-3


def test_kept_quaternion_not_of_unit_length_is_refused():
    body = systems.FreeRigidBody()
    q, v = 1.1 * jnp.asarray(QUATERNION), jnp.zeros(3)
    message = (
        r"`q` with its kept numbers = \[ 0\.55 .*not an element of the group.*fewer "
        r"components than q\[0\], q\[1\], q\[2\] and q\[3\] in `keep_q`"
    )
    with pytest.raises(nhjax.ConstraintViolationError, match=message):
        nhjax.initial_state(body.system, q, v, project=True, keep_q=range(4))


def test_kept_number_of_quaternion_out_of_reach_is_refused():
    # At the identity, every rotation changes the real part, but not to first order.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: q[1] - 0.1,
        manifold=nhjax.SO3(),
    )
    q = jnp.array([1.0, 0.0, 0.0, 0.0])
    with pytest.raises((nhjax.ConstraintViolationError, nhjax.NewtonError)):
        nhjax.initial_state(system, q, jnp.zeros(3), project=True, keep_q=[0])
    y = nhjax.initial_state(system, q, jnp.zeros(3), project=True, keep_q=[2, 3])
    np.testing.assert_allclose(y.q, [np.sqrt(0.99), 0.1, 0.0, 0.0], rtol=1e-15)


# Choices that leave nothing or little free --------------------------------------------


def test_projection_with_all_components_kept_accepts_consistent_state():
    bicycle = WhippleBicycle.running(3.0, 0.2, lean=0.1)
    y = nhjax.initial_state(
        bicycle.system,
        bicycle.q0,
        bicycle.v0,
        project=True,
        keep_q=range(8),
        keep_v=range(8),
    )
    assert_kept(y.q, bicycle.q0, range(8))
    assert_kept(y.v, bicycle.v0, range(8))


def test_projection_with_few_free_components_accepts_consistent_choice():
    u = jnp.array([2.0, 0.5, 1.0, 0.0])
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        nonholonomic=lambda t, q, v, args: jnp.stack([v[0] - 2 * v[2], v[1] + v[3]]),
    )
    y = nhjax.initial_state(system, jnp.zeros(4), u, project=True, keep_v=[0, 1, 2])
    np.testing.assert_array_equal(y.v, [2.0, 0.5, 1.0, -0.5])


@pytest.mark.parametrize("kept", [(0,), (3,), (0, 3)])
def test_projection_with_kept_components_satisfies_redundant_constraints(kept):
    doubled = nhjax.LagrangianSystem(
        LAGRANGIAN.lagrangian,
        nonholonomic=lambda t, q, v, args: jnp.concatenate(
            [affine(t, q, v, args), 2 * affine(t, q, v, args)[:1]]
        ),
        constraints="redundant",
    )
    start = [
        nhjax.initial_state(
            system, jnp.asarray(Q), jnp.asarray(V), t=0.7, project=True, keep_v=kept
        )
        for system in (LAGRANGIAN, doubled)
    ]
    np.testing.assert_allclose(start[1].v, start[0].v, rtol=1e-11, atol=1e-12)
    assert_kept(start[1].v, V, kept)


def test_projection_with_tiny_coefficient_of_free_component_is_refused():
    # The cosine of π/2 is 6e-17 and not zero: a speed of 1e16 would satisfy this.
    skate = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        nonholonomic=lambda t, q, v, args: jnp.cos(q[2]) * v[1] - jnp.sin(q[2]) * v[0],
    )
    q, v = jnp.array([0.0, 0.0, np.pi / 2]), jnp.array([1.0, 0.0, 0.0])
    with pytest.raises(nhjax.ConstraintViolationError, match=r"leave v\[0\] out of"):
        nhjax.initial_state(skate, q, v, project=True, keep_v=[0])


@pytest.mark.parametrize("unit", [1e-12, 1e-6, 1.0, 1e6, 1e12])
def test_projection_with_kept_components_does_not_depend_on_units(unit):
    # Two coordinates in other units: their masses and rows change.
    scale = np.array([unit, 1.0, unit, 1.0, 1.0, 1.0])
    metric, rows = MASS * scale[:, None] * scale, ROWS * scale
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ jnp.asarray(metric) @ v,
        nonholonomic=lambda t, q, v, args: jnp.asarray(rows) @ v,
    )
    u = jnp.asarray(V / scale)
    y = nhjax.initial_state(system, jnp.zeros(6), u, project=True, keep_v=[0, 4])
    expected = nearest_linear(MASS, ROWS, np.zeros(3), V, [0, 4])
    assert_kept(y.v, u, [0, 4])
    np.testing.assert_allclose(y.v * scale, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-30, 1e-8, 1e8])
def test_projection_keeps_velocities_of_any_size(size):
    u = size * jnp.asarray(V)
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ jnp.asarray(MASS) @ v,
        nonholonomic=lambda t, q, v, args: jnp.asarray(ROWS) @ v,
    )
    y = nhjax.initial_state(system, jnp.zeros(6), u, project=True, keep_v=[2])
    assert_kept(y.v, u, [2])
    expected = nearest_linear(MASS, ROWS, np.zeros(3), V, [2])
    np.testing.assert_allclose(y.v, size * expected, rtol=1e-10, atol=1e-11 * size)


def test_projection_with_kept_components_accepts_round_off_near_zero():
    # 0.1 + 0.2 - 0.3 is round-off; the same floor allows it as without `keep_q`.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v),
        holonomic=lambda t, q, args: q[0] - q[1] + (0.1 + 0.2 - 0.3),
    )
    kept = {"project": True, "keep_q": range(2)}
    y = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2), **kept)
    np.testing.assert_array_equal(y.q, 0)
    with pytest.raises(nhjax.ConstraintViolationError, match=r"keep_q.*determine Γ"):
        nhjax.initial_state(system, jnp.array([1e-11, 0.0]), jnp.ones(2), **kept)


def test_projection_in_float32_keeps_components():
    q = jnp.array([0.3, 0.5, 0.9], jnp.float32)
    v = jnp.array([0.1, 0.2, 0.3], jnp.float32)
    y = nhjax.initial_state(SPHERE, q, v, project=True, keep_q=[1], keep_v=[0])
    assert y.q.dtype == jnp.float32
    np.testing.assert_array_equal(y.q[1], q[1])
    np.testing.assert_array_equal(y.v[0], v[0])
    np.testing.assert_allclose(y.q @ y.q, 1.0, rtol=3e-7)
    np.testing.assert_allclose(y.q @ y.v, 0.1, rtol=1e-6)


# Transformations ----------------------------------------------------------------------


def kept_start(q, v, t=0.3, **options):
    return nhjax.initial_state(
        SPHERE, q, v, t=t, project=True, keep_q=(0,), keep_v=(1,), **options
    )


def test_projection_with_kept_components_under_jit_and_vmap_agrees():
    q = jnp.asarray(RNG.uniform(0.3, 0.6, size=(4, 3)))
    v = jnp.asarray(RNG.normal(size=(4, 3)))
    batch = jax.jit(jax.vmap(kept_start))(q, v)
    assert_kept(batch.q.T, q.T, [0])
    assert_kept(batch.v.T, v.T, [1])
    for i in range(4):
        one = kept_start(q[i], v[i])
        jax.tree.map(
            lambda x, y, i=i: np.testing.assert_allclose(x[i], y, atol=1e-14),
            batch,
            one,
        )


def test_projection_with_kept_components_has_gradients_of_differences():
    q, v = jnp.array([0.3, 0.5, 0.9]), jnp.array([0.1, 0.2, 0.3])

    @jax.jit
    def outcome(z):
        y = kept_start(z[:3], z[3:6], t=z[6])
        return jnp.concatenate([y.q, y.v, y.p, y.multiplier])

    z = jnp.concatenate([q, v, jnp.array([0.3])])
    forward, reverse = jax.jacfwd(outcome)(z), jax.jacrev(outcome)(z)
    h = 1e-5
    differences = np.stack(
        [(outcome(z + h * e) - outcome(z - h * e)) / (2 * h) for e in jnp.eye(7)], 1
    )
    np.testing.assert_allclose(forward, differences, atol=1e-7)
    np.testing.assert_allclose(reverse, forward, atol=1e-12)
    np.testing.assert_array_equal(forward[0], jnp.eye(7)[0])
    np.testing.assert_array_equal(forward[4], jnp.eye(7)[4])


def test_projection_with_kept_components_on_group_has_exact_gradients():
    system = plane_body(nhjax.Cayley())

    @jax.jit
    def outcome(q):
        keep = {"project": True, "keep_q": (0,), "keep_v": (2,)}
        y = nhjax.initial_state(system, q, jnp.ones(3), **keep)
        return jnp.concatenate([y.q, y.v])

    q, h = jnp.array([0.2, 0.1, 0.4]), 1e-5
    differences = np.stack(
        [(outcome(q + h * e) - outcome(q - h * e)) / (2 * h) for e in jnp.eye(3)], 1
    )
    np.testing.assert_allclose(jax.jacrev(outcome)(q), differences, atol=1e-8)


def test_projection_determined_by_kept_components_has_exact_gradient():
    disc = VerticalRollingDisc(radius=0.7)

    def roll(speed, radius):
        system = eqx.tree_at(lambda x: x.radius, disc, radius).system
        v = jnp.zeros(4).at[0].set(speed)
        keep = {"project": True, "keep_v": (0, 1, 3)}
        return nhjax.initial_state(system, jnp.zeros(4), v, **keep).v[2]

    slopes = jax.jit(jax.grad(roll, (0, 1)))(3.0, jnp.asarray(0.7))
    np.testing.assert_allclose(slopes, [1 / 0.7, -3.0 / 0.7**2], rtol=1e-13)


# Mistakes -----------------------------------------------------------------------------


def blade(t, q, v, args):
    return jnp.stack([v[0] - v[2], v[0] + 2.0 * v[1] - 1.0])


BLADE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v,
    nonholonomic=blade,
    coordinates=("x", "y", "z", "s"),
)


@pytest.mark.parametrize(
    ("v", "kept", "message", "released"),
    [
        (
            [3.0, 1.0, 3.0, 0.0],
            [0, 1],
            r"1 of 2 nonholonomic.*: Φ\[1\] = 4 \(allowed .*`keep_v` keeps determine "
            r"Φ\[1\]: leave v\[0\] \(x\) or v\[1\] \(y\) out of `keep_v`, or keep "
            r"values that satisfy the constraints\.",
            [["x"], ["y"]],
        ),
        (
            [3.0, 1.0, 3.0, 0.0],
            ["z", "y"],
            r"determine a combination of Φ\[0\] and Φ\[1\]: leave v\[1\] \(y\) or "
            r"v\[2\] \(z\) out",
            [["z"], ["y"]],
        ),
        (
            [3.0, 1.0, 2.0, 0.0],
            ["s", "x", "y", "z"],
            r"2 of 2 .*determine Φ\[0\] and Φ\[1\]: leave more than one of v\[0\] "
            r"\(x\), v\[1\] \(y\) and v\[2\] \(z\) out",
            [["x", "y"], ["y", "z"], ["z", "x"]],
        ),
        (
            [3.0, 1.0, 3.0, 0.0],
            ["x", "y", "z"],
            r"determine Φ\[1\]: leave v\[1\] \(y\) out",
            [["y"]],
        ),
    ],
)
def test_kept_velocities_that_violate_constraint_are_named(v, kept, message, released):
    v = jnp.array(v)

    def start(v, kept=kept):
        return nhjax.initial_state(BLADE, jnp.zeros(4), v, project=True, keep_v=kept)

    with pytest.raises(nhjax.ConstraintViolationError, match=message):
        start(v)
    with pytest.raises(RuntimeError, match=f"ConstraintViolationError: .*{message}"):
        jax.block_until_ready(jax.jit(start)(v))
    # It is enough to leave out what the message names.
    places = {"x": 0, "y": 1, "z": 2, "s": 3}
    for names in released:
        rest = {places.get(x, x) for x in kept} - {places[x] for x in names}
        assert_kept(start(v, rest).v, v, rest)


def test_kept_position_that_violates_constraint_is_named():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: jnp.stack([q[0] + q[1] - 1.0, q[2] ** 2 - 4.0]),
    )
    q = jnp.array([0.5, 0.2, 3.0])
    message = (
        r"1 of 2 holonomic .*: Γ\[1\] = 5 .*`keep_q` keeps determine Γ\[1\]: leave "
        r"q\[2\] out of `keep_q`"
    )
    with pytest.raises(nhjax.ConstraintViolationError, match=message):
        nhjax.initial_state(system, q, jnp.zeros(3), project=True, keep_q=[0, 2])


def test_kept_components_of_tuple_are_named_by_part():
    disc = RollingDisc()
    system = nhjax.LagrangianSystem(
        disc.lagrangian,
        holonomic=lambda t, q, args: q[1][0] + q[0][2] - 1.0,
        manifold=disc.manifold,
    )
    message = r"determine Γ\[0\]: leave q\[0\]\[2\] or q\[1\]\[0\] out of `keep_q`"
    with pytest.raises(nhjax.ConstraintViolationError, match=message):
        nhjax.initial_state(
            system, disc.q0, jnp.zeros(4), project=True, keep_q=(0, 2, 3)
        )


def test_kept_momenta_of_lagrangian_that_violate_constraint_are_named():
    message = r"determine Φ\[0\]: leave p\[0\] \(x\) or p\[2\] \(z\) out of `keep_p`"
    with pytest.raises(nhjax.ConstraintViolationError, match=message):
        nhjax.initial_state(
            BLADE,
            jnp.zeros(4),
            p=jnp.array([3.0, 0.0, 1.0, 0.0]),
            project=True,
            keep_p=(0, 2),
        )


def test_kept_velocity_that_excludes_nonlinear_constraint_is_refused():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, nonholonomic=lambda t, q, v, args: v @ v - 1
    )
    message = r"the constraints, or keep fewer components than v\[0\] \(`keep_v`\)\."
    with pytest.raises(nhjax.NewtonError, match=message):
        nhjax.initial_state(
            system, jnp.zeros(3), jnp.array([2.0, 0.1, 0.2]), project=True, keep_v=0
        )


def test_kept_velocities_that_violate_constraint_without_throw_are_nan():
    v = jnp.array([[3.0, -1.0, 9.0, 0.0], [3.0, 1.0, 3.0, 0.0]])

    def start(v):
        keep = {"project": True, "keep_v": (0, 1)}
        return nhjax.initial_state(BLADE, jnp.zeros(4), v, throw=False, **keep)

    y = jax.jit(jax.vmap(start))(v)
    np.testing.assert_array_equal(y.v[0], [3.0, -1.0, 3.0, 0.0])
    assert np.all(np.isnan(y.v[1]))


ON_SO3 = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v, manifold=nhjax.SO3(), coordinates=("a", "b", "c")
)


@pytest.mark.parametrize(
    ("options", "exception", "message"),
    [
        (
            {"keep_v": [4]},
            ValueError,
            r"`keep_v` has the index 4, but `v` has 4 .*: pass 0 to 3",
        ),
        ({"keep_q": (-5,)}, ValueError, r"`keep_q` has the index -5, but `q` has 4 "),
        (
            {"keep_v": [0, -4]},
            ValueError,
            r"`keep_v` = \[0, -4\] has v\[0\] more than on",
        ),
        ({"keep_v": ("x", 0)}, ValueError, r"`keep_v`.* has v\[0\] more than once"),
        ({"keep_v": "w"}, ValueError, r"`keep_v` has the name 'w'.* are x, y, z, s\."),
        ({"keep_v": 1.0}, TypeError, r"`keep_v` must be indices or names.*got 1\.0 of"),
        ({"keep_q": [None]}, TypeError, r"`keep_q` must be indices or names.*got None"),
        ({"keep_q": {"x": 1.0}}, TypeError, r"`keep_q` must be .*got \{'x': 1\.0\}"),
        (
            {"keep_q": [[0, 1]]},
            TypeError,
            r"`keep_q` must be .*got \[0, 1\] of type list",
        ),
        ({"keep_q": True}, TypeError, r"`keep_q` must be .*not bools.*flatnonzero"),
        ({"keep_v": [True] * 4}, TypeError, r"`keep_v` .*not bools.*flatnonzero"),
        ({"keep_v": np.ones(4, bool)}, TypeError, r"`keep_v` .*not bools.*flatnonzero"),
        ({"keep_v": jnp.ones(2)}, TypeError, r"`keep_v` must be indices or names"),
        ({"keep_p": [0]}, ValueError, r"`keep_p` chooses.*`v` is given: use `keep_v`"),
        ({"keep_v": [0], "project": False}, ValueError, r"`keep_v`.*`project=True`"),
        (
            {"keep_q": [0], "project": False},
            ValueError,
            r"`keep_q`.*all of `q` is kept",
        ),
    ],
)
def test_kept_components_of_wrong_choice_name_the_argument(options, exception, message):
    v = jnp.array([3.0, -1.0, 3.0, 0.0])
    with pytest.raises(exception, match=message):
        nhjax.initial_state(BLADE, jnp.zeros(4), v, **{"project": True, **options})


def test_names_of_kept_components_without_coordinates_are_refused():
    given = {"project": True, "keep_v": ("x",)}
    with pytest.raises(ValueError, match=r"no names: pass indices.*coordinates=\("):
        nhjax.initial_state(SPHERE, jnp.ones(3), jnp.zeros(3), **given)
    quaternion = jnp.asarray(QUATERNION)
    message = r"`keep_q` has the name 'a', but the 4 numbers of `q` are not the 3 coord"
    with pytest.raises(ValueError, match=message):
        nhjax.initial_state(
            ON_SO3, quaternion, jnp.zeros(3), project=True, keep_q=["a"]
        )
    misnamed = nhjax.LagrangianSystem(SPHERE.lagrangian, coordinates=("x", "y"))
    with pytest.raises(ValueError, match="the system has 2 names of `coordinates`"):
        nhjax.initial_state(misnamed, jnp.ones(3), jnp.zeros(3), **given)


def test_traced_choice_of_kept_components_is_refused():
    def start(kept):
        v = jnp.array([3.0, -1.0, 3.0, 0.0])
        return nhjax.initial_state(BLADE, jnp.zeros(4), v, project=True, keep_v=kept)

    with pytest.raises(TypeError, match=r"`keep_v` is a traced array.*tuple of ints"):
        jax.jit(start)(jnp.array([0, 1]))
    y = start(jnp.array([0, 1]))
    np.testing.assert_array_equal(y.v, [3.0, -1.0, 3.0, 0.0])


def test_empty_choice_of_kept_components_has_no_effect():
    v = jnp.array([3.0, 0.0, 0.0, 1.0])
    given = BLADE, jnp.zeros(4), v
    y = nhjax.initial_state(*given, project=True)
    for nothing in ((), [], np.array([], int)):
        same = nhjax.initial_state(*given, project=True, keep_q=nothing, keep_v=nothing)
        np.testing.assert_array_equal(same.v, y.v)
