"""Runs that keep the energy, or functions that a user gives."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nhjax
from benchmarks._examples import suslov_in_a_potential
from nhjax import LobattoIIIAB, SaveAt, systems
from support import paper_equations as paper, paper_mechanics as mechanics
from support.helpers import central_difference, scalar
from support.long import exhaustive_but, long
from support.orders import assert_order, rms, SCIPY_FLOOR, trajectories
from support.pages import run_page


CHAOTIC, CVT = systems.ChaoticSystem(), systems.ContinuouslyVariableTransmission.low()
PARTICLE = systems.NonholonomicParticle()
SUSLOV = systems.Suslov(v0=(0.6, 1.3, 0.0))
EVERY = SaveAt(t0=True, steps=True)


def energy_of_the_chaotic_system(q, v):
    """In plain NumPy: T + V of the paper's system with m = 3, indices from 1."""
    _, q2, q3, q4, q5, q6, q7 = np.moveaxis(q, -1, 0)
    products = (q5 * q6) ** 2 + (q2 * q5) ** 2 + (q3 * q6) ** 2 + (q4 * q7) ** 2
    return 0.5 * np.sum(v**2 + q**2, axis=-1) + 0.5 * products


# The equations of a step.


@pytest.mark.parametrize("stages", [2, 3])
def test_invariant_step_is_a_step_of_the_paper_between_two_scalings(stages):
    h, y0 = 0.1, CHAOTIC.initial_state()
    saveat = SaveAt(t0=True, steps=True, dense=True)
    method = LobattoIIIAB(stages)
    options = {"dt": h, "num_steps": 12, "saveat": saveat, "invariants": "energy"}
    sol = nhjax.integrate(CHAOTIC.system, method, y0, **options)
    assert sol.interpolation is not None
    ts, y, record = jax.tree.map(
        np.asarray, (sol.ts, sol.ys, sol.interpolation.records)
    )
    oracle, b = mechanics.Chaotic(), paper.lobatto(stages).b
    found, continuous = [], oracle.continuous_multiplier(ts, y.q, y.p)[0]
    for k in range(12):
        ends = slice(k, k + 2)
        V, multiplier = record.velocity[k], record.multiplier[k]
        a = paper.lobatto(stages).a
        Q = y.q[k] + h * a @ V
        W = oracle.d1l(ts[k], Q, V) + np.einsum(
            "im,imn->in", multiplier, oracle.d2phi(ts[k], Q, V)
        )
        # p_{k+1} - p_k - h Σ b W = ε (p_k + p_{k+1}) gives ε, and is an equation too.
        miss, along = y.p[k + 1] - y.p[k] - h * b @ W, y.p[k] + y.p[k + 1]
        epsilon = miss @ along / (along @ along)
        np.testing.assert_allclose(miss, epsilon * along, rtol=0, atol=1e-14)
        found.append(epsilon)
        p = np.stack([(1 + epsilon) * y.p[k], (1 - epsilon) * y.p[k + 1]])
        step = paper.Run(
            t=ts[ends],
            h=h,
            q=y.q[ends],
            v=p,
            p=p,
            multiplier=np.stack([multiplier[0], multiplier[-1]]),
            V=V[None],
            W=W[None],
            Lambda=multiplier[None],
        )
        for equation, residual in paper.residuals(oracle, step, "propagated").items():
            assert residual <= 3e-14, f"{equation}: {residual:.1e}"
        # The closure uses the states at the ends of the step.
        nu = multiplier[0] - continuous[k]
        sigma = (-1) ** stages
        other = multiplier[-1] - continuous[k + 1]
        np.testing.assert_allclose(other, sigma * nu, rtol=0, atol=1e-12)
    size = {2: 1e-4, 3: 1e-7}[stages]
    assert size < np.max(np.abs(found)) < 30 * size
    energies = energy_of_the_chaotic_system(y.q, y.v)
    np.testing.assert_allclose(energies, energies[0], rtol=2e-15)


def test_invariant_step_on_a_group_equals_an_outer_search_for_the_scaling():
    system, y = suslov_in_a_potential()
    method = LobattoIIIAB(3, "propagated")

    @jax.jit
    def plainly(epsilon):
        start = nhjax.State(y.q, y.v, (1 + epsilon) * y.p, y.multiplier)
        start = nhjax.State(y.q, (1 + epsilon) * y.v, start.p, y.multiplier)
        end = nhjax.step(system, method, 0.0, 0.1, start)
        v, p = end.v / (1 - epsilon), end.p / (1 - epsilon)
        end = nhjax.State(end.q, v, p, end.multiplier)
        return end, system.energy(0.1, end) - system.energy(0.0, y)

    epsilon: Any = brentq(lambda x: float(plainly(x)[1]), -1e-3, 1e-3, xtol=1e-16)
    assert 1e-9 < abs(epsilon) < 1e-6
    end = nhjax.step(system, method, 0.0, 0.1, y, invariants="energy")
    expected = plainly(epsilon)[0]
    for name in ("q", "v", "p", "multiplier"):
        found, wanted = getattr(end, name), getattr(expected, name)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13, err_msg=name)


# What is conserved, and what does not change.


def on_momenta(system):
    """The Hamiltonian form of a system of unit mass."""
    return nhjax.HamiltonianSystem(
        lambda t, q, p, args: p @ p - system.lagrangian(t, q, p, args),
        nonholonomic=lambda t, q, p, args: system.nonholonomic(t, q, p, args),
    )


def to_run(name):
    """A system with its state."""
    if name == "Suslov in a potential":
        return suslov_in_a_potential()
    if name == "chaotic, Hamiltonian":
        system = on_momenta(CHAOTIC.system)
        return system, nhjax.initial_state(system, CHAOTIC.q0, p=CHAOTIC.v0)
    example = {
        "chaotic": CHAOTIC,
        "Veselova": systems.Veselova(),
        "both kinds of constraints": systems.RodSleigh(),
    }[name]
    return example.system, example.initial_state()


@pytest.mark.parametrize(
    ("name", "stages", "bound"),
    [
        long("chaotic", 2, 3e-15),
        ("chaotic", 4, 3e-15),
        ("chaotic, Hamiltonian", 3, 3e-15),
        long("Suslov in a potential", 3, 3e-15),
        ("Veselova", 2, 3e-15),
        ("both kinds of constraints", 3, 3e-15),
    ],
)
def test_invariant_energy_and_constraints_forwards_and_back_stay_at_round_off(
    name, stages, bound
):
    system, y0 = to_run(name)
    method = LobattoIIIAB(stages)

    @jax.jit
    def run(y0, dt):
        saveat = SaveAt(t1=True, steps=10)
        sol = nhjax.integrate(
            *(system, method, y0),
            **{"dt": dt, "num_steps": 1000, "saveat": saveat, "invariants": "energy"},
        )
        return sol, jax.vmap(system.energy)(sol.ts, sol.ys)

    there, energies = run(y0, 0.1)
    end = jax.tree.map(lambda x: x[-1], there.ys)
    start = float(system.energy(0.0, y0))
    np.testing.assert_allclose(energies, start, rtol=bound)
    assert float(there.stats["max_invariant_error"]) < bound
    assert float(there.stats["max_constraint_violation"]) < 3e-14
    # Chaotic motion magnifies round-off, so it runs back only for a short time.
    near = jax.tree.map(lambda x: x[0], run(y0, 0.01)[0].ys)
    back = jax.tree.map(lambda x: x[0], run(near, -0.01)[0].ys)
    for name in ("q", "v", "multiplier"):
        np.testing.assert_allclose(
            getattr(back, name), getattr(y0, name), rtol=0, atol=1e-13
        )
    assert np.all(np.isfinite(end.p))


COUNTS = {2: (32, 64, 128), 3: (16, 32, 64), 4: (8, 16, 32)}


@pytest.mark.parametrize("stages", exhaustive_but((3,), COUNTS))
@pytest.mark.parametrize("part", ["R^n", "group"])
def test_invariant_run_converges_with_order_2s_minus_2(part, stages):
    example = {"R^n": PARTICLE, "group": SUSLOV}[part]
    y0, method, counts = example.initial_state(), LobattoIIIAB(stages), COUNTS[stages]
    runs = trajectories(example.system, method, y0, counts, invariants="energy")
    errors = {"q": [], "p": [], "multiplier": []}
    mass = jax.jacfwd(lambda v: example.system.momentum(0.0, y0.q, v))(y0.v)
    for ts, y, _ in runs:
        q, v, multiplier = map(np.stack, zip(*map(example.exact, ts), strict=True))
        if part == "group":
            q = q * np.sign(np.sum(q * y.q, axis=1, keepdims=True))
        errors["q"].append(rms(y.q - q))
        errors["p"].append(rms(y.p - v @ np.asarray(mass)))
        errors["multiplier"].append(rms(y.multiplier - multiplier))
    for values in errors.values():
        assert_order(2 * stages - 2, counts, values)


def test_invariant_moving_energy_on_a_turntable_is_conserved():
    ball = systems.TurntableBall(moments=(0.3, 0.4, 0.5))

    def moving_energy(t, q, v, args):
        return ball.invariants(t, q, v)["moving_energy"]

    run = {"dt": 0.1, "num_steps": 500, "invariants": moving_energy, "saveat": EVERY}
    sol = nhjax.integrate(ball.system, LobattoIIIAB(2), ball.initial_state(), **run)
    found = jax.vmap(lambda y: moving_energy(0.0, y.q, y.v, None))(sol.ys)
    np.testing.assert_allclose(found, found[0], rtol=0, atol=1e-15)
    assert float(sol.stats["max_constraint_violation"]) < 1e-14


def test_invariants_of_two_functions_are_conserved_with_dense_output():
    def both(t, q, v, args):
        energies = [CVT.driver_energy(q, v), CVT.passenger_energy(q, v)]
        return jnp.stack(energies)

    saveat = SaveAt(t0=True, steps=True, dense=True)
    run = {"dt": 0.1, "num_steps": 300, "invariants": both, "saveat": saveat}
    sol = nhjax.integrate(CVT.system, LobattoIIIAB(3), CVT.initial_state(), **run)
    found = jax.vmap(lambda y: both(0.0, y.q, y.v, None))(sol.ys)
    np.testing.assert_allclose(found, jnp.broadcast_to(found[0], found.shape), 1e-13)
    ends = jax.vmap(sol.evaluate)(sol.ts[7:12])
    for name in ("q", "v", "p"):
        np.testing.assert_allclose(
            getattr(ends, name), getattr(sol.ys, name)[7:12], rtol=0, atol=1e-14
        )


def test_invariant_energies_of_an_ensemble_in_single_precision_are_conserved():
    q0, v0 = CHAOTIC.ensemble(2, jnp.float32)
    scales = jnp.array([0.5, 1.0, 1.5], jnp.float32)
    y0 = jax.vmap(lambda q, v, a: nhjax.initial_state(CHAOTIC.system, q, a * v))(
        q0, v0, scales
    )
    run = {"dt": 0.1, "num_steps": 300, "invariants": "energy", "saveat": EVERY}
    sol = jax.vmap(
        lambda y: nhjax.integrate(CHAOTIC.system, LobattoIIIAB(2), y, **run)
    )(y0)
    assert sol.ys.q.dtype == jnp.float32
    q, v = np.asarray(sol.ys.q, float), np.asarray(sol.ys.v, float)
    energies = energy_of_the_chaotic_system(q, v)
    assert np.ptp(energies[:, 0]) > 0.1
    np.testing.assert_allclose(energies / energies[:, :1], 1.0, rtol=0, atol=2e-6)


# Derivatives.


@cache
def loss_of(adjoint):
    system, y0 = PARTICLE.system, PARTICLE.initial_state()

    def loss(x):
        """The variables are the step size and a factor of the velocities."""
        start = nhjax.initial_state(system, y0.q, x[1] * y0.v)
        options = {"num_steps": 6, "adjoint": adjoint, "invariants": "energy"}
        sol = nhjax.integrate(system, LobattoIIIAB(2), start, dt=x[0], **options)
        return scalar(sol.ys)

    return loss


ADJOINTS = {
    "direct": nhjax.DirectAdjoint(),
    "checkpoints": nhjax.RecursiveCheckpointAdjoint(),
    "reversible": nhjax.ReversibleAdjoint(),
}


@cache
def differences():
    loss, x = jax.jit(loss_of(ADJOINTS["direct"])), np.array([0.2, 1.0])
    directions = np.eye(2)
    return np.array(
        [central_difference(lambda e, d=d: loss(x + e * d), 3e-3) for d in directions]
    )


@pytest.mark.parametrize("name", exhaustive_but(["reversible"], ADJOINTS))
def test_invariant_gradients_match_finite_differences(name):
    gradient = jax.jit(jax.grad(loss_of(ADJOINTS[name])))(jnp.array([0.2, 1.0]))
    np.testing.assert_allclose(gradient, differences(), rtol=1e-9)


# Refusals.


def free(t, q, v, args):
    return 0.5 * v @ v - 0.5 * q @ q


def rolls_along(t, q, v, args):
    return v[0] - q[1]


def energy(t, q, v, args):
    return v @ v - free(t, q, v, args)


REFUSED = {
    "force": {"force": lambda t, q, v, args: 0 * v},
    "lagrangian": {
        "lagrangian": lambda t, q, v, args: free(t, q, v, args) + q[0] * jnp.cos(t)
    },
    "holonomic": {"holonomic": lambda t, q, args: q[0] - 1 - t**2},
}


def run_of(
    invariants: Any = "energy", q=(1.0, 0.0), v=(0.0, 0.0), lagrangian=free, **functions
):
    system = nhjax.LagrangianSystem(lagrangian, **functions)
    y0 = nhjax.initial_state(system, jnp.array(q), v=jnp.array(v))
    method = LobattoIIIAB(2)
    return nhjax.integrate(
        system, method, y0, dt=0.1, num_steps=2, invariants=invariants
    )


@pytest.mark.parametrize("name", REFUSED)
def test_invariant_energy_of_a_system_that_cannot_conserve_it_raises(name):
    with pytest.raises(ValueError, match=f'invariants="energy"`: .* a `{name}`'):
        run_of(**REFUSED[name])


# The initial rate of the energy does not show the work: the first two constraints have
# no affine part there, and the third one does no work at rest.
@pytest.mark.parametrize(
    "constraint",
    [
        pytest.param(rolls_along, id="affine"),
        pytest.param(lambda t, q, v, args: v[0] - jnp.sin(t), id="rheonomic"),
        pytest.param(lambda t, q, v, args: v[0] - v[1] ** 2, id="nonlinear"),
    ],
)
def test_invariant_energy_with_reactions_that_do_work_raises(constraint):
    with pytest.raises(nhjax.IntegrationError, match="affine, rheonomic"):
        run_of(nonholonomic=constraint, v=(0.0, 0.0))


def test_invariant_function_that_is_not_conserved_raises():
    with pytest.raises(nhjax.IntegrationError, match=r"step 0: .* does not conserve"):
        run_of(lambda t, q, v, args: q[0] ** 2, v=(0.0, 1.0))


def test_invariant_energy_with_a_rotating_linear_constraint_is_conserved():
    def turning(t, q, v, args):
        return v[0] * jnp.cos(t) + v[1] * jnp.sin(t)

    sol = run_of(nonholonomic=turning, v=(0.0, 1.0))
    np.testing.assert_allclose(
        energy(0.0, sol.ys.q[0], sol.ys.v[0], None), 1.0, rtol=1e-15
    )


@pytest.mark.parametrize(
    ("invariants", "error", "message"),
    [
        ("enrgy", TypeError, "`invariants` must be None"),
        (lambda *given: jnp.ones(3), nhjax.ShapeError, "1 <= k <= 2.*shape \\(3,\\)"),
        (lambda *given: 1.0, nhjax.ShapeError, "got 1.0"),
        (lambda *given: jnp.ones((), "float32"), nhjax.DTypeError, "float32"),
    ],
)
def test_invariants_that_are_not_functions_of_the_state_raise(
    invariants, error, message
):
    with pytest.raises(error, match=message):
        run_of(invariants)


# Rest.


def pendulum(q, v):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v + jnp.sum(jnp.cos(q))
    )
    return system, nhjax.initial_state(system, jnp.array([q]), v=jnp.array([v]))


@cache
def swing():
    @jax.jit
    def run(y0, dt):
        system = pendulum(0.0, 0.0)[0]
        options = {"num_steps": 200, "invariants": "energy", "saveat": EVERY}
        return nhjax.integrate(system, LobattoIIIAB(2), y0, dt=dt, **options)

    return run


@pytest.mark.parametrize("dt", [0.1, 0.5])
def test_invariant_energy_of_a_pendulum_at_turning_points_is_conserved(dt):
    """It starts at one, at rest, and by symmetry a node falls on the next one."""
    sol = swing()(pendulum(1.0, 0.0)[1], dt)
    q, v = sol.ys.q[:, 0], sol.ys.v[:, 0]
    np.testing.assert_allclose(0.5 * v**2 - jnp.cos(q), -np.cos(1.0), atol=2e-15)
    assert np.sum(np.diff(np.sign(v[1:])) != 0) >= 5


@pytest.mark.parametrize(("stages", "counts"), [(2, (64, 128)), (3, (64, 128))])
def test_invariant_run_from_rest_keeps_its_order(stages, counts):
    system, y0 = pendulum(1.0, 0.0)
    method = LobattoIIIAB(stages)
    errors = []
    for ts, y, _ in trajectories(system, method, y0, counts, invariants="energy"):
        solved = solve_ivp(
            lambda t, z: [z[1], -np.sin(z[0])],
            (0.0, ts[-1] * (1 + 1e-12)),
            [1.0, 0.0],
            method="DOP853",
            t_eval=ts,
            rtol=3e-14,
            atol=1e-15,
        )
        errors.append(rms(np.concatenate([y.q, y.v], axis=1) - solved.y.T))
    # Near rest, an impulse adds h^(2s-2) divided by the number of steps since rest.
    assert_order(2 * stages - 2, counts, errors, floor=SCIPY_FLOOR)


def test_invariant_impulse_at_rest_vanishes():
    sol = swing()(pendulum(0.0, 0.0)[1], 0.1)
    np.testing.assert_array_equal(sol.ys.q, 0.0)
    slope = jax.grad(
        lambda q: jnp.sum(swing()(pendulum_at(q), 0.1).ys.q[10]),
    )(0.0)
    # No impulse acts on a motion this small, so this is the plain method: a Chebyshev
    # polynomial of 1 - dt² / 2.
    expected = np.cos(10 * np.arccos(1 - 0.5 * 0.1**2))
    np.testing.assert_allclose(slope, expected, rtol=1e-12)


def pendulum_at(q):
    y = pendulum(0.0, 0.0)[1]
    return nhjax.State(y.q + q, y.v, y.p, y.multiplier)


def test_invariant_error_near_a_saddle_stays_below_the_root_of_round_off():
    """Where all energy is potential, impulses are ill-determined and limited."""
    sol = swing()(pendulum(np.pi - 1e-6, 0.0)[1], 0.2)
    assert sol.result == nhjax.RESULTS.successful
    error = float(sol.stats["max_invariant_error"])
    assert 1e-15 < error < 1e-8
    q, v = sol.ys.q[-1, 0], sol.ys.v[-1, 0]
    assert abs(0.5 * v**2 - jnp.cos(q) - 1.0) < 1e-8


# A charge in a magnetic field, on the constraint of the particle. Its Lagrangian is not
# even in the velocities.
_FIELD, _SLOPE, _CUBIC = 1.5, 0.3, 0.3


def charge():
    def lagrangian(t, q, v, args):
        magnetic = 0.5 * _FIELD * (q[0] * v[1] - q[1] * v[0]) + _SLOPE * q[2] * v[1]
        return 0.5 * v @ v + magnetic - 0.5 * q @ q - _CUBIC / 3 * q[0] ** 3

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=PARTICLE.system.nonholonomic
    )
    q = jnp.array([0.7, -0.5, 0.4])
    return system, nhjax.initial_state(system, q, v=jnp.zeros(3))


def charge_rates(t, z):
    """In plain NumPy: a = f + λ B with B a = v_x v_y."""
    q, v = z[:3], z[3:]
    force = -q - np.array([_CUBIC * q[0] ** 2, 0.0, 0.0])
    force += [_FIELD * v[1], -_FIELD * v[0] - _SLOPE * v[2], _SLOPE * v[1]]
    slope = np.array([-q[1], 0.0, 1.0])
    multiplier = (v[0] * v[1] - slope @ force) / (slope @ slope)
    return np.concatenate([v, force + multiplier * slope])


@pytest.mark.parametrize(
    ("stages", "counts"), [(2, (128, 256, 512)), long(3, (32, 64, 128))]
)
def test_invariant_run_of_a_charge_from_rest_loses_a_logarithm_of_the_step(
    stages, counts
):
    """The error is h^(2s-2) (a + b log(1/h)): equal growth each time h is halved."""
    system, y0 = charge()
    start = np.concatenate([y0.q, y0.v])
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
    exact = solve_ivp(charge_rates, (0, 2), start, **options).y[:, -1]

    def scaled_errors(invariants):
        found = []
        for count in counts:
            given = system, LobattoIIIAB(stages), y0
            steps = {"dt": 2 / count, "num_steps": count}
            y = nhjax.integrate(*given, **steps, invariants=invariants).ys
            error = np.concatenate([y.q[0], y.v[0]]) - exact
            found.append(error * (count / 2) ** (2 * stages - 2))
        return np.max(np.abs(np.diff(found, axis=0)), axis=1), np.max(np.abs(found))

    growth, size = scaled_errors("energy")
    assert growth[0] > 0.05 * size
    np.testing.assert_allclose(growth[1], growth[0], rtol=0.05)
    growth, size = scaled_errors(None)
    assert np.max(growth) < 0.01 * size


@pytest.mark.parametrize(("dt", "limited"), [(0.9, False), (1.19, True)])
def test_invariant_run_with_limited_impulse_is_not_reversible(dt, limited):
    @jax.jit
    def run(y0, dt):
        given = pendulum(0.0, 0.0)[0], LobattoIIIAB(2), y0
        return nhjax.integrate(*given, dt=dt, num_steps=3, invariants="energy")

    y0 = pendulum(0.9, 0.0)[1]
    sol = run(y0, dt)
    there = jax.tree.map(lambda x: x[0], sol.ys)
    back = jax.tree.map(lambda x: x[0], run(there, -dt).ys)
    off = float(jnp.max(jnp.abs(back.q - y0.q)))
    error = float(sol.stats["max_invariant_error"])
    if limited:
        assert error > 0.01
        assert off > 0.01
        # The last step corrected the error.
        energies = [0.5 * y.v**2 - jnp.cos(y.q) for y in (y0, there)]
        np.testing.assert_allclose(*energies, rtol=1e-14)
    else:
        assert error < 1e-15
        assert off < 1e-14


def test_invariants_page_runs_as_printed():
    found = run_page("invariants")["sol"].ys
    np.testing.assert_allclose(found, found[0], rtol=0, atol=1e-15)


# Units.


@pytest.mark.parametrize(
    ("dtype", "scale"),
    [("float64", 1e-9), ("float64", 1e-4), ("float64", 1e9), ("float32", 1e-4)],
)
def test_invariant_in_other_units_is_kept_as_well(dtype, scale):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - 0.5 * q @ q - 0.25 * (q @ q) ** 2
    )

    def energy(q, v):
        return 0.5 * v @ v + 0.5 * q @ q + 0.25 * (q @ q) ** 2

    start = (jnp.array(x, dtype) for x in ((1.0, 0.2), (0.3, 0.8)))
    y0 = nhjax.initial_state(system, *start)
    sol = nhjax.integrate(
        system,
        LobattoIIIAB(2),
        y0,
        dt=0.1,
        num_steps=100,
        invariants=lambda t, q, v, args: scale * energy(q, v),
    )
    error = energy(sol.ys.q[-1], sol.ys.v[-1]) / energy(y0.q, y0.v) - 1
    assert abs(float(error)) < 4 * float(jnp.finfo(dtype).eps)


@pytest.mark.parametrize("unit", [1e-9, 1e6])
def test_invariants_in_another_unit_of_time_are_kept_as_well(unit):
    def lagrangian(t, q, v, args):
        return 0.5 * v @ v - (0.5 * q @ q + 0.25 * (q @ q) ** 2) / unit**2

    def kept(t, q, v, args):
        energy = 0.5 * v @ v + (0.5 * q @ q + 0.25 * (q @ q) ** 2) / unit**2
        return jnp.stack([energy, q[0] * v[1] - q[1] * v[0]])

    system = nhjax.LagrangianSystem(lagrangian)
    q0, v0 = jnp.array([1.0, 0.2]), jnp.array([0.3, 0.8]) / unit
    y0 = nhjax.initial_state(system, q0, v0)
    sol = nhjax.integrate(
        system, LobattoIIIAB(2), y0, dt=0.1 * unit, num_steps=100, invariants=kept
    )
    ends = kept(0.0, sol.ys.q[-1], sol.ys.v[-1], None)
    np.testing.assert_allclose(ends, kept(0.0, q0, v0, None), rtol=4e-15)
