"""Simplified Newton with the Jacobian of all stage equations, on stiff machines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax import systems
from nhjax._step import first_step_state
from nhjax._step._jacobian import factorise_stage_jacobian, simplified_newton_update
from nhjax._step._step import equations_of_step, starting_values, StepArguments
from support.forms import in_space
from support.long import exhaustive, long


FULL = nhjax.SimplifiedNewton(jacobian="full", fallback=False)
LEADING = nhjax.SimplifiedNewton(jacobian="leading", fallback=False)


def slope_at_solution(system, y0, method, h):
    """Return the derivative of an iteration at the solution of a step.

    Automatic differentiation computes it, independently of the blocks of the Jacobian.
    """

    @jax.jit
    def slope(h):
        t = jnp.zeros(())
        start = first_step_state(system, method, t, y0, None)
        stages = equations_of_step(StepArguments(system, t, h, start, None), method)
        x0 = starting_values(stages, system.fibre_coordinate(y0), start.lin)
        x = nhjax.Newton().solve(stages, x0, start.lin, jnp.asarray(False)).x
        factors = factorise_stage_jacobian(stages, x, start.lin, "full")
        z, unravel = ravel_pytree(x)

        def update(z):
            x_next, _ = simplified_newton_update(stages, factors, unravel(z))
            return ravel_pytree(x_next)[0]

        return jax.jacfwd(update)(z)

    return np.asarray(slope(jnp.asarray(h)))


@pytest.mark.parametrize(
    ("example", "method"),
    [
        (systems.NonholonomicParticle(), nhjax.LobattoIIIAB(3)),
        (systems.RodSleigh(), nhjax.LobattoIIIAB(2, "consistent")),
        long(systems.Suslov(), nhjax.LobattoIIIAB(2, "propagated", chart="start")),
        exhaustive(systems.BallInBowl(), nhjax.LobattoIIIAB(2)),
        long(systems.HeavyTop(), nhjax.Gauss(2)),
    ],
    ids=lambda x: type(x).__name__,
)
def test_full_iteration_at_a_solution_has_no_slope(example, method):
    # Only Newton's method reaches this: all other iterations contract more slowly.
    slope = slope_at_solution(example.system, example.initial_state(), method, 0.05)
    np.testing.assert_allclose(slope, 0, atol=1e-12)


@pytest.mark.parametrize(
    "constraint", [long("none"), long("holonomic"), "nonholonomic"]
)
def test_full_iteration_of_hamiltonian_form_contracts_fast(constraint):
    # Each iteration evaluates the stage velocities once, at positions without their
    # last change, which decreases quadratically.
    start = in_space(constraint, True)
    given = start.forms["hamiltonian"], start.y0, nhjax.LobattoIIIAB(2)
    slope = slope_at_solution(*given, 0.05)
    assert np.abs(np.linalg.eigvals(slope)).max() < 5e-3


RADIUS, LENGTH, TRACK = 0.08, 0.3, 0.4


def balanced(mass=5.0, wheel=0.0015):
    """A robot on two wheels that keeps its balance: six coordinates, three constraints.

    The torque of the motors is a feedback of tilt, its rate and the speed, with gains
    `args`. The small inertia of the wheels makes the feedback stiff.
    """

    def tip(q):
        ahead = LENGTH * jnp.sin(q[3])
        x, y = q[0] + ahead * jnp.cos(q[2]), q[1] + ahead * jnp.sin(q[2])
        return jnp.stack([x, y, LENGTH * jnp.cos(q[3])])

    def lagrangian(t, q, v, args):
        _, tip_velocity = jax.jvp(tip, (q,), (v,))
        spin = jnp.stack([-v[2] * jnp.sin(q[3]), v[3], v[2] * jnp.cos(q[3])])
        moments = jnp.array([0.05, 0.04, 0.02], v.dtype)
        kinetic = 0.5 * mass * tip_velocity @ tip_velocity + 0.5 * spin @ (
            moments * spin
        )
        kinetic += 0.6 * (v[0] ** 2 + v[1] ** 2) + 0.04 * v[2] ** 2
        kinetic += 0.5 * wheel * (v[4] ** 2 + v[5] ** 2)
        return kinetic - 9.81 * mass * tip(q)[2]

    def constraint(t, q, v, args):
        along = v[0] * jnp.cos(q[2]) + v[1] * jnp.sin(q[2])
        across = v[1] * jnp.cos(q[2]) - v[0] * jnp.sin(q[2])
        turning = v[2] - RADIUS / TRACK * (v[5] - v[4])
        return jnp.stack([across, along - RADIUS / 2 * (v[4] + v[5]), turning])

    def motors(t, q, v, args):
        speed = RADIUS / 2 * (v[4] + v[5])
        torque = args[0] * q[3] + args[1] * v[3] + args[2] * speed
        zero = jnp.zeros_like(torque)
        steering = 0.1 * jnp.sin(t)
        return jnp.stack(
            [zero, zero, zero, -2 * torque, torque + steering, torque - steering]
        )

    return nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint, force=motors)


GAINS = np.array([60.0, 12.0, 4.0])


def standing(system, dtype=float):
    q = jnp.asarray([0, 0, 0.1, 0.05, 0, 0], dtype)
    v = jnp.asarray([0, 0, 0, 0, 0.5, 0.5], dtype)
    args = jnp.asarray(GAINS, dtype)
    return nhjax.initial_state(system, q, v, args=args, project=True)


def balance(gains, solver, dt=0.01, num_steps=20, stages=3, y0=None, **options):
    system = balanced()
    return nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(stages),
        standing(system) if y0 is None else y0,
        dt=dt,
        num_steps=num_steps,
        args=gains,
        stage_solver=solver,
        **options,
    )


def test_full_jacobian_with_stiff_feedback_solves_steps_that_leading_part_does_not():
    leading = balance(jnp.asarray(GAINS), LEADING, throw=False)
    assert leading.result != nhjax.RESULTS.successful
    sol = balance(jnp.asarray(GAINS), FULL)
    assert sol.stats["num_iterations"] <= 8 * 20
    newton = balance(jnp.asarray(GAINS), nhjax.Newton())
    for name in ("q", "v", "p", "multiplier"):
        one, other = (getattr(s.ys, name) for s in (sol, newton))
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-11, err_msg=name)
    # A five times larger step is solved too.
    sol = balance(jnp.asarray(GAINS), FULL, dt=0.05)
    assert sol.stats["num_iterations"] <= 12 * 20


def test_full_jacobian_keeps_derivatives():
    def loss(gains, solver):
        return jnp.sum(balance(gains, solver, num_steps=5).ys.q ** 2)

    gains = jnp.asarray(GAINS)
    one, other = (jax.grad(loss)(gains, solver) for solver in (FULL, nhjax.Newton()))
    np.testing.assert_allclose(one, other, rtol=1e-8)
    _, pushed = jax.jvp(lambda gains: loss(gains, FULL), (gains,), (jnp.ones(3),))
    np.testing.assert_allclose(pushed, jnp.sum(one), rtol=1e-10)


def test_full_jacobian_under_vmap_equals_single_runs():
    many = jnp.asarray(GAINS)[None] * jnp.linspace(0.8, 1.2, 5)[:, None]
    y0 = standing(balanced())

    def end(gains):
        return balance(gains, FULL, num_steps=5, y0=y0, throw=False).ys

    batch, one = jax.jit(jax.vmap(end))(many), jax.jit(end)
    for k, gains in enumerate(many):
        single = one(gains)
        for name in ("q", "v", "multiplier"):
            expected, found = getattr(single, name), getattr(batch, name)[k]
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


def test_full_jacobian_in_float32_solves_stiff_steps():
    system = balanced()
    y0 = standing(system, jnp.float32)
    assert y0.q.dtype == jnp.float32
    gains = jnp.asarray(GAINS, jnp.float32)
    sol = balance(gains, FULL, y0=y0)
    exact = balance(jnp.asarray(GAINS), FULL)
    np.testing.assert_allclose(sol.ys.q, exact.ys.q, atol=2e-5)


def fall(force, solver):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - q[0], force=lambda t, q, v, args: force(v)
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2))
    method = nhjax.LobattoIIIAB(3)
    options = {"dt": 0.1, "num_steps": 10, "stage_solver": solver}
    return nhjax.integrate(system, method, y0, **options).ys


def test_full_jacobian_of_force_without_finite_slope_solves_steps():
    # At rest the derivative of the norm is not finite.
    one = fall(lambda v: -jnp.linalg.norm(v) * v, FULL)
    other = fall(lambda v: -jnp.abs(v) * v, LEADING)
    np.testing.assert_allclose(one.v, other.v, rtol=0, atol=1e-13)


def test_full_jacobian_of_callback_raises():
    def drag(v):
        shape = jax.ShapeDtypeStruct(v.shape, v.dtype)
        return jax.pure_callback(lambda v: -0.1 * np.asarray(v), shape, v)

    with pytest.raises(ValueError, match="derivatives of forces in forward mode"):
        fall(drag, FULL)


def stiff_on_circle():
    """A Hamiltonian bead on a circle, with a stiff spring to a moving point."""

    def hamiltonian(t, q, p, args):
        mass = 1 + 0.3 * jnp.sin(q[1])
        to_spring = q - jnp.stack([2.0 + 0.1 * jnp.sin(3 * t), 0.2 + 0 * t])
        return 0.5 * p @ p / mass + 2e3 * to_spring @ to_spring

    return nhjax.HamiltonianSystem(
        hamiltonian, holonomic=lambda t, q, args: q @ q - 1
    ), (jnp.array([1.0, 0.0]), jnp.array([0.0, 0.1]))


def stiff_on_group():
    """A body with a stiff torsion spring, a damper, and a constraint on its spin."""
    moments = jnp.array([1.0, 1.4, 0.8])

    def lagrangian(t, q, v, args):
        rotation = nhjax.SO3().matrix(q)
        spring = 800.0 * rotation[2, 2] + 200.0 * rotation[0, 0]
        return 0.5 * v @ (moments * v) + spring

    return nhjax.LagrangianSystem(
        lagrangian,
        nonholonomic=lambda t, q, v, args: v[2] - 0.2 * v[0],
        force=lambda t, q, v, args: -jnp.array([60.0, 40.0, 50.0]) * v,
        manifold=nhjax.SO3(),
    ), (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.5, 0.2]))


@pytest.mark.parametrize(
    ("made", "closure", "dt"),
    [
        (stiff_on_circle, "symmetric", 0.01),
        (stiff_on_group, "symmetric", 0.04),
        long(stiff_on_group, "propagated", 0.04),
    ],
)
def test_full_jacobian_solves_the_same_steps_as_newtons_method(made, closure, dt):
    system, (q, v) = made()
    y0 = nhjax.initial_state(system, q, v, project=True)
    sols = [
        nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3, closure),
            y0,
            dt=dt,
            num_steps=10,
            stage_solver=solver,
            throw=False,
        )
        for solver in (FULL, nhjax.Newton(), LEADING)
    ]
    full, newton, leading = sols
    assert full.result == nhjax.RESULTS.successful
    if leading.result == nhjax.RESULTS.successful:
        saved = leading.stats["num_iterations"] / full.stats["num_iterations"]
        assert saved >= 1.25
    for name in ("q", "v", "multiplier"):
        one, other = (getattr(s.ys, name) for s in (full, newton))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9, err_msg=name)
