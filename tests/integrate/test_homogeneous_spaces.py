"""Motions on the sphere, which is SO(3) up to turns about the third body axis."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from support.orders import assert_order, DURATION, rms, SCIPY_FLOOR, trajectories


GRAVITY = 9.81
GROUP = nhjax.SO3(nhjax.Cayley())
ATTITUDE = nhjax.SO3(nhjax.Exponential()).retract(jnp.array([0.9, -0.4, 0.3]))
COUNTS = {2: (64, 128, 256), 3: (32, 64, 128), 4: (16, 24, 32, 48)}
FINE = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}


def upward(q):
    """The height of the third body axis, the last entry of the rotation's matrix."""
    return GROUP.matrix(q)[2, 2]


def axes(q):
    return np.asarray(jax.vmap(GROUP.matrix)(jnp.asarray(q)))


def pendulum(turning_inertia):
    """A pendulum of unit mass and length on the horizontal lift of its sphere.

    Its point is the third body axis. Turns about this axis do not move it: they are
    forbidden, with arbitrary inertia.
    """
    return nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * (v[0] ** 2 + v[1] ** 2 + turning_inertia * v[2] ** 2)
            - GRAVITY * upward(q)
        ),
        nonholonomic=lambda t, q, v, args: v[2],
        manifold=GROUP,
    )


def run(system, v, stages):
    y0 = nhjax.initial_state(system, ATTITUDE, v)
    method = nhjax.LobattoIIIAB(stages)
    return trajectories(system, method, y0, COUNTS[stages])


def point_of_pendulum(ts, v):
    """The point's position and velocity from ẍ = -g e_z + λ x, with |x| = 1."""
    start = axes(ATTITUDE[None])[0]

    def rate(_, z):
        x, dx = z[:3], z[3:]
        pull = GRAVITY * x[2] - dx @ dx
        return np.concatenate([dx, [0.0, 0.0, -GRAVITY] + pull * x])

    z0 = np.concatenate([start[:, 2], start @ np.cross(v, [0.0, 0.0, 1.0])])
    return solve_ivp(rate, (0.0, DURATION), z0, t_eval=ts, **FINE).y.T


@pytest.mark.parametrize("stages", COUNTS)
def test_group_pendulum_on_a_sphere_equals_its_horizontal_lift(stages):
    v = jnp.array([1.3, -0.7, 0.0])
    errors = ([], [])
    for ts, y, _ in run(pendulum(0.4), v, stages):
        rotations = axes(y.q)
        velocities = np.cross(y.v, [0.0, 0.0, 1.0])
        found = [rotations[:, :, 2], np.einsum("kij,kj->ki", rotations, velocities)]
        expected = point_of_pendulum(ts, np.asarray(v))
        errors[0].append(len(ts))
        errors[1].append(rms(np.concatenate(found, axis=1) - expected))
        assert np.max(np.abs(y.v[:, 2])) < 1e-13
    assert_order(2 * stages - 2, *errors, floor=SCIPY_FLOOR)


def test_group_inertia_of_forbidden_rotations_changes_only_errors():
    # The constraint holds at the nodes; at the stages the lifts turn a little.
    v = jnp.array([1.3, -0.7, 0.0])
    light, heavy = (run(pendulum(inertia), v, 3) for inertia in (0.1, 3.0))
    differences = ([], [])
    for (ts, of_light, _), (_, of_heavy, _) in zip(light, heavy, strict=True):
        differences[0].append(len(ts))
        differences[1].append(
            rms(axes(of_light.q)[:, :, 2] - axes(of_heavy.q)[:, :, 2])
        )
    assert_order(4, *differences)


@pytest.mark.parametrize("moments", [(1.0, 1.0), (1.0, 1.5)])
def test_group_path_depends_on_attitude_only_with_unequal_moments(moments):
    # Attitudes that differ by a turn about the third body axis are one point of the
    # sphere. The metric on it is invariant under such turns if the moments are equal.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * (args[0] * v[0] ** 2 + args[1] * v[1] ** 2 + v[2] ** 2)
            - GRAVITY * upward(q)
        ),
        nonholonomic=lambda t, q, v, args: v[2],
        manifold=GROUP,
    )
    turn = nhjax.SO3(nhjax.Exponential()).retract(jnp.array([0.0, 0.0, 1.0]))
    v = jnp.array([1.3, -0.7, 0.0])
    turned = GROUP.compose(ATTITUDE, turn), GROUP.Ad(GROUP.inverse(turn), v)
    ends = []
    for q, velocity in ((ATTITUDE, v), turned):
        y0 = nhjax.initial_state(system, q, velocity, args=moments)
        sol = nhjax.integrate(
            system, nhjax.LobattoIIIAB(3), y0, dt=0.02, num_steps=50, args=moments
        )
        ends.append(axes(sol.ys.q)[-1, :, 2])
    distance = np.max(np.abs(ends[0] - ends[1]))
    if moments[0] == moments[1]:
        assert distance < 1e-13
    else:
        assert distance > 0.01


def test_group_skate_on_a_sphere_matches_reduced_equations():
    # The contact is the third body axis, the blade points along the first: the contact
    # may not move along the second, which is Suslov's constraint ω₁ = 0.
    turning_inertia = 0.3
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * (v[0] ** 2 + v[1] ** 2 + turning_inertia * v[2] ** 2)
            - GRAVITY * upward(q)
        ),
        nonholonomic=lambda t, q, v, args: v[0],
        manifold=GROUP,
    )
    v = jnp.array([0.0, 1.1, 1.7])

    def rate(_, z):
        # Γ = Rᵀ e_z and ω = (0, ω₂, ω₃), with ω₃ constant.
        vertical, omega = z[:3], np.array([0.0, z[3], v[2]])
        return [*np.cross(vertical, omega), -GRAVITY * vertical[0]]

    start = [*axes(ATTITUDE[None])[0][2], float(v[1])]
    errors = ([], [])
    for ts, y, _ in run(system, v, 3):
        found = np.concatenate([axes(y.q)[:, 2], y.v[:, 1:2]], axis=1)
        expected = solve_ivp(rate, (0.0, DURATION), start, t_eval=ts, **FINE).y.T
        errors[0].append(len(ts))
        errors[1].append(rms(found - expected))
        np.testing.assert_allclose(y.v[:, 2], v[2], rtol=0, atol=1e-13)
    assert_order(4, *errors, floor=SCIPY_FLOOR)
