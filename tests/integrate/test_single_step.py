"""Single steps, for users with time loops of their own."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, RESULTS, systems


H = 0.1
SYSTEMS = {
    "nonholonomic": systems.NonholonomicParticle(),
    "holonomic": systems.SphericalPendulum(),
    "on a group": systems.Suslov(),
}


def hamiltonian_pendulum():
    pendulum = systems.SphericalPendulum()
    system = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p + q[2], holonomic=pendulum.holonomic
    )
    return system, nhjax.initial_state(system, pendulum.q0, p=pendulum.v0)


@pytest.mark.parametrize(
    ("name", "method"),
    [
        *itertools.product(
            [*SYSTEMS, "Hamiltonian"],
            [LobattoIIIAB(3), LobattoIIIAB(3, "propagated")],
        ),
        ("nonholonomic", LobattoIIIAB(3, "consistent")),
        ("on a group", LobattoIIIAB(3, chart="start")),
    ],
)
def test_step_outside_jit_equals_integrate_bit_for_bit(name, method):
    if name == "Hamiltonian":
        system, y0 = hamiltonian_pendulum()
    else:
        system, y0 = SYSTEMS[name].system, SYSTEMS[name].initial_state()
    y = nhjax.step(system, method, 0.5, H, y0)
    sol = nhjax.integrate(system, method, y0, t0=0.5, dt=H, num_steps=1)
    first = nhjax.integrate(
        system, method, y0, t0=0.5, dt=H, num_steps=4, saveat=nhjax.SaveAt(steps=True)
    )
    for one, of_run, of_long_run in zip(
        *map(jax.tree.leaves, (y, sol.ys, first.ys)), strict=True
    ):
        np.testing.assert_array_equal(one, of_run[0])
        np.testing.assert_array_equal(one, of_long_run[0])


@pytest.mark.parametrize(
    ("t", "y", "error", "message"),
    [
        (None, None, TypeError, "`y` must be an nhjax.State, got None"),
        (0.0, "checkpoint", TypeError, "`y` must be an nhjax.State, got Checkpoint"),
        (None, "state", nhjax.DTypeError, "`t` must be a real number, got None"),
        ([0.0, 1.0], "state", nhjax.DTypeError, "`t` must be a real number, got"),
        (np.zeros(2), "state", nhjax.ShapeError, r"`t` has shape \(2,\), but a scalar"),
    ],
)
def test_step_with_wrong_arguments_names_them(t, y, error, message):
    example, method = SYSTEMS["nonholonomic"], LobattoIIIAB(2)
    y0 = example.initial_state()
    sol = nhjax.integrate(
        example.system,
        method,
        y0,
        dt=H,
        num_steps=1,
        saveat=nhjax.SaveAt(checkpoint=True),
    )
    given = {"checkpoint": sol.checkpoint, "state": y0, None: None}[y]
    with pytest.raises(error, match=message):
        nhjax.step(example.system, method, t, H, given)


@pytest.mark.parametrize("name", SYSTEMS)
def test_step_under_jit_equals_integrate_under_jit_bit_for_bit(name):
    system, y0 = SYSTEMS[name].system, SYSTEMS[name].initial_state()
    method = LobattoIIIAB(2)

    @jax.jit
    def by_integrate(y, dt):
        sol = nhjax.integrate(system, method, y, t0=0.5, dt=dt, num_steps=1)
        return jax.tree.map(lambda x: x[0], sol.ys)

    y = jax.jit(lambda y, dt: nhjax.step(system, method, 0.5, dt, y))(y0, H)
    jax.tree.map(np.testing.assert_array_equal, y, by_integrate(y0, H))


def height_by_steps(system, method, y, g, num_steps):
    def advance(y, k):
        return nhjax.step(system, method, H * k, H, y, g), None

    y, _ = jax.lax.scan(advance, y, jnp.arange(num_steps, dtype=float))
    return y.q[2]


def height_by_integrate(system, method, y, g, num_steps):
    sol = nhjax.integrate(system, method, y, dt=H, num_steps=num_steps, args=g)
    return sol.ys.q[0, 2]


def test_step_in_a_scan_has_the_gradient_of_integrate():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, g: 0.5 * v @ v - g * q[2] * (1 + 0.1 * jnp.sin(t)),
        holonomic=lambda t, q, g: q @ q - 1.0,
        nonholonomic=lambda t, q, v, g: v[0] - q[1] * v[2],
    )
    q, v = jnp.array([0.6, 0.0, 0.8]), jnp.array([0.0, 0.7, 0.0])
    y0 = nhjax.initial_state(system, q, v, args=1.3)
    method, losses = LobattoIIIAB(2), (height_by_steps, height_by_integrate)
    values = [
        jax.jit(
            jax.value_and_grad(lambda g, loss=loss: loss(system, method, y0, g, 20))
        )(1.3)
        for loss in losses
    ]
    np.testing.assert_allclose(values[0][0], values[1][0], rtol=1e-13)
    np.testing.assert_allclose(values[0][1], values[1][1], rtol=1e-10)
    assert abs(values[0][1]) > 1e-2


def test_step_in_forward_and_reverse_mode_has_equal_derivatives():
    particle = SYSTEMS["nonholonomic"]
    system, y0 = particle.system, particle.initial_state()

    def end(h):
        return nhjax.step(system, LobattoIIIAB(2), 0.0, h, y0).p

    forward, reverse = (mode(end)(H) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


def test_step_under_vmap_equals_single_steps():
    system, y0 = SYSTEMS["nonholonomic"].system, SYSTEMS["nonholonomic"].initial_state()
    sizes = jnp.array([0.05, 0.1, -0.1])
    method = LobattoIIIAB(2)
    batch = jax.vmap(lambda h: nhjax.step(system, method, 0.0, h, y0))(sizes)
    for k, h in enumerate(sizes):
        alone = nhjax.step(system, method, 0.0, h, y0)
        np.testing.assert_allclose(batch.q[k], alone.q, rtol=1e-15)


@pytest.mark.filterwarnings("ignore:.SimplifiedNewton. did not solve")
def test_step_that_cannot_be_solved_raises_or_is_nan():
    pendulum = SYSTEMS["holonomic"]
    system, y0 = pendulum.system, pendulum.initial_state()
    # The free flight of so long a step ends too far from the sphere to return to it.
    with pytest.raises(nhjax.IntegrationError, match="step 0"):
        nhjax.step(system, LobattoIIIAB(2), 0.0, 100.0, y0)
    sizes = jnp.array([0.1, 100.0])
    y = jax.vmap(
        lambda h: nhjax.step(system, LobattoIIIAB(2), 0.0, h, y0, throw=False)
    )(sizes)
    assert jnp.all(jnp.isfinite(y.q[0]))
    for leaf in jax.tree.leaves(y):
        assert jnp.all(jnp.isnan(leaf[1]))


def test_step_with_feedback_control_reaches_the_target():
    # Between steps the control is what the user makes of the state.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, u: 0.5 * v @ v, force=lambda t, q, v, u: u
    )
    y = nhjax.initial_state(system, jnp.array([1.0]), jnp.zeros(1), args=jnp.zeros(1))
    method = nhjax.Gauss(1)
    for k in range(100):
        u = -2.0 * y.q - 2.0 * y.v
        y = nhjax.step(system, method, 0.05 * k, 0.05, y, u)
    assert abs(float(y.q[0])) < 0.05


def test_step_with_one_bad_member_does_not_change_others():
    particle = SYSTEMS["nonholonomic"]
    system, good = particle.system, particle.initial_state()
    q = jnp.stack([good.q, good.q, good.q])
    v = jnp.stack([good.v, good.v + 1.0, jnp.full(3, jnp.nan)])

    def start(q, v):
        return nhjax.initial_state(system, q, v, throw=False)

    y = jax.vmap(start)(q, v)
    undisturbed = jax.vmap(start)(q, jnp.stack([good.v, good.v, good.v]))
    for leaf, of_good in zip(*map(jax.tree.leaves, (y, undisturbed)), strict=True):
        np.testing.assert_array_equal(leaf[0], of_good[0])
        assert jnp.all(jnp.isnan(leaf[1:]))
    sol = jax.vmap(
        lambda y: nhjax.integrate(
            system, LobattoIIIAB(2), y, dt=0.1, num_steps=3, throw=False
        )
    )(y)
    states = [RESULTS.successful] + [RESULTS.nonfinite_state] * 2
    assert [int(x) for x in sol.result._value] == [int(x._value) for x in states]
    with pytest.raises(nhjax.ConstraintViolationError):
        nhjax.initial_state(system, q[1], v[1])
    with pytest.raises(nhjax.ShapeError):
        nhjax.initial_state(system, q[1], v[1, :2], throw=False)
    with pytest.raises(TypeError, match="`throw`"):
        nhjax.initial_state(system, q[0], v[0], throw="no")  # pyright: ignore[reportArgumentType]
