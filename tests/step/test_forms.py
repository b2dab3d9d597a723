"""The Lagrangian and the Hamiltonian form agree, and their steps are symplectic."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax._step import first_step_state
from nhjax._step._equations import (
    end_position,
    holonomic_constraint,
    node_residual,
    stage_forces,
    stage_velocities,
    StageEquations,
)
from nhjax._step._step import starting_values
from support.forms import (
    free_forms,
    GAUSS,
    in_rotation,
    in_space,
    LOBATTO,
    Start,
    STEP,
)
from support.group_problems import (
    FORMS,
    INERTIA,
    problem,
    QUATERNION,
    RETRACTIONS,
)
from support.long import long


@pytest.mark.parametrize(
    ("build", "constraint", "in_time", "stages"),
    [
        long(in_space, "none", False, 2),
        (in_space, "holonomic", False, 3),
        long(in_space, "nonholonomic", False, 4),
        long(in_space, "holonomic", True, 4),
        (in_space, "nonholonomic", True, 2),
        long(in_space, "nonholonomic", True, 3),
        long(in_rotation, "none", True, 4),
        long(in_rotation, "holonomic", False, 2),
        (in_rotation, "nonholonomic", True, 3),
    ],
)
def test_steps_of_lagrangian_and_hamiltonian_form_are_equal(
    build, constraint, in_time, stages
):
    start = build(constraint, in_time)
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
    # The run has a multiplier that is not zero, and the state changes.
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
    chart, none = stages.chart(x), jnp.zeros_like(stages.p)
    gained = stages.h * (stages.method.b @ stage_forces(stages, x).force)
    return end_position(stages, x), chart.advance_momentum(stages.p, gained, none)[0]


def one_step(system, method, y0):
    """(q', p', J), J the derivative of the step in left-trivialised coordinates.

    (ξ, δ) at (q, p) stands for (q τ(ξ), p + δ). By the implicit function theorem, J is
    the derivative of one Newton step at the root with a fixed inverse.
    """
    group, n = system.manifold_of(y0.q), y0.p.shape[0]

    @jax.jit
    def run(y0):
        t, h = jnp.zeros(()), jnp.asarray(STEP)
        lin = first_step_state(system, method, t, y0, None).lin
        stages = StageEquations(system, method, t, h, y0.q, y0.p, lin.multiplier, None)
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

    ω = -dθ with θ(ξ, δ) = p·ξ, since dθ(X, Y) = X θ(Y) - Y θ(X) - θ([X, Y]), and the
    bracket of left-invariant fields is the bracket of the algebra.
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
        long(LOBATTO[0], "lagrangian"),
        long(LOBATTO[0], "hamiltonian"),
        (LOBATTO[1], "lagrangian"),
        long(LOBATTO[2], "hamiltonian"),
        long(GAUSS, "lagrangian"),
        (GAUSS, "hamiltonian"),
    ],
    ids=str,
)
def test_steps_on_vector_space_are_symplectic(method, form):
    assert form_defect(in_space(), form, method) <= 1e-12


@pytest.mark.parametrize(
    ("method", "form", "retraction"),
    [
        (LOBATTO[0], "lagrangian", "cayley"),
        long(LOBATTO[1], "hamiltonian", "exponential"),
        (nhjax.LobattoIIIAB(3, chart="start"), "hamiltonian", "cayley"),
        long(LOBATTO[2], "lagrangian", "exponential"),
        long(GAUSS, "hamiltonian", "cayley"),
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
        long(LOBATTO[0], "lagrangian", "exponential"),
        (nhjax.LobattoIIIAB(3, chart="start"), "lagrangian", "cayley"),
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
