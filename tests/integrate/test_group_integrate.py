"""The time loop on groups: batches, dense output, precision, and symmetry of steps."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt, systems
from support.helpers import SideBySide
from support.long import exhaustive, long
from support.own_groups import Heisenberg, HeisenbergBySecondKind


BALL = systems.TurntableBall()
METHOD = nhjax.LobattoIIIAB(3)
EVERY = SaveAt(t0=True, steps=True)


def largest(difference):
    return max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(difference))


def run(example, method=METHOD, y0=None, **options):
    y0 = example.initial_state() if y0 is None else y0
    return nhjax.integrate(example.system, method, y0, **options)


def test_batch_on_a_product_of_groups_equals_single_runs():
    def one(spin):
        ball = systems.TurntableBall.rolling((0.3, -0.2), (0.2, 0.1), spin)
        return run(ball, y0=ball.initial_state(), dt=0.1, num_steps=10, saveat=EVERY).ys

    spins = jnp.array([-0.5, 0.0, 0.7])
    batch = jax.jit(jax.vmap(one))(spins)
    single = jax.jit(one)
    for lane, spin in enumerate(spins):
        member = jax.tree.map(lambda x, lane=lane: x[lane], batch)
        difference = jax.tree.map(jnp.subtract, member, single(spin))
        assert largest(difference) < 1e-14


def test_dense_output_on_a_group_matches_nodes_and_exact_motion():
    sol = run(BALL, dt=0.1, num_steps=5, saveat=dataclasses.replace(EVERY, dense=True))
    nodes = jax.vmap(sol.evaluate)(sol.ts)
    np.testing.assert_allclose(nodes.q[1], sol.ys.q[1], atol=1e-14)
    np.testing.assert_allclose(nodes.p, sol.ys.p, atol=1e-14)
    q, v, _ = BALL.exact(0.23)
    inside = sol.evaluate(0.23)
    np.testing.assert_allclose(inside.q[1], q[1], atol=1e-5)
    np.testing.assert_allclose(inside.v, v, atol=1e-4)
    assert abs(float(jnp.linalg.norm(inside.q[0])) - 1) < 1e-15


def test_samples_on_a_group_equal_dense_output():
    ts = jnp.array([0.0, 0.17, 0.5])
    sampled = run(BALL, dt=0.1, num_steps=5, saveat=SaveAt(ts=ts))
    dense = run(BALL, dt=0.1, num_steps=5, saveat=SaveAt(dense=True))
    expected = jax.vmap(dense.evaluate)(ts)
    assert largest(jax.tree.map(jnp.subtract, sampled.ys, expected)) < 1e-14


def test_dense_output_of_a_hamiltonian_system_with_a_holonomic_constraint():
    pendulum = systems.SphericalPendulum()
    system = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p + q[2], holonomic=pendulum.holonomic
    )
    y0 = nhjax.initial_state(system, pendulum.q0, p=pendulum.v0)
    sol = nhjax.integrate(
        system, METHOD, y0, dt=0.1, num_steps=5, saveat=SaveAt(dense=True)
    )
    q, v, _ = pendulum.exact(0.33)
    np.testing.assert_allclose(sol.evaluate(0.33).q, q, atol=1e-5)
    np.testing.assert_allclose(sol.evaluate(0.33).v, v, atol=1e-3)


def test_group_run_in_single_precision_is_accurate():
    y0 = BALL.initial_state(jnp.float32)
    sol = run(BALL, y0=y0, dt=0.1, num_steps=50)
    assert {leaf.dtype for leaf in jax.tree.leaves(sol.ys)} == {jnp.dtype(jnp.float32)}
    double = run(BALL, dt=0.1, num_steps=50)
    difference = jax.tree.map(lambda x, y: x.astype(float) - y, sol.ys, double.ys)
    assert largest(difference) < 1e-4


def there_and_back(system, method, y0):
    """The change of (q, v) by 50 steps of 0.1 and as many of -0.1."""
    y = y0
    for dt in (0.1, -0.1):
        y = nhjax.integrate(system, method, y, dt=dt, num_steps=50).ys
        y = jax.tree.map(lambda x: x[-1], y)
    change = jax.tree.map(jnp.subtract, y, y0)
    return largest((change.q, change.v))


def test_group_step_back_with_chart_at_its_start_is_not_reversible():
    # Measured: 2e-5 (Cayley, s = 2).
    suslov, y0 = systems.Suslov(), systems.Suslov().initial_state()
    errors = [
        there_and_back(suslov.system, nhjax.LobattoIIIAB(s, chart="start"), y0)
        for s in (2, 3)
    ]
    assert 1e-7 < errors[0] < 1e-2
    assert 1e-12 < errors[1] < 1e-2 * errors[0]


@pytest.mark.parametrize(
    ("retraction", "stages"),
    [(nhjax.Cayley(), 2), long(nhjax.Exponential(), 3), exhaustive(nhjax.Cayley(), 4)],
    ids=str,
)
def test_group_step_back_with_chart_in_its_middle_is_reversible(retraction, stages):
    beside = SideBySide(
        tuple(
            kind(retraction=retraction)
            for kind in (
                systems.Unicycle,
                systems.Veselova,
                systems.Suslov,
                systems.HeavyTop,
                systems.TurntableBall,
            )
        )
    )
    system = beside.system()
    y0 = beside.initial_state(system)
    assert there_and_back(system, nhjax.LobattoIIIAB(stages), y0) <= 1e-13


def test_group_body_without_weight_conserves_horizontal_momentum():
    veselova = systems.Veselova(weight=(0.0, 0.0, 0.0))
    saveat = SaveAt(t0=True, steps=10)
    ys = run(veselova, dt=0.1, num_steps=1000, saveat=saveat).ys
    momentum = jax.vmap(veselova.horizontal_momentum)(ys.q, ys.v)
    assert largest(momentum - momentum[:1]) <= 1e-14
    assert largest(ys.v - ys.v[:1]) > 0.1


def test_group_run_of_ten_thousand_steps_conserves_linear_integrals():
    def integrals(t, y, args):
        return BALL.first_integrals(y.q, y.v), BALL.manifold.distance_to_group(y.q)

    sol = run(
        BALL,
        dt=0.1,
        num_steps=10_000,
        saveat=SaveAt(t0=True, steps=100, fn=integrals),
    )
    values, defect = sol.ys
    assert largest(values - values[:1]) <= 1e-14
    assert largest(defect) <= 1e-15


def heisenberg_lagrangian(t, q, v, args):
    return 0.5 * v @ v


@pytest.mark.parametrize(
    ("stages", "group"),
    [(2, Heisenberg()), (3, Heisenberg()), (3, HeisenbergBySecondKind())],
)
def test_group_of_a_user_is_integrated(stages, group):
    """Geodesics of the Heisenberg group: v₃ is constant, (v₁, v₂) turn at its rate."""
    system = nhjax.LagrangianSystem(heisenberg_lagrangian, manifold=group)
    v0 = jnp.array([0.3, 0.4, 0.8])
    y0 = nhjax.initial_state(system, jnp.zeros(3), v0)

    def error(num_steps):
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=2.0 / num_steps,
            num_steps=num_steps,
        )
        velocity = complex(*np.asarray(sol.ys.v[0, :2]))
        exact = complex(0.3, 0.4) * np.exp(2.0j * 0.8)
        assert abs(float(sol.ys.v[0, 2]) - 0.8) < 1e-14
        return abs(velocity - exact)

    order = np.log2(error(16) / error(32))
    np.testing.assert_allclose(order, 2 * stages - 2, atol=0.1)
    assert there_and_back(system, nhjax.LobattoIIIAB(stages), y0) <= 1e-13


@pytest.mark.parametrize(
    "solver", [nhjax.SimplifiedNewton(), nhjax.Newton()], ids=["simplified", "newton"]
)
def test_group_product_of_vector_spaces_equals_the_vector_space(solver):
    particle = systems.NonholonomicParticle()
    product = nhjax.ProductGroup(nhjax.Euclidean(2), nhjax.Euclidean(1))

    def whole(q):
        return jnp.concatenate(q)

    def lagrangian(t, q, v, args):
        return particle.lagrangian(t, whole(q), v, args)

    def constraint(t, q, v, args):
        return particle.constraint(t, whole(q), v, args)

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=constraint, manifold=product
    )
    q0 = (particle.q0[:2], particle.q0[2:])
    y0 = nhjax.initial_state(system, q0, particle.v0)
    options = {"dt": 0.1, "num_steps": 20, "stage_solver": solver}
    split = nhjax.integrate(system, METHOD, y0, **options).ys
    plain = run(particle, **options).ys
    np.testing.assert_allclose(jnp.concatenate(split.q, axis=1), plain.q, atol=1e-14)
    np.testing.assert_allclose(split.p, plain.p, atol=1e-14)


def instructions(system, y0):
    """How many instructions the compiled time loop has."""

    def loop(y0, dt):
        sol = nhjax.integrate(system, METHOD, y0, dt=dt, num_steps=10, throw=False)
        return sol.ys, sol.stats

    text = jax.jit(loop).lower(y0, 0.1).compile().as_text()
    return str(text).count(" = ")


def test_group_of_a_vector_space_adds_no_equations_to_the_program():
    particle = systems.NonholonomicParticle()
    on_group = dataclasses.replace(particle.system, manifold=nhjax.Euclidean(3))
    y0 = particle.initial_state()
    assert instructions(on_group, y0) == instructions(particle.system, y0)


def test_multiplier_of_both_constraint_kinds_has_separate_rows():
    sleigh = systems.RodSleigh()
    y0 = sleigh.initial_state()
    assert y0.multiplier.shape == (2,)
    assert sleigh.system.constraint_violation(0.0, y0).shape == (3,)
    sol = run(sleigh, dt=0.05, num_steps=40, saveat=EVERY)
    expected = np.stack([sleigh.exact(float(t))[2] for t in sol.ts])
    np.testing.assert_allclose(sol.ys.multiplier, expected, atol=1e-5)
    assert float(sol.stats["max_constraint_violation"]) < 1e-14


def test_holonomic_constraint_that_moves_is_followed():
    """A bead on a straight wire that turns at the rate args: r'' = rate² r."""

    def wire(t, q, args):
        return q[1] * jnp.cos(args * t) - q[0] * jnp.sin(args * t)

    rate = 0.7
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v, holonomic=wire)
    start = partial(nhjax.initial_state, system, args=rate)
    y0 = start(jnp.array([1.0, 0.0]), jnp.array([0.0, rate]))
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(4), y0, dt=0.05, num_steps=20, args=rate
    )
    radius = np.cosh(rate * 1.0)
    expected = radius * np.array([np.cos(rate), np.sin(rate)])
    np.testing.assert_allclose(sol.ys.q[0], expected, atol=1e-10)
    with pytest.raises(nhjax.ConstraintViolationError, match=r"dΓ\[0\]/dt"):
        start(jnp.array([1.0, 0.0]), jnp.zeros(2))
