"""Solved steps near rest are accepted, and so are starts with only round-off errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax._numerics import measured_noise
from nhjax._step._round_off import magnifications, noise_of_step
from nhjax._system import FunctionNoise, linearise
from support import hub_bicycle
from support.long import long


NEWTON = nhjax.Newton()


@pytest.mark.parametrize("dt", [long(1e-3), 5e-2])
@pytest.mark.parametrize(
    "solver", [nhjax.SimplifiedNewton(fallback=False), long(NEWTON)]
)
def test_steps_of_slow_bicycle_are_accepted_by_both_solvers(dt, solver):
    bicycle = nhjax.systems.WhippleBicycle()
    system, y0 = bicycle.system, bicycle.initial_state()
    for scale in (1e-6, 1e-4, 1e-2):
        y = nhjax.initial_state(system, y0.q, scale * y0.v, project=True)
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(4),
            y,
            dt=dt,
            num_steps=10,
            throw=False,
            stage_solver=solver,
        )
        assert bool(sol.result == nhjax.RESULTS.successful), (scale, dt)
        assert float(sol.stats["max_constraint_violation"]) < 1e-15


@pytest.mark.parametrize(
    "machine", [nhjax.systems.Rattleback, long(nhjax.systems.RollingTorus)]
)
def test_run_far_from_origin_of_plane_equals_run_at_origin(machine):
    example = machine()
    system, y0 = example.system, example.initial_state()
    method = nhjax.LobattoIIIAB(3)

    def end(distance):
        q = y0.q.at[4].add(distance)
        y = nhjax.initial_state(system, q, y0.v, project=True)
        return nhjax.integrate(system, method, y, dt=0.01, num_steps=20).ys

    # Neither the Lagrangian nor the constraints depend on x, so that the round-off of
    # x must not end an iteration early.
    near, far = end(0.0), end(1e6)
    np.testing.assert_array_equal(far.v, near.v)
    np.testing.assert_array_equal(far.multiplier, near.multiplier)


def test_slow_spin_of_rattleback_agrees_between_solvers():
    rattleback = nhjax.systems.Rattleback()
    system, y0 = rattleback.system, rattleback.initial_state()
    y = nhjax.initial_state(system, y0.q, 1e-8 * y0.v, project=True)

    def end(solver):
        method = nhjax.LobattoIIIAB(3)
        options = {"dt": 0.01, "num_steps": 10, "stage_solver": solver}
        return nhjax.integrate(system, method, y, **options).ys.v

    # The velocities are 1e-9 to 5e-8. Here the unit round-off of the quaternion,
    # divided by the step, is 2e-14, although rounding it does not change the height.
    simplified = end(nhjax.SimplifiedNewton())
    np.testing.assert_allclose(simplified, end(NEWTON), rtol=0, atol=2e-16)


@pytest.mark.filterwarnings("ignore:The steps of this run took")
@pytest.mark.parametrize("stages", [long(5), 6])
def test_step_of_governor_near_dependent_constraints_is_accepted(stages):
    governor = nhjax.systems.FlyballGovernor()
    system, y0 = governor.system, governor.initial_state()
    y = nhjax.initial_state(system, y0.q, 1e-2 * y0.v, project=True)

    def run(solver):
        method = nhjax.LobattoIIIAB(stages)
        options = {"dt": 0.1, "num_steps": 5, "stage_solver": solver}
        return nhjax.integrate(system, method, y, **options)

    # The arms fall to the vertical, where the constraints are dependent. The round-off
    # of the constraints changes velocities five times more there than at the start.
    simplified = run(nhjax.SimplifiedNewton(fallback=False))
    assert int(simplified.stats["num_iterations"]) > 1000
    # The round-off of the last step moves the velocities by 6e-9.
    np.testing.assert_allclose(simplified.ys.v, run(NEWTON).ys.v, rtol=0, atol=6e-9)


@pytest.mark.parametrize("h", [1e-3, -1e-3])
def test_noise_of_step_agrees_with_matrices_by_hand(h):
    masses, slope = np.array([2.0, 3.0, 4.0]), 0.7
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * masses @ v**2,
        holonomic=lambda t, q, args: q[0] + q[1] - 1.0,
        nonholonomic=lambda t, q, v, args: v[2] - slope * v[0],
    )
    y = nhjax.initial_state(
        system, jnp.array([0.4, 0.6, 0.0]), jnp.array([1.0, -1.0, slope])
    )
    rng = np.random.default_rng(0)
    noise = FunctionNoise(*(jnp.asarray(rng.random(k)) for k in (3, 3, 2, 1)))
    method = nhjax.LobattoIIIAB(3)

    def found(noise):
        lin = linearise(system, jnp.zeros(()), y.q, y.v, None)
        return noise_of_step(method, lin, noise, jnp.asarray(h))

    kinematic, holonomic = magnifications(method)
    missed = kinematic * np.asarray(noise.on_velocities)
    missed[1] += holonomic / abs(h) * float(noise.on_positions[0])
    constraints = np.array([[-slope, 0.0, 1.0], [1.0, 1.0, 0.0]])
    reaction = constraints.T / masses[:, None]
    inverse = np.linalg.inv(constraints @ reaction)
    gained = np.asarray(noise.momentum) + abs(h) * np.asarray(noise.force)
    expected = np.max(gained / masses)
    expected += np.max(np.abs(reaction) @ (np.abs(inverse) @ missed))
    np.testing.assert_allclose(found(noise), expected, rtol=1e-13)
    slopes = jax.grad(found)(noise)
    assert all(not np.any(x) for x in jax.tree.leaves(slopes))


def test_noise_of_function_includes_constants_that_cancel():
    x = jnp.array([1e-7, 1e-7, 0.0])

    def height(dx):
        q = x + dx
        return ((1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0])[None]

    (noise,) = measured_noise(height, 3, jnp.zeros(1))
    # The standard deviation of one rounding of a number between 1 and 2 is 6e-17.
    assert 2e-17 < noise < 5e-16


@pytest.mark.parametrize("jump", [jnp.sign, jnp.abs])
def test_noise_at_jump_or_kink_of_friction_at_rest_is_round_off(jump):
    (noise,) = measured_noise(lambda dx: 5.0 * jump(dx), 1, jnp.zeros(1))
    assert noise < 1e-15


@pytest.mark.parametrize("constant", [1.0, 1e2, 1e4])
def test_noise_of_function_with_large_constant_includes_its_round_off(constant):
    def hides(dx):
        return (constant + dx / constant) ** 2 - constant**2 + dx**2

    (noise,) = measured_noise(hides, 1, jnp.zeros(1))
    # This is the round-off of numbers as large as the square of the constant.
    assert 1e-17 * constant**2 < noise < 1e-15 * constant**2


@pytest.mark.parametrize("phase", [0.0, 0.4, np.pi / 2])
def test_noise_of_smooth_function_in_units_of_any_size_is_round_off(phase):
    # The function varies over a length between 1 and 1e-10.
    lengths = 10.0 ** jnp.arange(-10, 0.25, 0.25)

    def noise(length):
        return measured_noise(lambda dx: jnp.sin(phase + dx / length), 1, jnp.zeros(1))

    assert jnp.max(jax.vmap(noise)(lengths)) < 1e-15


@pytest.mark.parametrize("unit", [1e-12, 1e6, 1e15])
def test_run_with_time_in_other_units_equals_run_in_seconds(unit):
    def after(unit):
        """Drive at 10 rad/s, with time in units of `unit` seconds."""
        system = nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * v @ v / unit**2 - 0.5 * q @ q,
            holonomic=lambda t, q, args: q[0] - q[1] ** 2 - jnp.sin(10 * unit * t),
        )
        y0 = nhjax.initial_state(
            system, jnp.array([0.25, 0.5]), unit * jnp.array([11.0, 1.0])
        )
        method, dt = nhjax.LobattoIIIAB(3), 0.02 / unit
        sol = nhjax.integrate(system, method, y0, dt=dt, num_steps=8)
        return sol.ys.v / unit

    np.testing.assert_allclose(after(unit), after(1.0), rtol=1e-13)


def test_starts_near_upright_with_round_off_in_a_height_are_accepted():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: (1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0],
    )
    rng = np.random.default_rng(0)
    x = jnp.asarray(10 ** rng.uniform(-8, -3, 100))
    q = jnp.stack([x, x, jnp.zeros_like(x)], axis=1)

    def start(q):
        return nhjax.initial_state(system, q, jnp.zeros(3), throw=False).q

    assert bool(jnp.all(jnp.isfinite(jax.vmap(start)(q))))


@pytest.mark.parametrize("error", [1e-11, 1e-9])
def test_start_that_violates_height_by_more_than_round_off_is_refused(error):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: (1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0],
    )
    q = jnp.array([1e-5, 1e-5 + error, 0.0])
    with pytest.raises(nhjax.ConstraintViolationError, match="Γ"):
        nhjax.initial_state(system, q, jnp.zeros(3))


# A constraint on the height of a weight; its constants cancel where q is small.
def height(t, q, args):
    return ((1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0])[None]


def weight(t, q, v, args):
    return 0.5 * v @ v - 9.81 * q[0]


@pytest.mark.parametrize("size", [0.0, 1e-15, 1e-12, 1e-9])
@pytest.mark.parametrize("constraints", ["independent", "redundant"])
def test_runs_from_states_near_zero_are_accepted(size, constraints):
    given = 1 if constraints == "independent" else 2
    system = nhjax.LagrangianSystem(
        weight,
        holonomic=lambda t, q, args: jnp.tile(height(t, q, args), given),
        constraints=constraints,
    )
    y0 = nhjax.initial_state(system, jnp.array([size, size, 0.0]), jnp.zeros(3))
    # The steps are so short that velocities stay small.
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, dt=1e-8, num_steps=5, throw=False
    )
    assert bool(sol.result == nhjax.RESULTS.successful)


def test_run_from_start_off_by_more_than_round_off_near_zero_fails():
    system = nhjax.LagrangianSystem(weight, holonomic=height)
    y0 = nhjax.initial_state(system, jnp.array([1e-9, 1e-9, 0.0]), jnp.zeros(3))
    moved = eqx.tree_at(lambda y: y.q, y0, y0.q.at[0].add(1e-9))
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), moved, dt=1e-3, num_steps=5, throw=False
    )
    assert bool(sol.result == nhjax.RESULTS.inconsistent_start)


@pytest.mark.parametrize(("speed", "dt"), [(1e-6, 1e-3), (1e-4, 1e-1)])
@pytest.mark.parametrize("solver", [nhjax.SimplifiedNewton(fallback=False), NEWTON])
def test_energy_with_constants_that_cancel_is_conserved_near_rest(speed, dt, solver):
    # The potential is the difference of two numbers near 10.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * (1 + jnp.sin(q[0]) ** 2) * v @ v
            - 1e-3 * ((100 + q[0] / 100) ** 2 - 100**2)
            - 0.5 * q[1] ** 2
            - q[0] * q[1]
        )
    )
    given = speed * jnp.array([1.0, -1.0]), speed * jnp.ones(2)
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(3),
        nhjax.initial_state(system, *given),
        dt=dt,
        num_steps=50,
        throw=False,
        invariants="energy",
        stage_solver=solver,
    )
    assert bool(sol.result == nhjax.RESULTS.successful)
    assert float(sol.stats["max_invariant_error"]) < 1e-14


def test_event_condition_within_round_off_of_zero_starts_at_zero():
    # At the start, at rest, the condition is -2e-16; then it increases.
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v + q[0])
    y0 = nhjax.initial_state(system, jnp.array([0.0, 1.5e-8]), jnp.zeros(2))
    event = nhjax.Event(lambda t, y, args: (1.02 + y.q[0]) * jnp.cos(y.q[1]) - 1.02)
    assert float(event.cond_fn(0.0, y0, None)) < 0
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, dt=1e-2, num_steps=9, event=event
    )
    assert int(sol.stats["num_events"]) == 0
    assert bool(sol.result == nhjax.RESULTS.successful)


@pytest.mark.long
@pytest.mark.parametrize("lean", [1e-6, 1e-3, 1e-1])
def test_slow_bicycle_in_other_coordinates_is_accepted(lean):
    system = hub_bicycle.make_system()
    for speed in (0.0, 1e-6, 1e-2, 1.0):
        y0 = nhjax.initial_state(
            system, *hub_bicycle.upright(lean, speed), project=True
        )
        for dt in (1e-3, 1e-2):
            sol = nhjax.integrate(
                system,
                nhjax.LobattoIIIAB(3),
                y0,
                dt=dt,
                num_steps=5,
                throw=False,
                stage_solver=nhjax.SimplifiedNewton(fallback=False),
            )
            assert bool(sol.result == nhjax.RESULTS.successful), (speed, dt)
            assert float(sol.stats["max_constraint_violation"]) < 1e-13


@pytest.mark.parametrize("stages", [2, long(3), long(6)])
def test_upright_bicycle_at_rest_falls_to_45_degrees(stages):
    bicycle = nhjax.systems.WhippleBicycle()
    system, y0 = bicycle.system, bicycle.initial_state()
    lean = 3
    q = jnp.zeros_like(y0.q).at[lean].set(1e-6)
    y0 = nhjax.initial_state(system, q, jnp.zeros_like(y0.v), project=True)

    @jax.jit
    def fall(y0):
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=1e-2,
            num_steps=700,
            throw=False,
            event=nhjax.Event(lambda t, y, args: jnp.abs(y.q[lean]) - jnp.pi / 4),
        )

    sol = fall(y0)
    assert bool(sol.result == nhjax.RESULTS.event_occurred)
    np.testing.assert_allclose(jnp.abs(sol.ys.q[0, lean]), np.pi / 4, rtol=1e-12)
    assert float(sol.stats["max_constraint_violation"]) < 1e-13
    end = jax.tree.map(lambda x: x[0], sol.ys)
    gained = system.energy(sol.t1, end, None) - system.energy(0.0, y0, None)
    # The kinetic energy is about 250 J.
    allowed = {2: 1.0, 3: 1e-3, 4: 1e-6, 5: 1e-8, 6: 1e-9}[stages]
    assert abs(float(gained)) < allowed
