"""Geometric properties: constraints, symmetry in time, energy over long times."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from support import helpers
from support.helpers import CLOSURES, GALLERY, integrate_recorded, problem, recorded
from support.long import exhaustive_but, long


# Linear, affine, nonlinear and time-dependent constraints, and chaos.
QUICK = ["particle", "sleigh", "Appell", "chaotic", "driven"]
EACH_CLOSURE = ["particle", "sleigh"]
EVERYTHING = [*GALLERY, "driven"]
CONSTRAINED = [name for name in EVERYTHING if name != "oscillator"]


def on_their_own(names, closures):
    """Pairs (name, closure) of systems that run on their own.

    Systems of QUICK also run side by side with each closure, so on their own the
    symmetric closure is enough for all but two of them.
    """
    cases = [
        (name, closure)
        for name in names
        for closure in closures
        if closure == "symmetric" or name in EACH_CLOSURE or name not in QUICK
    ]
    short = [case for case in cases if case[0] in (*QUICK, "oscillator")]
    return pytest.mark.parametrize(("name", "closure"), exhaustive_but(short, cases))


every_closure = pytest.mark.parametrize("closure", CLOSURES)
every_number_of_stages = pytest.mark.parametrize("stages", [2, 3, long(4), long(5)])
symmetric_closures = pytest.mark.parametrize("closure", ["propagated", "symmetric"])


def node(states, k):
    # An index into a JAX array would compile a separate program.
    return jax.tree.map(lambda x: np.asarray(x)[k], states)


# Constraints


@partial(jax.jit, static_argnums=0)
def violations(name, ts, ys):
    """Φ_a and |Φ_a| / (Σ_j |D2Φ_aj| max |v|) at every node.

    The maximum of v is taken, since all its components come from one linear system:
    Σ |D2Φ_j v_j| itself is round-off where the sleigh passes θ = 0. Side by side, a
    constraint is compared with the velocities of its own system.
    """
    system, _, args = problem(name)

    def at_node(t, y):
        B = jax.jacfwd(system.constraint, argnums=2)(t, y.q, y.v, args)
        parts = helpers.parts_side_by_side(y.v) if name == "side by side" else [y.v]
        speeds = jnp.stack([jnp.max(jnp.abs(part)) for part in parts])
        size = jnp.sum(jnp.abs(B), axis=1) * speeds
        found = system.constraint_violation(t, y, args)
        return found, jnp.abs(found) / size

    return jax.vmap(at_node)(ts, ys)


def relative_violation(name, sol):
    return violations(name, sol.ts, sol.ys)[1]


@on_their_own(CONSTRAINED, CLOSURES)
def test_constraints_at_every_node_hold_to_round_off(name, closure):
    sol = recorded(name, 3, closure, "simplified")
    assert np.max(relative_violation(name, sol)) <= 1e-14


@every_closure
@every_number_of_stages
def test_constraints_with_any_number_of_stages_hold_to_round_off(stages, closure):
    sol = recorded("side by side", stages, closure, "simplified")
    assert np.max(relative_violation("side by side", sol)) <= 1e-14


@on_their_own(CONSTRAINED, CLOSURES)
def test_constraint_violation_in_stats_is_the_largest(name, closure):
    sol = recorded(name, 3, closure, "simplified")
    found = np.asarray(violations(name, sol.ts, sol.ys)[0])
    largest = np.max(np.abs(found[1:]))
    reported = sol.stats["max_constraint_violation"]
    np.testing.assert_allclose(reported, largest, rtol=0, atol=1e-15)
    assert reported <= 2e-15


# Symmetry in time


def there_and_back(name, stages, closure, steps):
    """The distance to the start after `steps` steps of h and as many of -h."""
    y0 = problem(name)[1]
    there = recorded(name, stages, closure, "simplified")
    back = integrate_recorded(
        name,
        stages,
        closure,
        "simplified",
        node(there.ys, steps),
        dt=-helpers.RECORDED_STEP,
        t0=float(there.ts[steps]),
        throw=False,  # Appell's system is singular some time before the start.
    )
    assert not 0 <= back.stats["failed_step"] < steps
    end = node(back.ys, steps)
    return {
        field: np.max(np.abs(getattr(end, field) - getattr(y0, field)), initial=0.0)
        for field in ("q", "v", "p", "multiplier")
    }


def assert_returns(name, stages, closure):
    for field, distance in there_and_back(name, stages, closure, 1).items():
        assert distance <= 1e-13, f"{field} after one step: {distance:.1e}"
    # The stage equations add h λ D2Φ to p, so λ has the round-off of p / h, and a
    # propagated λ accumulates it.
    momentum = np.max(np.abs(problem(name)[1].p))
    for field, distance in there_and_back(
        name, stages, closure, helpers.RECORDED_STEPS
    ).items():
        size = momentum / helpers.RECORDED_STEP if field == "multiplier" else 1.0
        assert distance <= 1e-13 * size, f"{field} after all steps: {distance:.1e}"


@on_their_own(EVERYTHING, ("propagated", "symmetric"))
def test_symmetric_step_of_minus_h_undoes_step_of_h(name, closure):
    assert_returns(name, 3, closure)


@symmetric_closures
@every_number_of_stages
def test_symmetric_step_with_any_number_of_stages_is_undone_by_minus_h(stages, closure):
    assert_returns("side by side", stages, closure)


# At s = 3 Appell's motion is integrated exactly, and the oscillator has no multiplier.
@pytest.mark.parametrize(
    "name",
    exhaustive_but(
        ["particle", "sleigh", "chaotic"],
        [name for name in CONSTRAINED if name not in ("Appell", "driven")],
    ),
)
def test_consistent_closure_of_a_step_is_not_symmetric(name):
    distance = there_and_back(name, 3, "consistent", helpers.RECORDED_STEPS)
    assert distance["q"] > 1e-10


# Long times


@cache
def sleigh_energy_error(closure):
    sleigh = nhjax.systems.ChaplyginSleigh()
    system, y0 = sleigh.system, sleigh.initial_state()
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(4, closure),
        y0,
        dt=0.1,
        num_steps=2000,
        saveat=nhjax.SaveAt(steps=True, fn=system.energy),
    )
    assert sol.stats["max_constraint_violation"] <= 2e-15
    return np.abs(np.asarray(sol.ys) - np.asarray(system.energy(0.0, y0)))


@pytest.mark.parametrize("closure", ["consistent", "symmetric"])
def test_energy_of_the_sleigh_over_a_long_run_stays_bounded(closure):
    assert np.max(sleigh_energy_error(closure)) <= 1e-10


def test_energy_of_the_sleigh_with_propagated_closure_drifts():
    # The motion is attracting; the propagated multiplier carries a mode that grows.
    error = sleigh_energy_error("propagated")
    assert np.max(error[:100]) <= 1e-9
    assert np.max(error) > 1e-3


def test_lobatto_with_two_stages_on_the_oscillator_is_periodic():
    # With h = 2 sin(π/N) the discrete orbit closes after exactly N steps.
    oscillator, count = nhjax.systems.HarmonicOscillator(), 4000
    y0 = oscillator.initial_state()
    sol = nhjax.integrate(
        oscillator.system,
        nhjax.LobattoIIIAB(2),
        y0,
        dt=2 * np.sin(np.pi / count),
        num_steps=count,
    )
    for field in ("q", "v", "p"):
        end, start = getattr(sol.ys, field)[0], getattr(y0, field)
        np.testing.assert_allclose(end, start, rtol=0, atol=1e-14, err_msg=field)


@cache
def long_run(name, closure, solver):
    system, y0, args = problem(name)
    return nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(4, closure),
        y0,
        dt=0.1,
        num_steps=200,
        args=args,
        stage_solver=helpers.SOLVERS[solver],
        saveat=nhjax.SaveAt(steps=True),
    )


@pytest.mark.parametrize(
    ("name", "closure"),
    [
        ("sleigh", "propagated"),
        ("sleigh", "symmetric"),
        ("chaotic", "consistent"),
    ],
)
def test_trajectories_of_both_stage_solvers_agree_to_round_off(name, closure):
    runs = [long_run(name, closure, solver).ys for solver in helpers.SOLVERS]
    fields = ["q", "v", "p"]
    # On the sleigh the propagated multiplier amplifies round-off: see above.
    fields += [] if closure == "propagated" else ["multiplier"]
    for field in fields:
        simplified, dense = (getattr(run, field) for run in runs)
        np.testing.assert_allclose(simplified, dense, rtol=0, atol=2e-14, err_msg=field)


# Energies of the continuously variable transmission over T = 2000 at h = 0.1, ε = 1/2.


def cvt_energies(t, y, example):
    energy = example.system.energy(t, y)
    return energy, example.driver_energy(y.q, y.v), example.passenger_energy(y.q, y.v)


@cache
def cvt_errors(regime, stages, closure):
    """E - E_0 for the whole, the driver and the passenger, at every step."""
    example = GALLERY[f"CVT {regime}"]
    sol = nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(stages, closure),
        example.initial_state(),
        dt=0.1,
        num_steps=20_000,
        args=example,
        saveat=nhjax.SaveAt(t0=True, steps=True, fn=cvt_energies),
    )
    return [np.asarray(energy)[1:] - np.asarray(energy)[0] for energy in sol.ys]


def largest_by_fifth(error):
    return np.max(np.abs(error.reshape(5, -1)), axis=1)


@pytest.mark.parametrize(
    ("regime", "stages", "closure", "expected"),
    [
        ("high", 3, "propagated", [1.6e-4, 3.2e-4, 5.0e-4, 6.5e-4, 8.6e-4]),
        ("low", 3, "propagated", [1.44e-5] * 5),
        ("high", 4, "propagated", [3.2e-7] * 5),
        ("high", 2, "propagated", [2.6e-2, 2.6e-2, 2.6e-2, 2.6e-2, 2.5e-2]),
    ],
)
def test_energy_error_of_the_cvt_in_each_fifth_equals_reference(
    regime, stages, closure, expected
):
    # Measured once with an independent implementation (dense Newton).
    error, _, _ = cvt_errors(regime, stages, closure)
    np.testing.assert_allclose(largest_by_fifth(error), expected, rtol=0.1)


@pytest.mark.parametrize(
    ("regime", "stages", "closure", "first", "last"),
    [
        ("high", 3, "consistent", 1.1e-3, 5.5e-3),
        ("high", 3, "symmetric", 2.9e-5, 3.7e-5),
        ("low", 3, "consistent", 1.4e-4, 7.4e-4),
        ("low", 3, "symmetric", 6.2e-6, 6.3e-6),
        ("high", 4, "consistent", 5.6e-6, 2.7e-5),
        ("high", 4, "symmetric", 2.2e-7, 1.6e-7),
    ],
)
def test_energy_error_of_the_cvt_at_both_ends_equals_reference(
    regime, stages, closure, first, last
):
    # Measured once with an independent implementation (dense Newton).
    error, _, _ = cvt_errors(regime, stages, closure)
    found = largest_by_fifth(error)[[0, -1]]
    np.testing.assert_allclose(found, [first, last], rtol=0.1)


def test_energy_of_the_cvt_with_three_propagated_stages_drifts_linearly():
    error, _, _ = cvt_errors("high", 3, "propagated")
    by_fifth = largest_by_fifth(error)
    np.testing.assert_allclose(by_fifth / by_fifth[0], [1, 2, 3, 4, 5], rtol=0.1)


@pytest.mark.parametrize("regime", ["low", "high"])
def test_energy_of_the_cvt_with_four_propagated_stages_does_not_drift(regime):
    error, _, _ = cvt_errors(regime, 4, "propagated")
    by_fifth = largest_by_fifth(error)
    np.testing.assert_allclose(by_fifth / by_fifth[0], 1, rtol=0.1)


@pytest.mark.parametrize(
    ("regime", "driver", "passenger"),
    [
        ("low", (-2.5e-3, 4.3e-3), (-1.26e-2, 1.3e-3)),
        ("high", (-5.3e-3, 1.26e-2), (-2.5e-2, 1.3e-3)),
    ],
)
def test_energy_ranges_of_driver_and_passenger_equal_reference(
    regime, driver, passenger
):
    _, driver_error, passenger_error = cvt_errors(regime, 2, "propagated")
    for error, expected in ((driver_error, driver), (passenger_error, passenger)):
        np.testing.assert_allclose([error.min(), error.max()], expected, rtol=0.1)
