"""Accelerations and reactions, compared with independently written equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from support.driven import ARGS, DRIVEN
from support.forms import in_rotation, in_space
from support.group_gallery import SOLVED
from support.group_oracle import acceleration_and_multiplier


EXAMPLES = ("unicycle", "ball tilted", "Suslov", "rigid body", "spherical pendulum")
STARTS = {
    "in space": in_space("nonholonomic", in_time=True),
    "on a sphere": in_space("holonomic"),
    "in rotation": in_rotation("nonholonomic", in_time=True),
    "at a fixed tilt": in_rotation("holonomic"),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_motion_accelerations_solve_the_equations_of_motion(name):
    example = SOLVED[name]
    y = example.initial_state()
    motion = nhjax.motion(example.system, 0.0, y)
    acceleration, multiplier = acceleration_and_multiplier(example.system, y.q, y.v)
    np.testing.assert_allclose(motion.acceleration, acceleration, rtol=0, atol=1e-13)
    np.testing.assert_allclose(motion.multiplier, multiplier, rtol=0, atol=1e-13)
    # The two unknowns of the linear system with the constrained mass matrix.
    unknowns = jnp.concatenate([motion.acceleration, motion.multiplier])
    right = motion.constrained_mass_matrix @ unknowns
    n = y.v.size
    force = motion.mass_matrix @ motion.acceleration - motion.reaction
    np.testing.assert_allclose(right[:n], force, rtol=0, atol=1e-13)


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_motion_in_lagrangian_and_hamiltonian_form_is_equal(start):
    y = start.y0
    # The velocity for a given momentum depends on time.
    lagrangian = start.forms["lagrangian"]
    p = lagrangian.momentum(jnp.asarray(0.3), y.q, y.v, None)
    y = type(y)(y.q, y.v, p, y.multiplier)
    motions = [nhjax.motion(system, 0.3, y) for system in start.forms.values()]
    for one, other in zip(*map(jax.tree.leaves, motions), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS.keys())
def test_motion_momentum_rate_is_the_sum_of_forces_and_reactions(start):
    system, y = start.forms["lagrangian"], start.y0
    motion = nhjax.motion(system, 0.0, y)
    t = jnp.asarray(0.0)
    force = system.free_force(t, y.q, y.v, y.multiplier, None)
    if not system.manifold_of(y.q).is_flat:
        force = force + jnp.cross(y.p, y.v)
    expected = force + motion.reaction
    np.testing.assert_allclose(motion.momentum_rate, expected, rtol=0, atol=1e-13)


def test_motion_accelerations_agree_with_rates_along_a_trajectory():
    y = nhjax.initial_state(
        DRIVEN.system, jnp.ones(3), jnp.ones(3), t=0.2, args=ARGS, project=True
    )
    motion = nhjax.motion(DRIVEN.system, 0.2, y, ARGS)

    def at(dt):
        method = nhjax.LobattoIIIAB(5)
        return nhjax.step(DRIVEN.system, method, 0.2, dt, y, ARGS)

    # A difference of sixth order.
    h, weights = 0.01, np.array([3 / 4, -3 / 20, 1 / 60])
    ahead, behind = (
        jax.vmap(at)(sign * h * jnp.arange(1.0, 4.0)) for sign in (1.0, -1.0)
    )
    for rate, name in ((motion.acceleration, "v"), (motion.momentum_rate, "p")):
        differences = getattr(ahead, name) - getattr(behind, name)
        np.testing.assert_allclose(rate, weights @ differences / h, rtol=0, atol=1e-10)


def test_motion_reaction_of_a_pendulum_is_the_force_in_its_rod():
    pendulum = nhjax.systems.SphericalPendulum(
        2.0, 0.5, 9.81, q0=(0.0, 0.0, -0.5), v0=(0.3, 0.0, 0.0)
    )

    def length(t, q, args):
        return jnp.sqrt(q @ q) - 0.5

    system = nhjax.LagrangianSystem(pendulum.lagrangian, holonomic=length)
    y = nhjax.initial_state(system, pendulum.q0, pendulum.v0)
    motion = nhjax.motion(system, 0.0, y)
    pull = 2.0 * (9.81 + 0.3**2 / 0.5)
    np.testing.assert_allclose(motion.multiplier, [-pull], rtol=1e-14)
    np.testing.assert_allclose(motion.reaction, [0, 0, pull], rtol=1e-14)
    np.testing.assert_allclose(motion.compatibility_matrix, [[0.5]], rtol=1e-14)


def test_motion_reactions_of_single_constraints_add_up():
    disc = nhjax.systems.VerticalRollingDisc()
    motion = nhjax.motion(disc.system, 0.0, disc.initial_state())
    each = motion.reaction_of_each
    assert each.shape == (2, 4)
    np.testing.assert_allclose(jnp.sum(each, axis=0), motion.reaction, atol=1e-15)


def test_motion_reactions_saved_under_vmap_agree_at_equal_times():
    disc = nhjax.systems.VerticalRollingDisc()
    y0 = disc.initial_state()

    def reaction(t, y, args):
        return nhjax.motion(disc.system, t, y, args).reaction

    def run(dt):
        saveat = nhjax.SaveAt(steps=True, fn=reaction)
        method = nhjax.LobattoIIIAB(2)
        return nhjax.integrate(
            disc.system, method, y0, dt=dt, num_steps=3, saveat=saveat
        ).ys

    saved = jax.jit(jax.vmap(run))(jnp.asarray([0.1, 0.2]))
    assert saved.shape == (2, 3, 4)
    # Two steps of the first run end at the same time as one step of the second.
    np.testing.assert_allclose(saved[0, 1], saved[1, 0], rtol=0, atol=1e-3)
    assert np.ptp(np.asarray(saved[..., 0])) > 1e-2


def test_motion_in_single_precision_keeps_dtype():
    disc = nhjax.systems.VerticalRollingDisc()
    motion = nhjax.motion(disc.system, 0.0, disc.initial_state(jnp.float32))
    assert motion.is_unique.dtype == bool
    numbers = [x.dtype for x in jax.tree.leaves(motion) if x.dtype != bool]
    assert set(numbers) == {jnp.dtype("float32")}


def test_motion_without_a_state_raises():
    disc = nhjax.systems.VerticalRollingDisc()
    with pytest.raises(TypeError, match=r"`y` must be an nhjax\.State"):
        nhjax.motion(disc.system, 0.0, disc.q0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeError, match=r"motion\(system, t, y, args\)"):
        nhjax.motion(disc.system, disc.initial_state(), 0.0)  # pyright: ignore[reportArgumentType]
