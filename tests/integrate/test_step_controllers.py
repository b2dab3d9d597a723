"""The controllers of step sizes, and derivatives and events of runs with them."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import nhjax
from nhjax import (
    DirectAdjoint,
    Event,
    LobattoIIIAB,
    PIDController,
    RecursiveCheckpointAdjoint,
    RESULTS,
    ReversibleAdjoint,
    ReversibleController,
    SaveAt,
)
from support.long import exhaustive_but
from support.particle_run import assert_trees_close


METHOD = LobattoIIIAB(3)
STEPS = SaveAt(t0=True, steps=True)


def slide(t, q, v, args):
    return 0.5 * v @ v - 0.7 * q[0] ** 2 - 0.25 * q[1] ** 4 - 0.1 * q[2]


SLIDE = nhjax.LagrangianSystem(
    slide, nonholonomic=lambda t, q, v, args: (v[2] - q[1] * v[0])[None]
)
PENDULUM = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v + jnp.cos(q[0]))
BALL = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - 9.81 * q[0])
PID = PIDController(rtol=1e-6, atol=1e-6)


def start(system, q, v):
    q, v = (jnp.atleast_1d(jnp.asarray(x, float)) for x in (q, v))
    return nhjax.initial_state(system, q, v, project=True)


SLIDING = start(SLIDE, [0.4, 0.7, 0.0], [0.9, 0.8, 0.0])
SWINGING = start(PENDULUM, 1.0, 0.5)


def swing(
    controller: Any = PID,
    y0: Any = SWINGING,
    system: Any = PENDULUM,
    method: Any = METHOD,
    **options: Any,
):
    return nhjax.integrate(
        system, method, y0, stepsize_controller=controller, **options
    )


def sizes_of(sol) -> Any:
    return np.diff(np.asarray(sol.ts))


def attempts_of(sol):
    return int(sol.stats["num_steps"] + sol.stats["num_rejected_steps"])


# PID controller ----------------------------------------------------------------------


def test_pid_accepts_steps_with_errors_of_at_most_one_tolerance():
    errors = [
        float(swing(num_steps=number).stats["max_error_over_tolerance"])
        for number in range(1, 30)
    ]
    assert max(errors) <= 1
    assert np.all(np.diff(errors) >= 0)
    # After the first steps, sizes are as large as the tolerance allows.
    assert np.median(errors) > 0.1


def reduced(t, x):
    """The motion of the slide, from the principle of Lagrange and d'Alembert."""
    y, (a, b, c) = x[1], x[3:]
    slopes = np.array([1.4 * x[0], y**3, 0.1])
    reaction = (slopes[2] - y * slopes[0] + a * b) / (1 + y**2)
    return [a, b, c, -slopes[0] - y * reaction, -slopes[1], reaction - slopes[2]]


@pytest.fixture(scope="module")
def exact():
    x = np.concatenate([SLIDING.q, SLIDING.v])
    given = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    return solve_ivp(reduced, (0, 6), x, **given).y[:, -1]


@pytest.mark.parametrize("stages", exhaustive_but([3], [2, 3, 4]))
def test_pid_with_a_smaller_tolerance_has_an_error_that_is_smaller_by_its_order(
    exact, stages
):
    method, errors, numbers = LobattoIIIAB(stages), [], []
    loose, tight = {2: (1e-3, 1e-7), 3: (1e-4, 1e-8), 4: (1e-5, 1e-9)}[stages]
    for rtol in (loose, tight):
        sol = swing(
            *(PIDController(rtol, rtol), SLIDING, SLIDE, method),
            t1=6.0,
            max_steps=100_000,
        )
        x = np.concatenate([sol.ys.q[-1], sol.ys.v[-1]])
        errors.append(np.max(np.abs(x - exact)))
        numbers.append(int(sol.stats["num_steps"]))
    p = 2 * stages - 2
    np.testing.assert_allclose(
        np.log10(errors[0] / errors[1]), 4 * p / (p + 1), rtol=0, atol=0.5
    )
    # The number of steps is proportional to the tolerance to the power -1 / (p + 1).
    np.testing.assert_allclose(
        np.log10(numbers[1] / numbers[0]), 4 / (p + 1), rtol=0, atol=0.15
    )


STIFF = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v - 50.0 * q[0] ** 4 - jnp.exp(3 * q[0])
)


def test_pid_repeats_steps_that_are_not_solved():
    y = start(STIFF, 1.0, -2.0)
    with pytest.warns(UserWarning, match="did not solve step 0"):
        one = nhjax.integrate(STIFF, METHOD, y, dt=20.0, num_steps=1, throw=False)
    assert one.result != RESULTS.successful
    sol = swing(PID, y, STIFF, dt=20.0, t1=20.0, saveat=STEPS, max_steps=10_000)
    assert sol.result == RESULTS.successful
    assert int(sol.stats["num_rejected_steps"]) >= 2
    first = float(sizes_of(sol)[0])
    assert first < 0.2
    assert int(sol.stats["failed_step"]) == -1
    # Until the first step is accepted, each attempt is at least a fifth of the last.
    other = swing(PID, y, STIFF, dt=first, t1=20.0, saveat=STEPS, max_steps=10_000)
    np.testing.assert_allclose(other.ts, sol.ts, rtol=1e-12)


def test_pid_counts_each_attempt():
    sol = swing(t1=9.0, dt=2.0, saveat=STEPS)
    number, attempts = int(sol.stats["num_steps"]), attempts_of(sol)
    assert len(sol.ts) == number + 1
    assert attempts > number
    assert attempts_of(swing(t1=9.0, dt=2.0, max_steps=attempts)) == attempts
    cut = swing(t1=9.0, dt=2.0, max_steps=attempts - 1, throw=False)
    assert cut.result == RESULTS.max_steps_reached
    with pytest.raises(nhjax.IntegrationError, match="`max_steps` attempts"):
        swing(t1=9.0, dt=2.0, max_steps=attempts - 1)


@pytest.mark.parametrize("adjoint", [DirectAdjoint(), RecursiveCheckpointAdjoint()])
def test_run_that_saves_its_end_needs_no_memory_for_max_steps(adjoint):
    def end(y0):
        return swing(y0=y0, t1=9.0, max_steps=10**6, adjoint=adjoint).ys.q

    memory = jax.jit(end).lower(SWINGING).compile().memory_analysis()
    assert memory is not None
    assert memory.temp_size_in_bytes < 10**5


def test_pid_rejects_few_steps_of_a_smooth_motion():
    sol = swing(PID, SLIDING, SLIDE, t1=20.0)
    share = int(sol.stats["num_rejected_steps"]) / attempts_of(sol)
    assert share < 0.2


def test_pid_rejects_few_steps_of_an_orbit_with_close_passes():
    """Before each close pass the errors grow from step to step by large factors."""
    attraction = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v + 1 / jnp.hypot(q[0], q[1])
    )
    y0 = nhjax.initial_state(attraction, jnp.array([1.9, 0.0]), jnp.array([0.0, 0.23]))
    sol = swing(PIDController(1e-7, 1e-9), y0, attraction, LobattoIIIAB(4), t1=31.4)
    assert int(sol.stats["num_rejected_steps"]) < 0.1 * attempts_of(sol)


def test_pid_keeps_sizes_within_dtmin_and_dtmax():
    free = sizes_of(swing(t1=9.0, saveat=STEPS))
    least, most = np.quantile(free, [0.25, 0.75])
    limited = PIDController(1e-6, 1e-6, dtmax=float(most))
    sizes = sizes_of(swing(limited, t1=9.0, saveat=STEPS))
    assert np.max(sizes) <= most * (1 + 1e-9)
    assert np.sum(np.isclose(sizes, most)) > 3
    loose = PIDController(1e-3, 1e-3, dtmin=float(least))
    sizes = sizes_of(swing(loose, t1=9.0, saveat=STEPS))
    assert np.min(sizes[:-1]) >= least * (1 - 1e-9)


def test_pid_that_needs_steps_below_dtmin_fails_and_returns_the_part_before():
    limited = PIDController(1e-8, 1e-8, dtmin=0.1)
    sol = swing(limited, dt=0.1, t1=9.0, throw=False, saveat=STEPS)
    assert sol.result == RESULTS.dt_min_reached
    number = int(sol.stats["num_steps"])
    assert len(sol.ts) == number + 1 == int(sol.stats["failed_step"]) + 1
    assert float(sol.t1) == float(sol.ts[-1]) < 9.0
    with pytest.raises(nhjax.IntegrationError, match="`dtmin`"):
        swing(limited, dt=0.1, t1=9.0)


def test_pid_changes_sizes_within_factormin_and_factormax():
    slow = PIDController(1e-6, 1e-6, factormin=0.9, factormax=1.25)
    sol = swing(slow, dt=1e-3, t1=9.0, saveat=STEPS)
    sizes = sizes_of(sol)[:-1]
    changes = sizes[1:] / sizes[:-1]
    assert np.max(changes) <= 1.25 * (1 + 1e-9)
    assert changes[0] > 1.25 * (1 - 1e-9)
    if int(sol.stats["num_rejected_steps"]) == 0:
        assert np.min(changes) >= 0.9 * (1 - 1e-9)


@pytest.mark.parametrize("name", exhaustive_but(["dcoeff"], ["pcoeff", "dcoeff"]))
def test_pid_with_other_coefficients_takes_other_steps_to_the_same_end(name):
    other = PIDController(1e-8, 1e-8, **{name: 0.3}, icoeff=0.4)
    one = swing(PIDController(1e-8, 1e-8), t1=9.0)
    sol = swing(other, t1=9.0, saveat=STEPS)
    assert int(sol.stats["num_steps"]) != int(one.stats["num_steps"])
    np.testing.assert_allclose(sol.ys.q[-1], one.ys.q[-1], rtol=0, atol=1e-6)


def test_pid_with_slow_coefficients_is_not_slowed_further_by_predictions():
    """These coefficients follow the error slowly, so that few steps are rejected.

    With a smaller `safety`, they keep the errors further below the tolerance.
    """
    default = PIDController(1e-7, 1e-7, safety=0.9)
    slow = PIDController(1e-7, 1e-7, safety=0.9, pcoeff=1 / 6, icoeff=1 / 6)
    attempts = [
        attempts_of(swing(x, method=LobattoIIIAB(4), t1=40.0)) for x in (slow, default)
    ]
    assert attempts[0] < 1.3 * attempts[1]


def test_pid_of_motion_at_rest_in_single_precision_takes_few_steps():
    """The errors are zero, and the smallest error that counts underflows."""
    at_rest = start(PENDULUM, np.float32(0.0), np.float32(0.0))
    at_rest = jax.tree.map(lambda x: x.astype(jnp.float32), at_rest)
    grows = PIDController(1e-4, 1e-4, factormax=1000.0)
    sol = swing(grows, at_rest, method=LobattoIIIAB(7), dt=1e-6, t1=1e4)
    assert int(sol.stats["num_steps"]) < 10


def test_pid_that_resumes_with_a_small_dt_grows_its_steps_at_once():
    save = SaveAt(t1=True, checkpoint=True)
    part = swing(PIDController(1e-8, 1e-8), t1=5.0, saveat=save)
    options = {"dt": 1e-4, "t1": 10.0, "saveat": STEPS}
    sol = swing(PIDController(1e-8, 1e-8), part.checkpoint, **options)
    assert np.all(np.diff(sizes_of(sol)[:4]) > 0)


HANGING = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - 3.0 * q[0] ** 2)
FALLING = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - jnp.cos(q[0]))
FIRST = {
    "equilibrium": (HANGING, 0.0, 0.0, PID),
    "zero position": (HANGING, 0.0, 1.0, PID),
    "at rest": (HANGING, 1.0, 0.0, PID),
    "at zero with a force": (BALL, 0.0, 0.0, PID),
    "very fast": (PENDULUM, 0.3, 1e4, PID),
    "very slow": (PENDULUM, 1e-9, 1e-9, PID),
    "large numbers": (HANGING, 1e8, 0.0, PIDController(1e-6, 1.0)),
    "small numbers": (HANGING, 1e-8, 0.0, PIDController(1e-6, 1e-14)),
    "no absolute tolerance": (HANGING, 1.0, 0.3, PIDController(1e-6, 0.0)),
    "zero without absolute tolerance": (HANGING, 0.0, 1.0, PIDController(1e-6, 0.0)),
}


# The largest steps of the slowest motion are not solved, and are rejected.
@pytest.mark.filterwarnings("ignore:The steps of this run took")
@pytest.mark.parametrize("name", FIRST)
def test_pid_without_dt_takes_a_sensible_first_step(name):
    system, q, v, controller = FIRST[name]
    length = 1e-2 if name == "very fast" else 10.0
    y = start(system, q, v)
    options = {"t1": length, "max_steps": 10_000, "saveat": STEPS}
    sol = swing(controller, y, system, **options)
    sizes = sizes_of(sol)
    assert np.all(sizes > 0)
    largest = float(np.max(sizes))
    best = swing(controller, y, system, dt=largest, **options)
    # Each attempt changes the size by a factor between 0.2 and 10: ten are enough.
    assert attempts_of(sol) <= attempts_of(best) + 10


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rtol": 0.0}, "`rtol` must be finite, > 0"),
        ({"rtol": -1e-3}, "`rtol` must be finite, > 0"),
        ({"rtol": np.nan}, "`rtol` must be finite"),
        ({"rtol": "1e-6"}, "`rtol` must be a real number"),
        ({"rtol": True}, "`rtol` must be a real number"),
        ({"rtol": np.array([1e-6, 1e-6])}, "`rtol` must be a real number"),
        ({"atol": -1.0}, "`atol` must be finite, >= 0"),
        ({"dtmin": 0.0}, "`dtmin` must be finite, > 0"),
        ({"dtmax": -1.0}, "`dtmax` must be finite, > 0"),
        ({"dtmin": 2.0, "dtmax": 1.0}, "`dtmin` = 2.0 is larger than `dtmax` = 1.0"),
        ({"factormin": 1.5}, "`factormin` must be finite"),
        ({"factormax": 0.5}, "`factormax` must be finite"),
        ({"safety": 1.5}, "`safety` must be finite"),
        ({"icoeff": np.inf}, "`icoeff` must be finite"),
    ],
)
def test_pid_with_numbers_out_of_range_raises_an_error_that_names_them(
    options, message
):
    with pytest.raises((ValueError, TypeError), match=f"PIDController: {message}"):
        PIDController(**({"rtol": 1e-6, "atol": 1e-6} | options))


def test_pid_refuses_a_method_of_one_node():
    with pytest.raises(ValueError, match="two nodes or more"):
        swing(method=nhjax.Gauss(1), t1=1.0)


def test_controllers_with_other_numbers_do_not_trace_again():
    traces = []

    def lagrangian(t, q, v, args):
        traces.append(1)
        return 0.5 * v @ v + jnp.cos(q[0])

    system = nhjax.LagrangianSystem(lagrangian)
    y = start(system, 1.0, 0.5)
    for kind in (
        lambda x: PIDController(x, 0.1 * x, dtmax=1e4 * x),
        lambda x: ReversibleController(1e4 * x, density),
    ):
        swing(kind(1e-5), y, system, t1=1.0)
        count = len(traces)
        swing(kind(2e-5), y, system, t1=1.5, max_steps=100)
        assert len(traces) == count


# Reversible controller ---------------------------------------------------------------


def density(t, q, v, args):
    return 1.0 + q[0] ** 2 + 0.2 * v[0] ** 2


def driven_density(t, q, v, args):
    return (1.0 + 0.3 * jnp.sin(t)) * (1.0 + q[0] ** 2)


DENSITIES = {"user": density, "driven": driven_density, "automatic": None}


@pytest.mark.parametrize("name", DENSITIES)
@pytest.mark.parametrize("number", [400, pytest.param(10_000, marks=pytest.mark.long)])
def test_reversible_steps_retrace_the_run(name, number):
    controller = ReversibleController(0.1, DENSITIES[name])
    saveat = SaveAt(t0=True, steps=True, checkpoint=True)
    there = swing(controller, t0=0.3, num_steps=number, saveat=saveat)
    back = swing(
        controller, there.checkpoint, t1=0.3, saveat=saveat, max_steps=number + 10
    )
    assert int(back.stats["num_steps"]) == number
    # Round-off of the phase grows with the square of the time.
    atol = 1e-12 if number == 400 else 1e-10
    np.testing.assert_allclose(back.ts[::-1], there.ts, rtol=0, atol=atol)
    np.testing.assert_allclose(back.ys.q[::-1], there.ys.q, rtol=0, atol=atol)
    assert float(back.t1) == 0.3
    assert np.ptp(sizes_of(there)) > 0.1 * np.max(sizes_of(there))


@pytest.mark.parametrize("name", ["user", "driven"])
@pytest.mark.parametrize("sign", [1, -1])
def test_reversible_steps_follow_the_formula_of_hairer_and_soderlind(name, sign):
    eps, y, t, number = 0.15 * sign, SWINGING, 0.4, 25
    controller = ReversibleController(abs(eps), DENSITIES[name])
    end = t + 100.0 * sign
    sol = swing(controller, t0=t, t1=end, max_steps=number, throw=False, saveat=STEPS)

    def rate(t, y):
        (q,), (v,) = np.asarray(y.q), np.asarray(y.v)
        along = 2 * q * v
        if name == "user":
            along -= 0.4 * v * np.sin(q)
            return along / (1 + q**2 + 0.2 * v**2)
        return along / (1 + q**2) + 0.3 * np.cos(t) / (1 + 0.3 * np.sin(t))

    rho = float(DENSITIES[name](t, y.q, y.v, None)) + 0.5 * eps * rate(t, y)
    for k in range(number):
        h = eps / rho
        y, t = nhjax.step(PENDULUM, METHOD, t, h, y), t + h
        np.testing.assert_allclose(sol.ts[k + 1], t, rtol=1e-12)
        np.testing.assert_allclose(sol.ys.q[k + 1], y.q, rtol=0, atol=1e-12)
        rho += eps * rate(t, y)


def oscillator(t, q, v, args):
    square = 1.0 if args is None else args**2
    return 1.7 * (0.5 * v @ v - 0.5 * square * q @ q)


OSCILLATOR = nhjax.LagrangianSystem(oscillator)


@pytest.mark.parametrize("frequency", [0.02, 1.0, 30.0])
def test_automatic_density_of_an_oscillator_is_its_frequency(frequency):
    y, controller = start(OSCILLATOR, 0.3, 0.4), ReversibleController(0.1)
    options = {"num_steps": 20, "args": frequency, "saveat": STEPS}
    sol = swing(controller, y, OSCILLATOR, **options)
    np.testing.assert_allclose(sizes_of(sol), 0.1 / frequency, rtol=1e-12)


def test_automatic_density_does_not_depend_on_units_or_the_form():
    mass, unit = jnp.array([[2.0, 0.3], [0.3, 1.1]]), 1e3

    def potential(q):
        return 0.5 * q @ q + 0.3 * q[0] ** 4 + jnp.cos(q[1])

    lagrangian = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ mass @ v - potential(q)
    )
    other_units = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ mass @ v / unit**2 - potential(q / unit)
    )
    hamiltonian = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ jnp.linalg.solve(mass, p) + potential(q)
    )
    q, v = jnp.array([0.4, -0.9]), jnp.array([1.1, 0.2])
    controller, runs = ReversibleController(0.1), []
    for system, y in (
        (lagrangian, start(lagrangian, q, v)),
        (other_units, start(other_units, unit * q, unit * v)),
        (hamiltonian, nhjax.initial_state(hamiltonian, q, p=mass @ v)),
    ):
        runs.append(swing(controller, y, system, num_steps=40, saveat=STEPS).ts)
    assert np.ptp(np.diff(runs[0])) > 0.01
    np.testing.assert_allclose(runs[1], runs[0], rtol=1e-10)
    np.testing.assert_allclose(runs[2], runs[0], rtol=1e-10)


def test_pid_steps_of_both_forms_are_the_same():
    # With a mass of one, momenta and velocities have the same tolerances.
    hamiltonian = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p - jnp.cos(q[0])
    )
    y = nhjax.initial_state(hamiltonian, SWINGING.q, p=SWINGING.p)
    one, other = (
        swing(t1=5.0, saveat=STEPS),
        swing(PID, y, hamiltonian, t1=5.0, saveat=STEPS),
    )
    np.testing.assert_allclose(one.ts, other.ts, rtol=1e-9)


def test_reversible_steps_keep_an_energy_that_pid_steps_lose():
    def energies(controller):
        sol = swing(controller, t1=600.0, max_steps=20_000, saveat=STEPS)
        y = sol.ys
        return np.asarray(0.5 * y.v[:, 0] ** 2 - jnp.cos(y.q[:, 0]))

    kept = energies(ReversibleController(0.35, density))
    lost = energies(PIDController(1e-3, 1e-3))

    def drift(energy):
        third = len(energy) // 3
        return abs(np.mean(energy[-third:]) - np.mean(energy[:third]))

    assert drift(kept) < 1e-2 * np.ptp(kept)
    assert drift(lost) > 30 * drift(kept)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda t, q, v, args: 1.0 - t, "density"),
        (lambda t, q, v, args: 0.0 * t, "step density"),
        (lambda t, q, v, args: -1.0 + 0.0 * t, "step density"),
        (lambda t, q, v, args: jnp.nan * t, "step density"),
        (lambda t, q, v, args: q, r"must return a number of shape \(\)"),
        (lambda t, q, v, args: None, r"must return a number of shape \(\)"),
        (lambda t, q, v, args: jnp.float32(1.0), "returns dtype float32"),
        (lambda t, q, v: 1.0 + t, "density"),
    ],
)
def test_reversible_controller_with_a_bad_density_raises_an_error(function, message):
    errors = nhjax.IntegrationError, nhjax.ShapeError, nhjax.DTypeError, TypeError
    with pytest.raises(errors, match=message):
        swing(ReversibleController(0.1, function), t1=3.0)


def test_reversible_run_whose_density_vanishes_returns_the_part_before():
    controller = ReversibleController(0.1, lambda t, q, v, args: 1.0 - t)
    sol = swing(controller, t1=3.0, throw=False, saveat=STEPS)
    assert sol.result == RESULTS.density_not_positive
    assert 0 < float(sol.t1) == float(sol.ts[-1]) < 1
    assert len(sol.ts) == int(sol.stats["num_steps"]) + 1
    assert np.all(np.isfinite(sol.ys.q))


@pytest.mark.parametrize("eps", [0.0, -0.1, np.nan, np.inf, "0.1", True, None])
def test_reversible_controller_with_a_bad_eps_raises_an_error(eps):
    with pytest.raises((ValueError, TypeError), match="ReversibleController: `eps`"):
        ReversibleController(eps)


def test_reversible_controller_with_a_density_that_is_no_function_raises_an_error():
    with pytest.raises(TypeError, match="`density` must be a function"):
        ReversibleController(0.1, 3.0)  # pyright: ignore[reportArgumentType]


# Derivatives -------------------------------------------------------------------------

CONTROLLERS = {"pid": PID, "reversible": ReversibleController(0.1, density)}
ADJOINTS = {
    "direct": DirectAdjoint(),
    "recursive": RecursiveCheckpointAdjoint(),
    "reversible": ReversibleAdjoint(),
}


SYSTEMS = {"pendulum": (PENDULUM, SWINGING), "slide": (SLIDE, SLIDING)}


def end_from(v, name, controller, **options):
    system, y = SYSTEMS[name]
    y = nhjax.initial_state(system, y.q, v, project=True)
    sol = swing(controller, y, system, **({"t1": 1.2, "max_steps": 30} | options))
    return jnp.sum(jnp.sin(sol.ys.q[-1]) + sol.ys.p[-1] ** 2)


def given_end(v, name, sizes):
    system, y = SYSTEMS[name]
    y = nhjax.initial_state(system, y.q, v, project=True)
    sol = nhjax.integrate(system, METHOD, y, dt=sizes)
    return jnp.sum(jnp.sin(sol.ys.q[-1]) + sol.ys.p[-1] ** 2)


def sizes_to_end(name, controller):
    system, y = SYSTEMS[name]
    return jnp.diff(swing(controller, y, system, t1=1.2, saveat=STEPS).ts)


@pytest.mark.parametrize(
    ("name", "which"),
    exhaustive_but([("pendulum", "pid")], itertools.product(SYSTEMS, CONTROLLERS)),
)
def test_gradients_of_all_adjoints_are_those_of_the_run_with_the_same_sizes(
    name, which
):
    controller, v = CONTROLLERS[which], SYSTEMS[name][1].v
    sizes = sizes_to_end(name, controller)
    expected = jax.jit(jax.grad(given_end), static_argnums=1)(v, name, sizes)
    for adjoint in ADJOINTS.values():

        def end(v, adjoint=adjoint):
            return end_from(v, name, controller, adjoint=adjoint)

        np.testing.assert_allclose(
            jax.jit(jax.grad(end))(v), expected, rtol=1e-10, atol=1e-11
        )
    forward = jax.jit(jax.jacfwd(lambda v: end_from(v, name, controller)))(v)
    np.testing.assert_allclose(forward, expected, rtol=1e-10, atol=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("name", SYSTEMS)
def test_hessian_of_an_adaptive_run_is_that_of_the_run_with_the_same_sizes(name):
    v, sizes = SYSTEMS[name][1].v, sizes_to_end(name, PID)
    expected = jax.jit(jax.hessian(given_end), static_argnums=1)(v, name, sizes)
    got = jax.jit(jax.hessian(lambda v: end_from(v, name, PID)))(v)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("adjoint", exhaustive_but(["direct", "reversible"], ADJOINTS))
def test_derivative_by_the_end_time_is_the_velocity(adjoint):
    options = {"max_steps": 40, "adjoint": ADJOINTS[adjoint]}

    def end(t0, t1):
        sol = swing(PIDController(1e-8, 1e-8), t0=t0, t1=t1, **options)
        return sol.ys.q[-1, 0]

    by_t0, by_t1 = jax.jit(jax.grad(end, argnums=(0, 1)))(0.2, 1.1)
    v = float(swing(PIDController(1e-8, 1e-8), t0=0.2, t1=1.1).ys.v[-1, 0])
    # The derivative of the discrete motion differs by the error of the method.
    np.testing.assert_allclose([by_t0, by_t1], [-v, v], rtol=1e-5)


def test_derivative_by_the_end_time_of_the_time_itself_is_one():
    def end(t1):
        return swing(t1=t1, max_steps=40).t1

    assert float(jax.grad(end)(1.1)) == 1.0


@pytest.mark.parametrize("adjoint", exhaustive_but(["direct"], ADJOINTS))
def test_gradient_of_an_adaptive_run_that_failed_is_nan(adjoint):
    def end(v):
        sol = swing(
            PID,
            nhjax.initial_state(PENDULUM, SWINGING.q, v),
            t1=5.0,
            max_steps=6,
            adjoint=ADJOINTS[adjoint],
            throw=False,
        )
        return sol.ys.q[-1, 0]

    assert np.all(np.isnan(jax.jit(jax.grad(end))(SWINGING.v)))


@pytest.mark.long
def test_vmap_of_gradients_equals_single_gradients():
    speeds = jnp.array([0.3, 1.0, 2.0])

    def end(speed):
        return end_from(speed * SWINGING.v, "pendulum", PID, max_steps=50)

    several = jax.jit(jax.vmap(jax.grad(end)))(speeds)
    one = jax.jit(jax.grad(end))
    np.testing.assert_allclose(several, [one(x) for x in speeds], rtol=1e-9)


# Events ------------------------------------------------------------------------------

BOUNCE = Event(
    lambda t, y, args: y.q[0], reset=lambda t, y, args: (y.q, -0.8 * y.v), max_events=8
)
WAYS = {
    "pid": {"t1": 2.4, "stepsize_controller": PID},
    "reversible": {
        "t1": 2.4,
        "stepsize_controller": ReversibleController(0.1, density),
    },
    "constant": {"t1": 2.4, "dt": 0.07},
    "given": {"dt": jnp.linspace(0.03, 0.05, 60)},
}
DROP = start(BALL, 1.0, 0.0)


@pytest.mark.parametrize("name", WAYS)
def test_events_of_a_bouncing_ball_match_closed_form_with_all_step_sizes(name):
    sol = nhjax.integrate(BALL, METHOD, DROP, event=BOUNCE, **WAYS[name], saveat=STEPS)
    fall = np.sqrt(2 / 9.81)
    times = [fall]
    while len(times) < 8:
        times.append(times[-1] + 2 * fall * 0.8 ** len(times))
    number = int(sol.events.num)
    assert number == np.sum(np.array(times) < 2.4) >= 3
    np.testing.assert_allclose(sol.events.ts[:number], times[:number], rtol=1e-13)
    assert np.all(np.isinf(sol.events.ts[number:]))
    # After the last bounce the ball flies freely.
    since = 2.4 - times[number - 1]
    v = 9.81 * fall * 0.8**number
    np.testing.assert_allclose(
        sol.ys.q[-1, 0], v * since - 0.5 * 9.81 * since**2, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(sol.t1, 2.4, rtol=1e-15)
    assert len(sol.ts) == int(sol.stats["num_steps"]) + 1
    assert np.all(np.diff(sol.ts) > 0)


@pytest.mark.parametrize("name", WAYS)
def test_event_that_ends_a_run_has_the_last_row_with_all_step_sizes(name):
    stop = Event(lambda t, y, args: y.q[0] - 0.3)
    sol = nhjax.integrate(BALL, METHOD, DROP, event=stop, **WAYS[name], saveat=STEPS)
    end = np.sqrt(2 * 0.7 / 9.81)
    assert sol.result == RESULTS.event_occurred
    np.testing.assert_allclose([sol.t1, sol.ts[-1]], end, rtol=1e-14)
    np.testing.assert_allclose(sol.ys.q[-1, 0], 0.3, rtol=1e-14)
    assert len(sol.ts) == int(sol.stats["num_steps"]) + 2


def test_event_that_ends_a_jitted_run_is_followed_by_padding():
    stop = Event(lambda t, y, args: y.q[0] - 0.3)
    options = {"event": stop, "t1": 2.4, "max_steps": 40, "saveat": STEPS}
    expected = swing(PID, DROP, BALL, **options)
    got = jax.jit(lambda y: swing(PID, y, BALL, **options))(DROP)
    number = len(expected.ts)
    assert_trees_close(got.ts[:number], expected.ts, rtol=1e-14)
    assert_trees_close(got.ys.q[:number], expected.ys.q, rtol=0, atol=1e-14)
    assert np.all(np.isinf(got.ts[number:]))


def test_event_rejected_step_finds_the_same_events():
    crossing = Event(lambda t, y, args: y.q[0] - 0.2, terminate=False, max_events=20)
    sol = swing(t1=20.0, event=crossing, dt=20.0, saveat=STEPS)
    assert int(sol.stats["num_rejected_steps"]) > 2
    fine = nhjax.integrate(
        PENDULUM, LobattoIIIAB(6), SWINGING, dt=0.02, num_steps=1000, event=crossing
    )
    number = int(fine.events.num)
    assert int(sol.events.num) == number > 4
    np.testing.assert_allclose(
        sol.events.ts[:number], fine.events.ts[:number], rtol=0, atol=1e-4
    )


def test_event_that_never_happens_does_not_change_the_steps():
    never = Event(lambda t, y, args: y.q[0] - 50.0, terminate=False)
    expected = swing(t1=9.0, saveat=STEPS)
    sol = swing(t1=9.0, event=never, saveat=STEPS)
    np.testing.assert_allclose(sol.ts, expected.ts, rtol=1e-10)
    rejected = sol.stats["num_rejected_steps"], expected.stats["num_rejected_steps"]
    assert rejected[0] == rejected[1]


@pytest.mark.parametrize("is_jitted", [False, True])
def test_event_run_takes_no_more_attempts_than_max_steps(is_jitted):
    never = Event(lambda t, y, args: y.q[0] - 50.0, terminate=False)
    attempts = attempts_of(swing(t1=9.0))
    for most, result in (
        (attempts, RESULTS.successful),
        (attempts - 1, RESULTS.max_steps_reached),
    ):

        def run(y, most=most):
            return swing(
                PID, y, t1=9.0, event=never, max_steps=most, throw=False, saveat=STEPS
            )

        sol = (jax.jit(run) if is_jitted else run)(SWINGING)
        assert sol.result == result
        assert attempts_of(sol) == most
        number = int(sol.stats["num_steps"])
        assert np.sum(np.isfinite(sol.ts)) == number + 1


@pytest.mark.parametrize("name", exhaustive_but(["pid"], ["pid", "reversible"]))
def test_event_at_the_end_of_a_run_or_at_a_node_happens_once(name):
    way = dict(WAYS[name])
    if name == "reversible":
        # The ball falls fast.
        way["stepsize_controller"] = ReversibleController(1.0, density)
    nodes = nhjax.integrate(BALL, METHOD, DROP, **way, saveat=STEPS).ts
    for t in (float(nodes[3]), 2.4, float(nodes[-2])):
        at = Event(lambda t, y, args: t - args, terminate=False)
        sol = nhjax.integrate(BALL, METHOD, DROP, args=t, event=at, **way, saveat=STEPS)
        assert sol.result == RESULTS.successful
        assert int(sol.events.num) == 1
        np.testing.assert_allclose(sol.events.ts[0], t, rtol=1e-14)
        assert float(sol.t1) == 2.4
        np.testing.assert_allclose(sol.ys.q[-1, 0], 1 - 0.5 * 9.81 * 2.4**2, rtol=1e-13)


@pytest.mark.parametrize(
    ("name", "adjoint"),
    exhaustive_but(
        [("pid", "direct")],
        itertools.product(["pid", "reversible", "constant"], ["direct", "recursive"]),
    ),
)
def test_gradient_of_an_event_time_matches_closed_form(name, adjoint):
    def impact(height):
        y = nhjax.initial_state(BALL, height[None], jnp.zeros(1))
        sol = nhjax.integrate(
            *(BALL, METHOD, y),
            event=BOUNCE,
            max_steps=80,
            adjoint=ADJOINTS[adjoint],
            **WAYS[name],
        )
        return sol.events.ts[0], sol.ys.q[-1, 0]

    by_time, by_end = jax.jit(jax.jacrev(impact))(jnp.array(1.0))
    np.testing.assert_allclose(by_time, np.sqrt(0.5 / 9.81), rtol=1e-12)

    def end(height):
        fall, number = np.sqrt(2 * height / 9.81), 1
        t = fall
        while t + 2 * fall * 0.8**number < 2.4:
            t, number = t + 2 * fall * 0.8**number, number + 1
        v = 9.81 * fall * 0.8**number
        return v * (2.4 - t) - 0.5 * 9.81 * (2.4 - t) ** 2

    d = 1e-6
    slope = (end(1 + d) - end(1 - d)) / (2 * d)
    np.testing.assert_allclose(by_end, slope, rtol=1e-7)


def test_reversible_adjoint_of_events_with_steps_that_differ_is_refused():
    with pytest.raises(ValueError, match="ReversibleAdjoint cannot retrace"):
        swing(PID, DROP, BALL, t1=2.4, event=BOUNCE, adjoint=ReversibleAdjoint())


def test_suggested_step_solves_a_run_to_the_tolerance_and_divides_its_length():
    y0 = nhjax.initial_state(PENDULUM, jnp.array([2.0]), jnp.zeros(1))
    dt = nhjax.suggest_step(PENDULUM, METHOD, y0, t1=6.0, rtol=1e-6)
    number = round(6.0 / dt)
    assert dt == pytest.approx(6.0 / number, rel=1e-14)
    sol = nhjax.integrate(PENDULUM, METHOD, y0, dt=dt, num_steps=number)
    exact = solve_ivp(
        lambda t, x: [x[1], -np.sin(x[0])], (0, 6), [2.0, 0.0], rtol=1e-12, atol=1e-12
    ).y[0, -1]
    # Errors of steps add up, and a step that is far too small has a far smaller error.
    assert 1e-8 < abs(float(sol.ys.q[-1, 0]) - exact) < 1e-5


def test_suggested_step_of_run_that_ends_while_its_steps_grow_is_not_the_first():
    # The motion is as small as the tolerance, so that each step could be the last.
    y0 = nhjax.initial_state(PENDULUM, jnp.array([1e-6]), jnp.array([1e-6]))
    dt = nhjax.suggest_step(PENDULUM, METHOD, y0, t1=0.4, rtol=1e-6)
    assert 0.1 < dt <= 0.4


def test_suggested_step_inside_of_jit_is_refused():
    y0 = nhjax.initial_state(PENDULUM, jnp.ones(1), jnp.zeros(1))
    with pytest.raises(RuntimeError, match="outside of jit"):
        jax.jit(lambda y: nhjax.suggest_step(PENDULUM, METHOD, y, t1=1.0, rtol=1e-6))(
            y0
        )


# Motions whose momenta are conserved.


def _driven_by_gauge(t, q, v, args):
    """The momentum v + sin(3 t) is conserved."""
    return 0.5 * v @ v + v[0] * jnp.sin(3 * t)


def _with_mass_that_changes(t, q, v, args):
    return 0.5 * (2 + jnp.sin(3 * t)) * v @ v


@pytest.mark.parametrize("stages", [3, 4])
@pytest.mark.parametrize("lagrangian", [_driven_by_gauge, _with_mass_that_changes])
def test_pid_with_a_momentum_that_is_conserved_meets_its_tolerance(lagrangian, stages):
    system = nhjax.LagrangianSystem(lagrangian)
    y0 = nhjax.initial_state(system, jnp.zeros(1), jnp.ones(1))
    p = y0.p[0]

    def velocity(t):
        if lagrangian is _driven_by_gauge:
            return p - np.sin(3 * t)
        return p / (2 + np.sin(3 * t))

    exact, _ = quad(velocity, 0, 10, epsabs=1e-12, limit=200)
    for tolerance in (1e-5, 1e-8):
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages),
            y0,
            t1=10.0,
            stepsize_controller=nhjax.PIDController(tolerance, tolerance),
        )
        assert abs(sol.ys.q[-1, 0] - exact) < 20 * tolerance * 10


@pytest.mark.parametrize("stages", [3, 4])
def test_pid_with_a_free_body_meets_its_tolerance(stages):
    body = nhjax.systems.FreeRigidBody()
    y0, moments = body.initial_state(), np.asarray(body.moments)
    exact = solve_ivp(
        lambda t, w: np.cross(moments * w, w) / moments,
        (0, 10),
        np.asarray(y0.v),
        "DOP853",
        rtol=1e-12,
        atol=1e-13,
    ).y[:, -1]
    for tolerance in (1e-5, 1e-8):
        sol = nhjax.integrate(
            body.system,
            nhjax.LobattoIIIAB(stages),
            y0,
            t1=10.0,
            stepsize_controller=nhjax.PIDController(tolerance, tolerance),
        )
        assert np.abs(sol.ys.v[-1] - exact).max() < 50 * tolerance


# Resets.


@pytest.mark.parametrize("factor", [0.3, 0.5, 2.0])
def test_reversible_controller_after_a_reset_takes_the_density_of_the_new_state(factor):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v + 1 / jnp.sqrt(q @ q)
    )
    controller = nhjax.ReversibleController(
        eps=0.1, density=lambda t, q, v, args: (q @ q) ** -0.75
    )

    def to_another_circle(t, y, args):
        return factor**2 * y.q, y.v / factor

    event = nhjax.Event(
        lambda t, y, args: t - 3.05, reset=to_another_circle, max_events=1
    )
    y0 = nhjax.initial_state(system, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(4),
        y0,
        t1=6.0,
        stepsize_controller=controller,
        event=event,
        saveat=nhjax.SaveAt(steps=True),
    )
    # On a circle of radius r the density is r^(-3/2).
    np.testing.assert_allclose(sol.ts[-2] - sol.ts[-3], 0.1 * factor**3, rtol=1e-8)
    radii = np.linalg.norm(sol.ys.q[-3:], axis=1)
    np.testing.assert_allclose(radii, factor**2, rtol=1e-9)


def test_reversible_controller_with_many_bounces_keeps_its_energy():
    def potential(q):
        return q[0] + 0.3 * q[0] ** 2

    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - potential(q))
    bounce = nhjax.Event(
        lambda t, y, args: y.q[0],
        reset=lambda t, y, args: (y.q, -y.v),
        max_events=100,
    )
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(4),
        nhjax.initial_state(system, jnp.ones(1), jnp.zeros(1)),
        t1=100.0,
        stepsize_controller=nhjax.ReversibleController(
            eps=0.1, density=lambda t, q, v, args: 1 / (0.1 + jnp.abs(q[0]))
        ),
        event=bounce,
        max_steps=10000,
    )
    assert int(sol.stats["num_events"]) > 40
    energy = 0.5 * sol.ys.v[-1] @ sol.ys.v[-1] + potential(sol.ys.q[-1])
    np.testing.assert_allclose(energy, 1.3, rtol=1e-11)
