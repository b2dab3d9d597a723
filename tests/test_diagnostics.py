"""Energy errors, momentum maps and observed orders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.diagnostics import convergence_order, energy_error, momentum_map


EVERY = nhjax.SaveAt(t0=True, steps=True)


def _run(example, y0=None, saveat=EVERY):
    return nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(3),
        example.initial_state() if y0 is None else y0,
        dt=0.1,
        num_steps=6,
        saveat=saveat,
    )


def _particles():
    particle = nhjax.systems.NonholonomicParticle()
    y0 = particle.initial_state()
    batch = jax.vmap(
        lambda x: nhjax.initial_state(particle.system, y0.q * x, y0.v, project=True)
    )(jnp.array([1.0, 0.8]))
    return particle, batch


def test_energy_error_of_a_solution_agrees_with_its_states():
    particle = nhjax.systems.NonholonomicParticle()
    sol = _run(particle)
    assert isinstance(sol.ys, nhjax.State)
    v, q = sol.ys.v, sol.ys.q
    energy = 0.5 * jnp.sum(v**2, axis=1) + 0.5 * (q[:, 0] ** 2 + q[:, 1] ** 2)
    error = energy_error(particle.system, sol)
    np.testing.assert_allclose(error, energy - energy[0], atol=1e-15)
    assert error[0] == 0
    assert 0 < np.max(np.abs(error)) < 1e-4


def test_energy_error_of_a_batch_agrees_with_vmap():
    particle, y0 = _particles()
    sol = jax.jit(jax.vmap(lambda y: _run(particle, y)))(y0)
    whole = energy_error(particle.system, sol)
    assert whole.shape == (2, 7)
    mapped = jax.vmap(lambda one: energy_error(particle.system, one))(sol)
    np.testing.assert_array_equal(whole, mapped)
    single = _run(particle, jax.tree.map(lambda x: x[1], y0))
    alone = energy_error(particle.system, single)
    np.testing.assert_allclose(whole[1], alone, atol=1e-14)


def test_energy_error_with_args_passes_them_to_the_system():
    def lagrangian(t, q, v, args):
        return 0.5 * args["mass"] * (v @ v) - 0.5 * (q @ q)

    system = nhjax.LagrangianSystem(lagrangian)
    args = {"mass": jnp.array(2.0)}
    y0 = nhjax.initial_state(system, jnp.array([1.0]), jnp.array([0.0]), args=args)
    method = nhjax.LobattoIIIAB(4)
    sol = nhjax.integrate(
        system, method, y0, dt=0.1, num_steps=5, args=args, saveat=EVERY
    )
    assert np.max(np.abs(energy_error(system, sol, args))) < 1e-9


@pytest.mark.parametrize(
    ("saveat", "message"),
    [
        (nhjax.SaveAt(steps=True), "initial state was not saved"),
        (nhjax.SaveAt(t1=True, fn=lambda t, y, args: y.q), "where states are needed"),
        (nhjax.SaveAt(dense=True), "has no values where states are needed"),
    ],
)
def test_energy_error_without_saved_states_raises(saveat, message):
    particle = nhjax.systems.NonholonomicParticle()
    sol = _run(particle, saveat=saveat)
    with pytest.raises(ValueError, match=message):
        energy_error(particle.system, sol)


def test_momentum_map_of_a_trajectory_agrees_with_single_states():
    disc = nhjax.systems.VerticalRollingDisc()
    sol = _run(disc)

    def roll(q):
        return jnp.array([jnp.cos(q[3]), jnp.sin(q[3]), 1.0, 0.0])

    assert isinstance(sol.ys, nhjax.State)
    along = momentum_map(sol.ys, roll)
    assert along.shape == (7,)
    # Rolling is a symmetry and a virtual displacement: (m R² + I) ψ̇ is conserved.
    np.testing.assert_allclose(along, 1.5 * 1.3, atol=1e-13)
    one = jax.tree.map(lambda x: x[0], sol.ys)
    np.testing.assert_allclose(momentum_map(one, roll), along[0], atol=1e-15)


def test_convergence_order_of_a_power_law_is_its_exponent():
    h = np.array([0.3, 0.1, 0.05])
    np.testing.assert_allclose(convergence_order(h, 7 * h**4), [4, 4], rtol=1e-13)
    columns = np.stack([h**2, 3 * h**6], axis=1)
    expected = [[2, 6], [2, 6]]
    np.testing.assert_allclose(convergence_order(-h, columns), expected, rtol=1e-13)


@pytest.mark.parametrize(
    ("step_sizes", "errors", "message"),
    [
        ([0.1, 0.2], [1.0, 2.0, 3.0], "one entry for each of the 2"),
        ([0.1, 0.0], [1.0, 2.0], "finite and nonzero"),
        ([0.1, 0.1], [1.0, 2.0], "differ from one to the next"),
        ([0.1, 0.2], [np.nan, 1.0], r"errors\(0,\) = nan"),
    ],
)
def test_convergence_order_with_invalid_errors_raises(step_sizes, errors, message):
    with pytest.raises(ValueError, match=message):
        convergence_order(step_sizes, errors)
