"""A step is accepted only if its equations are solved."""

import warnings
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from benchmarks import near_rest
from benchmarks._random_systems import random_systems
from benchmarks.acceptance import (
    ALLOWED,
    gallery,
    JUDGEMENTS,
    measure,
    measure_starts,
    SAME,
)
from nhjax import RESULTS
from support.long import long
from support.particle_run import assert_trees_equal


ROUND_OFF = 1e-13
WITH_NEWTON = nhjax.SimplifiedNewton(fallback=True)


@cache
def double_pendulum():
    """Two rods from rest, in Cartesian coordinates."""

    def rods(t, q, args):
        second = q[2:] - q[:2]
        return jnp.stack([q[:2] @ q[:2] - 1, second @ second - 1])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - 9.81 * (q[1] + q[3]), holonomic=rods
    )
    # The first use may be inside a traced run.
    with jax.ensure_compile_time_eval():
        start = jnp.array([0.6, -0.8, 1.2, -1.6])
        return system, nhjax.initial_state(system, start, jnp.zeros(4))


def swing(num_steps=9, **options):
    system, y0 = double_pendulum()
    options = {"dt": 0.5, "throw": False} | options
    return nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, num_steps=num_steps, **options
    )


def test_slow_iteration_of_stages_is_not_accepted():
    sol = jax.jit(swing)()
    assert sol.result == RESULTS.nonlinear_max_iterations
    assert float(sol.stats["max_constraint_violation"]) < ROUND_OFF
    assert float(sol.stats["max_residual"]) < ROUND_OFF
    with pytest.raises(nhjax.IntegrationError, match=r"step 2: .*`max_iterations`"):
        swing(stage_solver=nhjax.SimplifiedNewton(fallback=False), throw=True)


@pytest.mark.filterwarnings("ignore:The steps of this run took")
def test_slow_iteration_of_stages_that_contracts_solves_its_step():
    newton = swing(num_steps=2, stage_solver=nhjax.Newton())
    for limit, result in ((100, RESULTS.nonlinear_max_iterations), (1000, None)):
        solver = nhjax.SimplifiedNewton(max_iterations=limit, fallback=False)
        sol = swing(num_steps=2, stage_solver=solver)
        assert sol.result == (RESULTS.successful if result is None else result)
    assert int(sol.stats["num_iterations"]) > 150
    assert float(sol.stats["max_residual"]) < ROUND_OFF
    assert float(sol.stats["max_constraint_violation"]) < ROUND_OFF
    np.testing.assert_allclose(sol.ys.q, newton.ys.q, rtol=1e-12)
    np.testing.assert_allclose(sol.ys.p, newton.ys.p, rtol=1e-12, atol=1e-12)


def test_slow_steps_of_stiff_skate_have_the_accuracy_of_fast_steps():
    # A blade near rest, with a stiff spring between its heading and its position. The
    # increments of its stages rise and fall while they contract.
    def lagrangian(t, q, v, stiffness):
        kinetic = 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.1 * v[2] ** 2)
        spring = stiffness * (1 - jnp.cos(q[2] - 0.3 * q[0]))
        return kinetic - 0.05 * spring - 0.5 * q[0] ** 2

    def blade(t, q, v, args):
        return (v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))[None]

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=blade)

    def step(stiffness, solver):
        start = jnp.array([0.2, 0.1, 0.4]), jnp.array([1e-8, 0.0, 1e-7])
        y0 = nhjax.initial_state(system, *start, args=stiffness, project=True)
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=0.1,
            num_steps=1,
            args=stiffness,
            stage_solver=solver,
            throw=False,
        )

    stiffness = jnp.linspace(1850.0, 2030.0, 30)
    simplified, newton = (
        jax.jit(jax.vmap(lambda a, solver=solver: step(a, solver)))(stiffness)
        for solver in (nhjax.SimplifiedNewton(fallback=False), nhjax.Newton())
    )
    assert simplified.failures() == newton.failures() == []
    assert np.all(np.asarray(simplified.stats["num_iterations"]) > 100)
    assert float(jnp.max(simplified.stats["max_residual"])) < 2 * ROUND_OFF
    np.testing.assert_allclose(simplified.ys.q, newton.ys.q, rtol=1e-13, atol=1e-13)


def test_diverging_iteration_of_stages_returns_divergence_result():
    sol = swing(dt=3.0, stage_solver=nhjax.SimplifiedNewton(fallback=False))
    assert sol.result == RESULTS.nonlinear_divergence
    assert int(sol.stats["num_iterations"]) < 100


@pytest.mark.parametrize("compiled", [False, True], ids=["plain", "jit"])
def test_fallback_in_steps_that_need_newton_solves_them(compiled):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if compiled:
            sol = jax.jit(lambda: swing(stage_solver=WITH_NEWTON))()
        else:
            sol = swing()
        expected = swing(stage_solver=nhjax.Newton())
    told = [str(warning.message) for warning in caught]
    taken_over = any("did not solve step 2 of this run" in text for text in told)
    assert taken_over is not compiled
    assert sol.result == expected.result == RESULTS.successful
    assert 0 < int(sol.stats["num_newton_steps"]) < 9
    assert int(expected.stats["num_newton_steps"]) == 0
    assert float(sol.stats["max_constraint_violation"]) < ROUND_OFF
    for name in ("q", "p"):
        np.testing.assert_allclose(
            getattr(sol.ys, name), getattr(expected.ys, name), rtol=1e-9
        )


def stiff_spring(force=None, stage_solver=None):
    """A few steps that are far too long for the leading part of the Jacobian."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - 0.5 * 1e4 * q @ q, force=force
    )
    y0 = nhjax.initial_state(system, jnp.array([1.0, 0.5]), jnp.zeros(2))
    options = {} if stage_solver is None else {"stage_solver": stage_solver}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sol = nhjax.integrate(
            system, nhjax.LobattoIIIAB(3), y0, dt=0.05, num_steps=4, **options
        )
    return sol, [str(x.message) for x in caught if "did not solve" in str(x.message)]


def test_plain_call_with_unsolved_step_is_repeated_with_the_full_jacobian():
    sol, told = stiff_spring()
    assert len(told) == 1
    assert "did not solve step 0 of this run" in told[0]
    assert '`stage_solver=nhjax.SimplifiedNewton(jacobian="full")`' in told[0]
    assert int(sol.stats["num_newton_steps"]) == 0
    full, none = stiff_spring(stage_solver=nhjax.SimplifiedNewton(jacobian="full"))
    assert none == []
    assert_trees_equal(sol.ys, full.ys)


@jax.custom_vjp
def drag_without_forward_derivative(v):
    return -v


drag_without_forward_derivative.defvjp(
    lambda v: (-v, None), lambda _, change: (-change,)
)


def oscillate(force=None, **options):
    """Run an oscillator with four stages; return the messages of the warnings too."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - 0.5 * q @ q, force=force
    )
    y0 = nhjax.initial_state(system, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sol = nhjax.integrate(system, nhjax.LobattoIIIAB(4), y0, **options)
    return sol, [str(x.message) for x in caught]


@pytest.mark.parametrize(
    ("jacobian", "force", "is_told"),
    [
        (None, None, True),
        ("full", None, False),
        (None, lambda t, q, v, args: drag_without_forward_derivative(0.01 * v), False),
    ],
)
def test_plain_call_with_many_iterations_a_step_names_the_full_jacobian(
    jacobian, force, is_told
):
    solver = nhjax.SimplifiedNewton(jacobian=jacobian)
    sol, told = oscillate(force, dt=4.3, num_steps=10, stage_solver=solver)
    assert (int(sol.stats["num_iterations"]) > 400) == (jacobian is None)
    told = [x for x in told if "iterations on average" in x]
    assert len(told) == is_told
    assert all(
        '`stage_solver=nhjax.SimplifiedNewton(jacobian="full")`' in x for x in told
    )


@pytest.mark.parametrize("jacobian", [None, "full"])
def test_plain_call_with_a_tolerance_and_unsolved_steps_names_the_full_jacobian(
    jacobian,
):
    sol, told = oscillate(
        t1=100.0,
        max_steps=200,
        stepsize_controller=nhjax.PIDController(rtol=1e3, atol=1e3),
        stage_solver=nhjax.SimplifiedNewton(jacobian=jacobian),
    )
    rejected, unsolved = (
        int(sol.stats[f"num_{name}_steps"]) for name in ("rejected", "unsolved")
    )
    told = [x for x in told if "were not solved, and" in x]
    assert 0 <= unsolved <= rejected
    if jacobian == "full":
        assert unsolved == len(told) == 0
    else:
        tried = rejected + int(sol.stats["num_steps"])
        assert unsolved > 0.2 * tried
        assert told[0].startswith(f"In {unsolved} of the {tried} attempts")
        assert 'SimplifiedNewton(jacobian="full")`' in told[0]


def test_plain_call_that_does_not_reach_its_end_names_unsolved_steps_too():
    """More steps do not help such a run, so the advice comes with the error."""
    system = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - 0.5 * q @ q)
    y0 = nhjax.initial_state(system, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    with (
        pytest.warns(UserWarning, match=r'SimplifiedNewton\(jacobian="full"\)'),
        pytest.raises(nhjax.IntegrationError, match="num_unsolved_steps"),
    ):
        nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(4),
            y0,
            t1=1e5,
            max_steps=100,
            stepsize_controller=nhjax.PIDController(rtol=1e3, atol=1e3),
        )


def test_plain_call_without_slopes_of_forces_fails_without_advice_of_newton():
    with pytest.raises(nhjax.IntegrationError, match="smaller `dt`") as failure:
        stiff_spring(lambda t, q, v, args: drag_without_forward_derivative(v))
    assert "jacobian" not in str(failure.value)


def test_plain_call_with_a_jacobian_of_the_users_is_repeated_with_newton():
    solver = nhjax.SimplifiedNewton(jacobian="leading")
    sol, told = stiff_spring(stage_solver=solver)
    assert len(told) == 1
    assert "Newton's method for such steps" in told[0]
    assert int(sol.stats["num_newton_steps"]) == 4


def test_message_of_unsolved_step_under_jit_names_the_fallback():
    with pytest.raises((RuntimeError, ValueError)) as failure:
        jax.block_until_ready(jax.jit(lambda: swing(throw=True))())
    assert "`stage_solver=nhjax.SimplifiedNewton(fallback=True)`" in str(failure.value)
    sol = jax.jit(lambda: swing(throw=True, stage_solver=WITH_NEWTON))()
    assert sol.result == RESULTS.successful


@pytest.mark.parametrize("solver", [nhjax.SimplifiedNewton(), nhjax.Newton()])
def test_message_of_step_unsolved_by_newton_does_not_recommend_newton(solver):
    # With friction that jumps, the step in which the body stops has no solution.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, force=lambda t, q, v, args: -jnp.sign(v)
    )
    y0 = nhjax.initial_state(system, jnp.zeros(1), jnp.ones(1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(nhjax.IntegrationError) as failure:
            nhjax.integrate(
                system,
                nhjax.LobattoIIIAB(3),
                y0,
                dt=0.03,
                num_steps=100,
                stage_solver=solver,
            )
    message = str(failure.value)
    assert "Newton" not in message
    assert "Forces that jump" in message
    assert "`jnp.tanh(v / 0.01)`" in message
    assert "if all forces are smooth, try 0.015" in message


def test_friction_smoothed_as_the_message_advises_stops_the_body():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        force=lambda t, q, v, args: -jnp.tanh(v / 0.01),
    )
    y0 = nhjax.initial_state(system, jnp.zeros(1), jnp.ones(1))
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(3),
        y0,
        dt=0.03,
        num_steps=100,
        stage_solver=WITH_NEWTON,
    )
    # It stops after one second, half a unit away.
    np.testing.assert_allclose(sol.ys.q[0], 0.5, atol=1e-2)
    assert abs(float(sol.ys.v[0, 0])) < 1e-10


def test_num_newton_steps_of_run_without_fallback_is_zero():
    assert int(swing(dt=0.1).stats["num_newton_steps"]) == 0


def test_fallback_in_a_batch_counts_newton_steps_of_each_member():
    sizes = jnp.array([0.1, 0.5])
    sol = jax.vmap(lambda dt: swing(dt=dt, stage_solver=WITH_NEWTON))(sizes)
    assert [int(x) for x in sol.stats["num_steps"]] == [9, 9]
    easy, hard = sol.stats["num_newton_steps"]
    assert int(easy) == 0
    assert int(hard) > 0


def test_gradient_through_fallback_steps_is_exact():
    system, y0 = double_pendulum()

    def height(dt, solver):
        end = nhjax.integrate(
            system, nhjax.LobattoIIIAB(3), y0, dt=dt, num_steps=4, stage_solver=solver
        )
        return end.ys.q[-1, 3]

    slopes = [jax.grad(height)(0.5, solver) for solver in (WITH_NEWTON, nhjax.Newton())]
    np.testing.assert_allclose(slopes[0], slopes[1], rtol=1e-8)


def test_newton_with_round_off_magnified_by_stiff_forces_accepts_steps():
    # Vibrations of 1e-5 about the position 1, by a spring of stiffness 1e10.
    def lagrangian(t, q, v, args):
        return 0.5 * v @ v - 0.5e10 * jnp.sum((q - 1.0) ** 2)

    system = nhjax.LagrangianSystem(lagrangian)
    y0 = nhjax.initial_state(system, jnp.array([1.00001, 0.99999]), jnp.zeros(2))
    for solver in (nhjax.SimplifiedNewton(), nhjax.Newton()):
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=5e-6,
            num_steps=200,
            stage_solver=solver,
        )
        phase = 1e5 * 5e-6 * 200
        np.testing.assert_allclose(sol.ys.q[0, 0] - 1, 1e-5 * np.cos(phase), atol=1e-6)


def test_fallback_that_is_not_a_bool_raises():
    with pytest.raises(TypeError, match="`fallback` must be True or False"):
        nhjax.SimplifiedNewton(fallback="no")  # pyright: ignore[reportArgumentType]


SYSTEMS = gallery() | random_systems()
# Both kinds of constraints, alone and together, and a group.
SEARCHED = [
    ("DoublePendulum", 3),
    long("random 6, m = k = 1", 2),
]


@pytest.mark.parametrize(("name", "stages"), SEARCHED)
def test_accepted_steps_of_growing_size_are_solved(name, stages):
    figures = measure(name, stages, SYSTEMS[name], num_steps=20)
    for solver in ("simplified", "newton"):
        assert figures[f"{solver} accepted"] > 100
        assert figures[f"{solver} residual"] <= ALLOWED
        assert figures[f"{solver} violation"] <= ALLOWED
    # The search continues until steps fail.
    assert figures["simplified accepted"] < 200
    assert figures["distance"] <= SAME
    assert "doubtful" not in figures


@pytest.mark.parametrize("name", ["Morse", long("body, exponential")])
def test_accepted_steps_from_random_starts_are_solved(name):
    figures = measure_starts(name, 3, number=1500)
    for solver in ("simplified", "newton"):
        assert figures[f"{solver} accepted"] > 300
        assert figures[f"{solver} accepted"] < 1500
        assert figures[f"{solver} residual"] <= ALLOWED
    assert figures.get("doubtful", {"wrong": 0})["wrong"] == 0


def test_doubtful_step_with_two_solutions_is_judged():
    # For one of 3000 steps, the two solvers find solutions that are far apart.
    doubtful = measure_starts("Morse", 3, number=3000)["doubtful"]
    assert doubtful["two solutions"] == 1
    assert sum(doubtful[judgement] for judgement in JUDGEMENTS) == 1


@pytest.mark.parametrize(
    ("name", "stages"),
    [
        ("KnifeEdge", 2),
        long("SliderCrank", 3),
    ],
)
def test_accepted_steps_near_rest_are_all_solved(name, stages):
    rows = list(near_rest.near_rest(name, stages, near_rest.examples()[name], 1))
    assert sum(row["accepted"] for row in rows) > 100
    assert sum(row["accepted judged"] for row in rows) > 0
    for row in rows:
        assert row["wrongly accepted"] == row["wrongly refused"] == 0, row
