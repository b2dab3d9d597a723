"""The Lagrangian and the Hamiltonian form agree, and inherit the geometry of motion."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import paper_group_equations as paper
import pytest
from group_problems import (
    BODY,
    both_forms,
    E3,
    FORMS,
    INERTIA,
    inverse_of_three,
    problem,
    QUATERNION,
    RETRACTIONS,
    ROTATION,
    solved_steps,
    TORQUE,
    varying_inertia,
)
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax._step import first_step_state
from nhjax._step._stage_equations import (
    holonomic_constraint,
    node_residual,
    stage_forces,
    stage_velocities,
)
from nhjax._step._stage_system import StageSystem
from nhjax._step._starting_values import starting_values
from nhjax._system import State


STEP = 0.1
LOBATTO = [nhjax.LobattoIIIAB(stages) for stages in (2, 3, 4)]
GAUSS = nhjax.Gauss(2)


class Start(NamedTuple):
    """A system in both forms, and where it starts."""

    forms: dict[str, nhjax.LagrangianSystem | nhjax.HamiltonianSystem]
    q: np.ndarray
    v: np.ndarray
    num_constraints: int = 0

    @property
    def y0(self):
        """The state; its multiplier is zero, which the default closure ignores."""
        q, v = jnp.asarray(self.q), jnp.asarray(self.v)
        p = self.forms["lagrangian"].momentum(jnp.zeros(()), q, v, None)
        return State(q, v, p, jnp.zeros(self.num_constraints))


def growth(t, driven):
    """A factor of the kinetic energy."""
    return 1 + 0.3 * jnp.sin(t) if driven else 1.0


def drag(t, q, v, args):
    """A force that depends on everything."""
    return -0.2 * (1 + 0.5 * jnp.cos(t)) * v + 0.1 * q[:3]


def in_space(constraint="none", driven=False):
    """A particle in R^3 with position-dependent mass in a magnetic field."""
    q, v = np.array([0.6, 0.0, -0.8]), np.array([0.4, 0.5, 0.3])
    constraints = {
        "none": {},
        "holonomic": {"holonomic": lambda t, q, args: 0.5 * (q @ q - 1)},
        "nonholonomic": {
            "nonholonomic": lambda t, q, v, args: (
                v[2] - q[1] * v[0] - 0.3 * growth(t, driven)
            )
        },
    }[constraint]
    forms = both_forms(
        lambda t, q: growth(t, driven) * varying_inertia(q),
        lambda t, q: 0.5 * q @ q + 0.25 * q[0] ** 4,
        inverse=inverse_of_three,
        shift=lambda t, q: 0.4 * q[0] * jnp.asarray([0.0, 1.0, 0.0]),
        force=drag if driven else None,
        **constraints,
    )
    return Start(forms, q, v, len(constraints))


def in_rotation(constraint="none", driven=False, retraction="cayley"):
    """A rotating body whose kinetic energy depends on the attitude."""
    group = nhjax.SO3(RETRACTIONS[retraction])
    S = np.diag([0.3, 0.1, 0.5]) + 0.05
    level = float(ROTATION[2, 2])
    # A turn about the vertical and one about e3 keep the angle between the two.
    v = np.array([0.7, -0.4, 0.0])
    if constraint == "holonomic":
        v = 0.8 * ROTATION[2] - 0.5 * E3
    constraints = {
        "none": {},
        "holonomic": {"holonomic": lambda t, q, args: group.matrix(q)[2, 2] - level},
        "nonholonomic": {
            "nonholonomic": lambda t, q, v, args: (
                v[2] * (2 + q[1]) - (growth(t, driven) - 1)
            )
        },
    }[constraint]

    def inertia(t, q):
        R = group.matrix(q)
        return growth(t, driven) * (INERTIA + R.T @ S @ R)

    forms = both_forms(
        inertia,
        lambda t, q: jnp.sum(TORQUE * group.matrix(q)),
        inverse=inverse_of_three,
        force=drag if driven else None,
        manifold=group,
        **constraints,
    )
    return Start(forms, QUATERNION, v, len(constraints))


# Equivalence


@pytest.mark.parametrize(
    ("build", "constraint", "driven", "stages"),
    [
        (in_space, "none", False, 2),
        (in_space, "holonomic", False, 3),
        (in_space, "nonholonomic", False, 4),
        (in_space, "holonomic", True, 4),
        (in_space, "nonholonomic", True, 2),
        (in_space, "nonholonomic", True, 3),
        (in_rotation, "none", True, 4),
        (in_rotation, "holonomic", False, 2),
        (in_rotation, "nonholonomic", True, 3),
    ],
)
def test_both_forms_take_the_same_steps(build, constraint, driven, stages):
    start = build(constraint, driven)
    runs = [
        nhjax.integrate(
            start.forms[form],
            nhjax.LobattoIIIAB(stages),
            start.y0,
            dt=STEP,
            num_steps=20,
            saveat=nhjax.SaveAt(t0=True, steps=True),
        ).ys
        for form in FORMS
    ]
    for name in ("q", "v", "p", "multiplier"):
        one, other = (getattr(run, name) for run in runs)
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12, err_msg=name)
    # A multiplier is there, and something happens.
    assert np.all(np.ptp(runs[0].multiplier, axis=0) > 1e-3)
    assert np.ptp(runs[0].p, axis=0).max() > 1e-2


# Symplecticity


def residual_of(stages, x):
    """The stage equations of a system without nonholonomic constraints."""
    forces = stage_forces(stages, x)
    parts = [forces.residual, node_residual(stages, x, forces.force)]
    if stages.hamiltonian:
        parts.append(x.velocity - stage_velocities(stages, x))
    if stages.num_holonomic:
        parts.append(holonomic_constraint(stages, x))
    return ravel_pytree(parts)[0]


def end_of(stages, x):
    """(q_{k+1}, p_{k+1})."""
    xi, n = stages.increment(x), stage_forces(stages, x).force
    p = stages.chart.to_end(xi, stages.p + stages.h * (stages.method.b @ n))
    return stages.chart.manifold.act(stages.q, xi), p


def one_step(system, method, y0):
    """(q', p', J), J the derivative of the step in left-trivialised coordinates.

    (ξ, δ) at (q, p) stands for (q τ(ξ), p + δ). By the implicit function theorem: the
    derivative of one Newton step at the root, in which the inverse is held fixed.
    """
    group, n = system.manifold_of(y0.q), y0.p.shape[0]

    @jax.jit
    def run(y0):
        t, h = jnp.zeros(()), jnp.asarray(STEP)
        lin = first_step_state(system, method, t, y0, None).lin
        stages = StageSystem(system, method, t, h, y0.q, y0.p, lin.multiplier, None)
        x0 = starting_values(stages, system.fibre_coordinate(y0), lin)
        solver = nhjax.SimplifiedNewton()
        solved = solver.solve(stages, x0, lin, jnp.asarray(False)).x
        z, unravel = ravel_pytree(solved)
        slope = jax.jacfwd(lambda z: residual_of(stages, unravel(z)))(z)
        q_end, p_end = end_of(stages, solved)

        def moved(delta):
            start = group.act(y0.q, delta[:n]), y0.p + delta[n:]
            there = eqx.tree_at(lambda s: (s.q, s.p), stages, start)
            dz = jnp.linalg.solve(slope, residual_of(there, unravel(z)))
            q, p = end_of(there, unravel(z - dz))
            return jnp.concatenate([group.local(group.compose(back, q)), p])

        back = group.inverse(q_end)
        return q_end, p_end, jax.jacfwd(moved)(jnp.zeros(2 * n))

    return [np.asarray(x) for x in run(y0)]


def canonical_form(p, rotating):
    """Ω of ω((ξ, δ), (ξ', δ')) = δ'·ξ - δ·ξ' + p·[ξ, ξ'].

    ω = -dθ with θ(ξ, δ) = p·ξ, since dθ(X, Y) = X θ(Y) - Y θ(X) - θ([X, Y]), and of
    left-invariant fields the bracket is that of the algebra.
    """
    unit, zero = np.eye(3), np.zeros((3, 3))
    bracket = np.cross(unit[:, None], unit[None]) @ p if rotating else zero
    return np.block([[bracket, unit], [-unit, zero]])


def form_defect(start, form, method, tangent=None):
    """The largest entry of Jᵀ Ω' J - Ω, on the columns of `tangent`."""
    y0 = start.y0
    _, p, J = one_step(start.forms[form], method, y0)
    rotating = len(start.q) == 4
    before, after = canonical_form(y0.p, rotating), canonical_form(p, rotating)
    assert np.max(np.abs(J - np.eye(6))) > 1e-2
    T = np.eye(6) if tangent is None else tangent
    return np.max(np.abs(T.T @ (J.T @ after @ J - before) @ T))


@pytest.mark.parametrize(
    ("method", "form"),
    [
        (LOBATTO[0], "lagrangian"),
        (LOBATTO[0], "hamiltonian"),
        (LOBATTO[1], "lagrangian"),
        (LOBATTO[2], "hamiltonian"),
        (GAUSS, "lagrangian"),
        (GAUSS, "hamiltonian"),
    ],
    ids=str,
)
def test_steps_in_space_are_symplectic(method, form):
    assert form_defect(in_space(), form, method) <= 1e-12


@pytest.mark.parametrize(
    ("method", "form", "retraction"),
    [
        (LOBATTO[0], "lagrangian", "cayley"),
        (LOBATTO[1], "hamiltonian", "exponential"),
        (LOBATTO[2], "lagrangian", "exponential"),
        (GAUSS, "hamiltonian", "cayley"),
    ],
    ids=str,
)
def test_steps_on_rotations_are_symplectic(method, form, retraction):
    assert form_defect(in_rotation(retraction=retraction), form, method) <= 1e-12


@pytest.mark.parametrize(("stages", "form"), [(2, "hamiltonian"), (3, "lagrangian")])
def test_steps_with_holonomic_constraints_are_symplectic(stages, form):
    sphere = problem("sphere")
    start = Start(sphere.forms, np.asarray(sphere.y0.q), np.asarray(sphere.y0.v), 1)
    q, p = np.asarray(sphere.y0.q), np.asarray(sphere.y0.p)
    # Tangent vectors of q·q = 1, q·p = 0; elsewhere the step is not symplectic.
    rows = np.stack([np.append(q, np.zeros(3)), np.append(p, q)])
    tangent = np.linalg.svd(rows)[2][2:].T
    method = nhjax.LobattoIIIAB(stages)
    assert form_defect(start, form, method, tangent) <= 1e-12
    assert form_defect(start, form, method) > 1e-3


@pytest.mark.parametrize(
    ("method", "form", "retraction"),
    [
        (LOBATTO[0], "lagrangian", "exponential"),
        (LOBATTO[1], "lagrangian", "cayley"),
        (LOBATTO[2], "hamiltonian", "cayley"),
    ],
    ids=str,
)
def test_reduced_steps_of_a_free_body_are_poisson_maps(method, form, retraction):
    group = nhjax.SO3(RETRACTIONS[retraction])
    free = Start(free_forms(group, INERTIA), QUATERNION, np.array([0.7, -0.4, 1.3]))
    _, p, J = one_step(free.forms[form], method, free.y0)
    np.testing.assert_allclose(J[3:, :3], 0.0, rtol=0, atol=1e-13)
    reduced = J[3:, 3:]
    before, after = (np.cross(np.eye(3), np.asarray(mu)) for mu in (free.y0.p, p))
    found = reduced @ before @ reduced.T
    np.testing.assert_allclose(found, after, rtol=0, atol=1e-12)
    assert np.max(np.abs(before - after)) > 1e-2


# Momentum maps


def free_forms(group, inertia, potential=None):
    """½ v·M v - U with a constant M."""
    inverse = np.linalg.inv(inertia)
    return both_forms(
        lambda t, q: jnp.asarray(inertia),
        lambda t, q: jnp.zeros(()) if potential is None else potential(q),
        inverse=lambda M: inverse,
        manifold=group,
    )


def momenta_along(start, form, momentum):
    """The momentum map at every tenth of 1000 steps."""
    sol = nhjax.integrate(
        start.forms[form],
        nhjax.LobattoIIIAB(3),
        start.y0,
        dt=STEP,
        num_steps=1000,
        saveat=nhjax.SaveAt(t0=True, steps=10),
    )
    assert np.max(np.ptp(sol.ys.p, axis=0)) > 0.1
    return np.asarray(jax.vmap(momentum)(sol.ys.q, sol.ys.p))


def assert_conserved(start, form, momentum):
    values = momenta_along(start, form, momentum)
    assert len(values) == 101
    assert np.min(np.max(np.abs(values), axis=0)) > 1e-3
    drift = np.max(np.abs(values - values[0]))
    assert drift <= 1e-14 * np.max(np.abs(values)), f"{drift:.1e}"


both_ways = pytest.mark.parametrize(
    ("form", "retraction"), [("lagrangian", "cayley"), ("hamiltonian", "exponential")]
)
crosswise = pytest.mark.parametrize(
    ("form", "retraction"), [("lagrangian", "exponential"), ("hamiltonian", "cayley")]
)
OMEGA = np.array([0.7, -0.4, 1.3])


@both_ways
def test_a_free_rigid_body_keeps_its_spatial_angular_momentum(form, retraction):
    group = nhjax.SO3(RETRACTIONS[retraction])
    start = Start(free_forms(group, INERTIA), QUATERNION, OMEGA)
    assert_conserved(start, form, lambda q, p: group.matrix(q) @ p)


@crosswise
def test_a_heavy_top_keeps_its_vertical_angular_momentum(form, retraction):
    group = nhjax.SO3(RETRACTIONS[retraction])
    forms = free_forms(group, INERTIA, lambda q: 0.5 * group.matrix(q)[2, 2])
    start = Start(forms, QUATERNION, OMEGA)
    assert_conserved(start, form, lambda q, p: group.matrix(q)[2:] @ p)
    horizontal = momenta_along(start, form, lambda q, p: group.matrix(q)[:2] @ p)
    assert np.max(np.ptp(horizontal, axis=0)) > 1e-2


@both_ways
def test_a_free_body_in_the_plane_keeps_its_momenta(form, retraction):
    group = nhjax.SE2(RETRACTIONS[retraction])
    # So slow that the angle θ, and with it R(θ), has enough digits to the end.
    q, v = np.array([0.3, -0.2, 0.4]), np.array([0.05, 0.02, 0.3])

    def momentum(q, p):
        return group.matrix(q)[:2, :2] @ p[:2]

    def angular_momentum(q, p):
        x, y = momentum(q, p)
        return p[2:] + q[0] * y - q[1] * x

    start = Start(free_forms(group, INERTIA), q, v)
    assert_conserved(start, form, momentum)
    # Known to the arm times the round-off of the linear one.
    about_origin = momenta_along(start, form, angular_momentum)
    assert np.max(np.abs(about_origin - about_origin[0])) <= 1e-13


@crosswise
def test_a_falling_body_keeps_its_horizontal_momenta(form, retraction):
    group = nhjax.SE3(RETRACTIONS[retraction])
    q = np.append(QUATERNION, [0.1, 0.2, 0.3])
    v = np.append([0.04, -0.03, 0.02], OMEGA)
    forms = free_forms(group, BODY, lambda q: 1e-3 * q[6])

    def momentum(q, p):
        return group.matrix(q)[:2, :3] @ p[:3]

    assert_conserved(Start(forms, q, v), form, momentum)


@pytest.mark.parametrize("form", FORMS)
def test_a_spherical_pendulum_keeps_its_vertical_angular_momentum(form):
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


def discrete_action(mechanics, tableau, h, g, g_next, H):
    """h Σ b_i ℓ(g τ(Ξ^i), dτ_Ξi H^i); H^s follows from g τ(h Σ b_j H^j) = g_next.

    For Cayley's map, and analytic in all arguments.
    """
    a, b, group = tableau.a, tableau.b, mechanics.group
    turn, unit = np.linalg.solve(g, g_next), np.eye(len(g))
    xi = group.vee(2 * np.linalg.solve(turn + unit, turn - unit))
    H = np.concatenate([H, (xi / h - b[:-1] @ H)[None] / b[-1]])
    total = 0.0
    for weight, velocity, increment in zip(b, H, h * (a @ H), strict=True):
        here, eta = g @ group.tau(increment), group.dtau(increment) @ velocity
        kinetic = eta @ mechanics.inertia(here) @ eta / 2
        total = total + h * weight * (kinetic - np.sum(mechanics.C * here))
    return total


def slopes(function, directions):
    """The derivatives of ε -> function(ε direction) at 0, by complex steps."""
    return np.array([np.imag(function(1e-30j * x)) / 1e-30 for x in directions])


@pytest.mark.parametrize(
    ("stages", "form"),
    [(2, "lagrangian"), (2, "hamiltonian"), (3, "lagrangian"), (4, "hamiltonian")],
)
def test_unconstrained_steps_on_groups_extremise_the_discrete_action(stages, form):
    top, tableau = problem("heavy top"), paper.lobatto(stages)
    method, solver = nhjax.LobattoIIIAB(stages), nhjax.SimplifiedNewton()
    assert top.mechanics.group is not None
    basis = top.mechanics.group.basis
    for taken in solved_steps(top.forms[form], method, solver, top.y0, STEP):
        g, g_next = top.element(taken.start.q), top.element(taken.end.q)
        H = taken.stages.velocity[:-1]

        def action(g=g, g_next=g_next, H=H):
            return discrete_action(top.mechanics, tableau, STEP, g, g_next, H)

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
def test_two_stages_with_a_holonomic_constraint_are_rattle(form):
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
