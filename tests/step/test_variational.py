"""Steps conserve momentum maps, extremise the discrete action, and include RATTLE."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from support import paper_group_equations as paper
from support.forms import (
    free_forms,
    LOBATTO,
    Start,
    STEP,
)
from support.group_problems import (
    BODY,
    both_forms,
    FORMS,
    INERTIA,
    problem,
    QUATERNION,
    RETRACTIONS,
    solved_steps,
)
from support.long import long


def momenta_along(start, form, momentum, chart="middle"):
    """The momentum map at every tenth of 1000 steps."""
    sol = nhjax.integrate(
        start.forms[form],
        nhjax.LobattoIIIAB(3, chart=chart),
        start.y0,
        dt=STEP,
        num_steps=1000,
        saveat=nhjax.SaveAt(t0=True, steps=10),
    )
    assert np.max(np.ptp(sol.ys.p, axis=0)) > 0.1
    return np.asarray(jax.vmap(momentum)(sol.ys.q, sol.ys.p))


def assert_conserved(start, form, momentum, chart="middle"):
    values = momenta_along(start, form, momentum, chart)
    assert len(values) == 101
    assert np.min(np.max(np.abs(values), axis=0)) > 1e-3
    drift = np.max(np.abs(values - values[0]))
    assert drift <= 1e-14 * np.max(np.abs(values)), f"{drift:.1e}"


both_ways = pytest.mark.parametrize(
    ("form", "retraction", "chart"),
    [("lagrangian", "cayley", "middle"), ("hamiltonian", "exponential", "middle")],
)
crosswise = pytest.mark.parametrize(
    ("form", "retraction", "chart"),
    [("lagrangian", "exponential", "middle"), ("hamiltonian", "cayley", "start")],
)
OMEGA = np.array([0.7, -0.4, 1.3])


@both_ways
def test_steps_of_free_rigid_body_keep_spatial_angular_momentum(
    form, retraction, chart
):
    group = nhjax.SO3(RETRACTIONS[retraction])
    start = Start(free_forms(group, INERTIA), QUATERNION, OMEGA)
    assert_conserved(start, form, lambda q, p: group.matrix(q) @ p, chart)


@crosswise
def test_steps_of_heavy_top_keep_vertical_angular_momentum(form, retraction, chart):
    group = nhjax.SO3(RETRACTIONS[retraction])
    forms = free_forms(group, INERTIA, lambda q: 0.5 * group.matrix(q)[2, 2])
    start = Start(forms, QUATERNION, OMEGA)
    assert_conserved(start, form, lambda q, p: group.matrix(q)[2:] @ p, chart)
    horizontal = momenta_along(start, form, lambda q, p: group.matrix(q)[:2] @ p)
    assert np.max(np.ptp(horizontal, axis=0)) > 1e-2


@both_ways
def test_steps_of_free_planar_body_keep_momenta(form, retraction, chart):
    group = nhjax.SE2(RETRACTIONS[retraction])
    # The motion is so slow that θ and R(θ) are accurate enough until the end.
    q, v = np.array([0.3, -0.2, 0.4]), np.array([0.05, 0.02, 0.3])

    def momentum(q, p):
        return group.matrix(q)[:2, :2] @ p[:2]

    def angular_momentum(q, p):
        x, y = momentum(q, p)
        return p[2:] + q[0] * y - q[1] * x

    start = Start(free_forms(group, INERTIA), q, v)
    assert_conserved(start, form, momentum, chart)
    # Its round-off is the arm times the round-off of the linear momentum.
    about_origin = momenta_along(start, form, angular_momentum, chart)
    assert np.max(np.abs(about_origin - about_origin[0])) <= 1e-13


@crosswise
def test_steps_of_falling_body_keep_horizontal_momenta(form, retraction, chart):
    group = nhjax.SE3(RETRACTIONS[retraction])
    q = np.append(QUATERNION, [0.1, 0.2, 0.3])
    v = np.append([0.04, -0.03, 0.02], OMEGA)
    forms = free_forms(group, BODY, lambda q: 1e-3 * q[6])

    def momentum(q, p):
        return group.matrix(q)[:2, :3] @ p[:3]

    assert_conserved(Start(forms, q, v), form, momentum, chart)


@pytest.mark.parametrize("form", FORMS)
def test_steps_of_spherical_pendulum_keep_vertical_angular_momentum(form):
    pendulum = nhjax.systems.SphericalPendulum()
    q, v = np.asarray(pendulum.q0), np.asarray(pendulum.v0)
    weight = 1.3
    forms = both_forms(
        lambda t, q: jnp.eye(3),
        lambda t, q: weight * q[2],
        inverse=lambda M: jnp.eye(3),
        holonomic=lambda t, q, args: 0.5 * (q @ q - 1),
    )
    start = Start(forms, q, v, 1)
    assert_conserved(start, form, lambda q, p: jnp.cross(q, p)[2:])


# The variational principle


def discrete_action(mechanics, tableau, h, g, g_next, H, chart):
    """h Σ b_i ℓ(g_o τ(y^i), dτ_yi H^i); H^s follows from the ends of the chart.

    With the origin g_o = g at the start, τ(ξ) leads to g_next; in the middle, τ(ξ/2)
    leads from g to g_o and from g_o to g_next. This uses Cayley's map on rotations, and
    is analytic in all arguments.
    """
    a, b, group = tableau.a, tableau.b, mechanics.group
    turn, unit = np.linalg.solve(g, g_next), np.eye(len(g))
    xi, origin, start = group.vee(2 * np.linalg.solve(turn + unit, turn - unit)), g, 0
    if chart == "middle":
        # By tan(α/2) = tan α / (1 + 1/cos α) for α a quarter of the angle.
        half = xi / (1 + np.sqrt(1 + np.sum(xi * xi) / 4))
        xi, origin, start = 2 * half, g @ group.tau(half), -half
    H = np.concatenate([H, (xi / h - b[:-1] @ H)[None] / b[-1]])
    total = 0.0
    for weight, velocity, y in zip(b, H, start + h * (a @ H), strict=True):
        here, eta = origin @ group.tau(y), group.dtau(y) @ velocity
        kinetic = eta @ mechanics.inertia(here) @ eta / 2
        total = total + h * weight * (kinetic - np.sum(mechanics.C * here))
    return total


def slopes(function, directions):
    """The derivatives of ε -> function(ε direction) at 0, by complex steps."""
    return np.array([np.imag(function(1e-30j * x)) / 1e-30 for x in directions])


@pytest.mark.parametrize(
    ("stages", "form", "chart"),
    [
        (2, "lagrangian", "middle"),
        long(2, "hamiltonian", "start"),
        long(3, "lagrangian", "start"),
        (3, "hamiltonian", "middle"),
        (4, "hamiltonian", "start"),
        long(4, "lagrangian", "middle"),
    ],
)
def test_steps_on_groups_without_constraints_extremise_discrete_action(
    stages, form, chart
):
    top, tableau = problem("heavy top"), paper.lobatto(stages)
    method = nhjax.LobattoIIIAB(stages, chart=chart)
    solver = nhjax.SimplifiedNewton()
    assert top.mechanics.group is not None
    basis = top.mechanics.group.basis
    for taken in solved_steps(top.forms[form], method, solver, top.y0, STEP):
        g, g_next = top.element(taken.start.q), top.element(taken.end.q)
        H = taken.stages.velocity[:-1]

        def action(g=g, g_next=g_next, H=H):
            return discrete_action(top.mechanics, tableau, STEP, g, g_next, H, chart)

        # The oracle itself loses digits in H^s = (ξ / h - ...) / b_s.
        entries = np.eye(H.size).reshape(-1, *H.shape)
        stationary = slopes(lambda d, H=H, S=action: S(H=H + d), entries)
        np.testing.assert_allclose(stationary, 0.0, rtol=0, atol=1e-14)
        start = slopes(lambda d, g=g, S=action: S(g=g + g @ d), basis)
        np.testing.assert_allclose(-start, taken.start.p, rtol=0, atol=1e-13)
        end = slopes(lambda d, g=g_next, S=action: S(g_next=g + g @ d), basis)
        np.testing.assert_allclose(end, taken.end.p, rtol=0, atol=1e-13)


def rattle(q, p, h):
    """A step of RATTLE for a unit mass on the unit sphere in the potential z."""
    force = np.array([0.0, 0.0, -1.0])
    free = q + h * (p + 0.5 * h * force)
    # |free + c q| = 1, by the root nearer to zero.
    along, defect = free @ q, free @ free - 1.0
    c = -defect / (along + np.sqrt(along**2 - defect))
    end = free + c * q
    half = (end - q) / h
    p = half + 0.5 * h * force
    return end, p - (p @ end) * end


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_step_of_two_stages_with_holonomic_constraint_is_rattle(form):
    pendulum = nhjax.systems.SphericalPendulum()
    system = pendulum.system
    if form == "hamiltonian":
        system = nhjax.HamiltonianSystem(
            lambda t, q, p, args: 0.5 * p @ p + q[2], holonomic=pendulum.holonomic
        )
    y0 = nhjax.initial_state(system, pendulum.q0, pendulum.v0)
    sol = nhjax.integrate(
        system,
        LOBATTO[0],
        y0,
        dt=STEP,
        num_steps=20,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )
    q, p = np.asarray(y0.q), np.asarray(y0.p)
    for k in range(1, 21):
        q, p = rattle(q, p, STEP)
        np.testing.assert_allclose(sol.ys.q[k], q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(sol.ys.p[k], p, rtol=0, atol=2e-14)
