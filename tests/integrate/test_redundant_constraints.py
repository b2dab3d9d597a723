"""Redundant constraints: the motion of independent ones, and chosen reactions."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from nhjax import systems
from support import orders, paper_equations
from support.long import long


THREE = nhjax.LobattoIIIAB(3)
GRAVITY, MASSES = 9.81, np.array([1.0, 1.0, 0.3])
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.2]])
RECORDED = nhjax.SaveAt(t0=True, steps=True, dense=True)


# A plate on parallel rods of one length: q = (x, y, φ), (x, y) its first corner. It has
# three rods; two would already leave it the one degree of freedom of a pendulum.


def plate(rods, constraints: Literal["independent", "redundant"] = "independent"):
    def lagrangian(t, q, v, args):
        return 0.5 * v @ (MASSES * v) - GRAVITY * q[1]

    def holonomic(t, q, args):
        cos, sin = jnp.cos(q[2]), jnp.sin(q[2])
        turned = jnp.asarray(CORNERS) @ jnp.array([[cos, sin], [-sin, cos]])
        arms = q[None, :2] + turned - CORNERS
        return (jnp.sum(arms**2, axis=1) - 1.0)[jnp.asarray(rods)]

    return nhjax.LagrangianSystem(
        lagrangian, holonomic=holonomic, constraints=constraints
    )


TWO_RODS, THREE_RODS = plate((0, 1)), plate((0, 1, 2), "redundant")
ANGLE, RATE = 0.3, 1.5
PLACE = np.array([np.sin(ANGLE), -np.cos(ANGLE), 0.0])
ALONG = np.array([np.cos(ANGLE), np.sin(ANGLE), 0.0])


def start(system):
    return nhjax.initial_state(system, jnp.asarray(PLACE), jnp.asarray(RATE * ALONG))


@pytest.fixture(scope="module")
def recorded():
    return nhjax.integrate(
        THREE_RODS, THREE, start(THREE_RODS), dt=0.02, num_steps=40, saveat=RECORDED
    )


def rods_of(q):
    """The constraints at q and their derivatives, in NumPy."""
    cos, sin = np.cos(q[2]), np.sin(q[2])
    rods = q[:2] + CORNERS @ np.array([[cos, sin], [-sin, cos]]) - CORNERS
    turning = CORNERS @ np.array([[-sin, cos], [-cos, -sin]])
    rows = np.column_stack([rods, np.sum(rods * turning, axis=1)])
    return np.sum(rods**2, axis=1) - 1.0, 2 * rows


def test_redundant_constraints_satisfy_the_discrete_equations(recorded):
    pair, h = paper_equations.lobatto(3), 0.02
    records, weight = recorded.interpolation.records, np.array([0, -GRAVITY, 0])
    for k in range(0, 40, 3):
        stage = [np.asarray(x[k]) for x in (records.velocity, records.multiplier)]
        (velocity, multiplier), p = stage, np.asarray(recorded.ys.p[k])
        places = np.asarray(recorded.ys.q[k]) + h * pair.a @ velocity
        values, rows = zip(*map(rods_of, places), strict=True)
        force = weight + np.einsum("im,imn->in", multiplier, rows)
        np.testing.assert_allclose(values, 0, atol=1e-13)
        expected = p + h * pair.a_hat @ force
        np.testing.assert_allclose(MASSES * velocity, expected, atol=1e-13)
        end = np.asarray(recorded.ys.p[k + 1])
        np.testing.assert_allclose(end, p + h * pair.b @ force, atol=1e-13)
        np.testing.assert_allclose(rows[-1] @ (end / MASSES), 0, atol=1e-13)


def test_redundant_rod_does_not_change_the_motion(recorded):
    saveat = nhjax.SaveAt(t0=True, steps=True)
    sol = nhjax.integrate(
        TWO_RODS, THREE, start(TWO_RODS), dt=0.02, num_steps=40, saveat=saveat
    )
    np.testing.assert_allclose(recorded.ys.q, sol.ys.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(recorded.ys.v, sol.ys.v, rtol=0, atol=1e-12)
    assert int(recorded.stats["num_redundant"]) == 1
    assert int(sol.stats["num_redundant"]) == 0


def test_redundant_constraints_keep_the_order():
    counts = (20, 40, 80)
    lanes = orders.trajectories(THREE_RODS, THREE, start(THREE_RODS), counts)
    ends = [jax.tree.map(lambda x: x[-1], lane) for lane in lanes]
    (theta, omega) = solve_ivp(
        lambda t, x: [x[1], -GRAVITY * np.sin(x[0])],
        (0, orders.DURATION),
        [ANGLE, RATE],
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    place = np.array([np.sin(theta), -np.cos(theta), 0.0])
    moving = omega * np.array([np.cos(theta), np.sin(theta), 0.0])
    for name, exact in (("q", place), ("v", moving)):
        errors = [np.max(np.abs(getattr(y, name) - exact)) for _, y, _ in ends]
        orders.assert_order(4, counts, errors, orders.SCIPY_FLOOR)


def test_redundant_multipliers_have_the_smallest_norm():
    motion = nhjax.motion(THREE_RODS, 0.0, start(THREE_RODS))
    _, rows = rods_of(PLACE)
    # The unknowns |B_a| λ_a, in the metric M⁻¹, have the least norm.
    sizes = np.sqrt(np.sum(rows**2 / MASSES, axis=1))
    expected, *_ = np.linalg.lstsq((rows / sizes[:, None]).T, motion.reaction)
    np.testing.assert_allclose(sizes * motion.multiplier, expected, atol=1e-12)
    alone = nhjax.motion(TWO_RODS, 0.0, start(TWO_RODS))
    np.testing.assert_allclose(motion.reaction, alone.reaction, atol=1e-13)
    np.testing.assert_allclose(motion.acceleration, alone.acceleration, atol=1e-13)
    assert not np.any(motion.is_unique)
    assert np.all(alone.is_unique)


def test_redundant_constraints_project_a_nearby_state():
    q = jnp.asarray(PLACE + np.array([0.05, -0.02, 0.04]))
    v = jnp.asarray([1.0, 0.2, -0.1])
    got, expected = (
        nhjax.initial_state(system, q, v, project=True)
        for system in (THREE_RODS, TWO_RODS)
    )
    np.testing.assert_allclose(got.q, expected.q, atol=1e-14)
    np.testing.assert_allclose(got.v, expected.v, atol=1e-14)


@pytest.mark.long
def test_redundant_rod_does_not_change_gradients():
    def loss(system, count, x):
        place = jnp.stack([jnp.sin(x[0]), -jnp.cos(x[0]), 0.0 * x[0]])
        v = x[1] * jnp.stack([jnp.cos(x[0]), jnp.sin(x[0]), 0.0 * x[0]])
        y0 = nhjax.State(place, v, MASSES * v, jnp.zeros(count))
        method = nhjax.LobattoIIIAB(2)
        y = nhjax.integrate(system, method, y0, dt=0.1 * x[1], num_steps=8).ys
        return jnp.sum(jnp.sin(y.q)) + jnp.sum(y.v)

    (value, slope), (expected, rate) = (
        jax.jit(jax.value_and_grad(lambda x, s=system, k=count: loss(s, k, x)))(
            jnp.array([0.3, 0.5])
        )
        for system, count in ((THREE_RODS, 3), (TWO_RODS, 2))
    )
    np.testing.assert_allclose(value, expected, rtol=1e-13)
    np.testing.assert_allclose(slope, rate, rtol=1e-12)


# A constraint that is written twice ---------------------------------------------------

LINKAGE = systems.FourBar.turning(0.3, 20.0)


def twice(t, q, args):
    rows = LINKAGE.holonomic(t, q, args)
    return jnp.concatenate([rows, 3.1 * rows[:1]])


DOUBLED = nhjax.LagrangianSystem(
    LINKAGE.lagrangian,
    holonomic=twice,
    force=LINKAGE.force,
    constraints="redundant",
)
MOMENTUM = DOUBLED.momentum(0.0, LINKAGE.q0, LINKAGE.v0)


def test_redundant_copy_of_a_constraint_does_not_change_a_linkage():
    one, other = (
        nhjax.integrate(
            system,
            THREE,
            nhjax.State(LINKAGE.q0, LINKAGE.v0, MOMENTUM, jnp.zeros(count)),
            dt=1e-3,
            num_steps=20,
        )
        for system, count in ((LINKAGE.system, 2), (DOUBLED, 3))
    )
    np.testing.assert_allclose(one.ys.q, other.ys.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(one.ys.v, other.ys.v, rtol=0, atol=1e-12)


def test_redundant_constraints_leave_other_reactions_unique():
    y = nhjax.State(LINKAGE.q0, LINKAGE.v0, MOMENTUM, jnp.zeros(3))
    motion = nhjax.motion(DOUBLED, 0.0, y)
    np.testing.assert_array_equal(motion.is_unique, [False, True, False])
    # Both copies carry the same part, whatever units they are written in.
    shared = motion.reaction_of_each
    np.testing.assert_allclose(shared[0], shared[2], rtol=1e-10)
    report = nhjax.check_system(DOUBLED, y.q, y.v)
    assert (report.num_redundant, report.degrees_of_freedom) == (1, 1)
    assert report.compatibility_condition < 10
    assert "reactions not unique           Γ[0], Γ[2]" in str(report)


# Nonholonomic constraints, momenta, and the closures ----------------------------------


def hamiltonian(t, q, p, args):
    return 0.5 * p @ p + 0.5 * (q[0] ** 2 + q[1] ** 2)


def knife(t, q, p, args):
    return p[2] - q[1] * p[0]


def knives(t, q, p, args):
    return jnp.stack([knife(t, q, p, args), -2.5 * knife(t, q, p, args)])


@pytest.mark.parametrize("closure", ["symmetric", "propagated"])
def test_redundant_nonholonomic_constraints_run(closure):
    q, p = jnp.array([1.0, 0.5, 0.0]), jnp.array([0.3, 1.0, 0.15])
    ends = []
    for system in (
        nhjax.HamiltonianSystem(hamiltonian, nonholonomic=knife),
        nhjax.HamiltonianSystem(
            hamiltonian, nonholonomic=knives, constraints="redundant"
        ),
    ):
        y0 = nhjax.initial_state(system, q, p=p)
        method = nhjax.LobattoIIIAB(2, closure)
        solver = nhjax.Newton() if closure == "propagated" else nhjax.SimplifiedNewton()
        ends.append(
            nhjax.integrate(
                system, method, y0, dt=0.1, num_steps=20, stage_solver=solver
            ).ys
        )
    one, two = ends
    np.testing.assert_allclose(one.q, two.q, atol=1e-12)
    np.testing.assert_allclose(one.p, two.p, atol=1e-12)
    one, two = one.multiplier[0], two.multiplier[0]
    np.testing.assert_allclose(np.asarray(two) @ [1.0, -2.5], one[0], atol=1e-11)


# Nonholonomic constraints that follow from holonomic ones ----------------------------


def on_a_sphere(rows, form="lagrangian"):
    """A particle on a sphere with a blade; its velocity constraints repeat the sphere.

    The rows are the blade, the rate of the sphere times its radius, and their sum.
    """

    def given(t, q, u, args):
        blade, rate = u[0] - 0.3 * q[2] * u[1], q @ u
        return jnp.stack([blade, rate, blade + rate])[jnp.asarray(rows)]

    functions = {
        "nonholonomic": given,
        "holonomic": lambda t, q, args: jnp.sqrt(q @ q) - 1.0,
        "constraints": "redundant" if len(rows) > 1 else "independent",
    }
    if form == "lagrangian":
        return nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * v @ v - q[2], **functions
        )
    return nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p + q[2], **functions
    )


def run_on_a_sphere(rows, form, closure):
    system = on_a_sphere(rows, form)
    q, u = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.1, 0.5, 0.0])
    given: dict[str, Any] = {"v" if form == "lagrangian" else "p": u}
    y0 = nhjax.initial_state(system, q, project=True, **given)
    method = nhjax.LobattoIIIAB(3, closure)
    return system, nhjax.integrate(system, method, y0, dt=0.05, num_steps=40)


@pytest.mark.parametrize(
    ("form", "closure"),
    [long("lagrangian", "symmetric"), ("hamiltonian", "consistent")],
)
def test_redundant_rate_of_a_constraint_does_not_change_the_motion(form, closure):
    _, one = run_on_a_sphere((0,), form, closure)
    system, two = run_on_a_sphere((0, 1), form, closure)
    for name in ("q", "v", "p"):
        got, expected = getattr(two.ys, name), getattr(one.ys, name)
        np.testing.assert_allclose(got, expected, atol=1e-12)
    blade, rate, sphere = two.ys.multiplier[0]
    np.testing.assert_allclose([blade, sphere], one.ys.multiplier[0], atol=1e-11)
    np.testing.assert_allclose(rate, 0, atol=1e-12)
    assert int(two.stats["num_redundant"]) == 1
    y = jax.tree.map(lambda x: x[-1], two.ys)
    unique = nhjax.motion(system, 2.0, y).is_unique
    np.testing.assert_array_equal(unique, [True, False, False])


def sphere_with_a_blade(t, x):
    """The rates of (q, v), with reactions from the constraints on accelerations."""
    q, v = x[:3], x[3:]
    rows = np.array([[1.0, -0.3 * q[2], 0.0], q])
    load = np.array([0.0, 0.0, -1.0])
    hidden = np.array([-0.3 * v[2] * v[1], v @ v])
    multiplier = np.linalg.solve(rows @ rows.T, -hidden - rows @ load)
    return np.concatenate([v, load + multiplier @ rows])


def test_redundant_rate_leaves_independent_rows_enforced_with_the_order():
    # The rate repeats the sphere, so its sum with the blade only adds the blade.
    counts = (10, 20, 40)
    q, v = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.1, 0.5, 0.0])
    system = on_a_sphere((1, 2))
    y0 = nhjax.initial_state(system, q, v, project=True)
    lanes = orders.trajectories(system, THREE, y0, counts)
    ends = [jax.tree.map(lambda x: x[-1], lane) for lane in lanes]
    exact = solve_ivp(
        sphere_with_a_blade,
        (0, orders.DURATION),
        np.concatenate([y0.q, y0.v]),
        method="DOP853",
        rtol=1e-13,
        atol=1e-13,
    ).y[:, -1]
    for name, expected in (("q", exact[:3]), ("v", exact[3:])):
        errors = [np.max(np.abs(getattr(y, name) - expected)) for _, y, _ in ends]
        orders.assert_order(4, counts, errors, orders.SCIPY_FLOOR)
    blade = [1.0, -0.3 * y0.q[2], 0.0]
    np.testing.assert_allclose(np.dot(blade, y0.v), 0, atol=1e-15)


# What is refused ----------------------------------------------------------------------

NAMED = r"fails for holonomic\[0\], holonomic\[1\] and holonomic\[2\]\).*redundant"


@pytest.mark.parametrize(
    "call",
    [
        lambda system, y: nhjax.initial_state(system, y.q, y.v),
        lambda system, y: nhjax.integrate(system, THREE, y, dt=0.1, num_steps=2),
        lambda system, y: nhjax.motion(system, 0.0, y),
    ],
    ids=["initial_state", "integrate", "motion"],
)
def test_redundant_constraints_without_the_option_raise(call):
    with pytest.raises(nhjax.DependentConstraintsError, match=NAMED):
        call(plate((0, 1, 2)), start(THREE_RODS))


def test_redundant_reactions_under_jit_are_nan():
    motion = jax.jit(lambda y: nhjax.motion(plate((0, 1, 2)), 0.0, y))
    assert np.all(np.isnan(motion(start(THREE_RODS)).multiplier))


def test_redundant_constraints_for_an_instant_only_fail():
    # A line and a curve that touches it, from where they touch.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: jnp.stack([q[1], q[1] - q[0] ** 3]),
        constraints="redundant",
    )
    y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.array([1.0, 0.0, 0.0]))
    with pytest.raises(nhjax.IntegrationError, match=r"step 0: .*contradict"):
        nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=2)


def test_redundant_nonholonomic_rate_of_holonomic_constraint_raises():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        nonholonomic=lambda t, q, v, args: jnp.stack([v[0], q @ v]),
        holonomic=lambda t, q, args: q @ q - 1.0,
    )
    message = r"nonholonomic\[1\] and holonomic\[0\]\).*follows from holonomic ones"
    with pytest.raises(nhjax.DependentConstraintsError, match=message):
        nhjax.initial_state(system, jnp.array([0.6, 0.0, 0.8]), jnp.zeros(3))


def test_redundant_option_of_unknown_kind_raises():
    wrong: Any = "doubled"
    with pytest.raises(ValueError, match="`constraints` must be one of 'independent'"):
        nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v, constraints=wrong)
