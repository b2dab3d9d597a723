"""Systems as arguments of the transformations of JAX itself."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import systems


START = jnp.zeros(3), jnp.array([1.0, 0.0, 0.3])


def blade(t, q, v, args):
    return -jnp.sin(q[2]) * v[0] + jnp.cos(q[2]) * v[1]


def push(t, q, v, args):
    return jnp.array([0.1, 0.0, 0.2])


class Kinetic(eqx.Module):
    mass: jax.Array

    def __call__(self, t, q, v, args):
        return 0.5 * self.mass * v @ v


def skate(mass):
    return nhjax.LagrangianSystem(
        Kinetic(jnp.asarray(mass)), nonholonomic=blade, force=push
    )


def traced(calls):
    """Compile `end`, and append to `calls` whenever it is traced."""

    def counted(system):
        calls.append(system)
        return end(system)

    return jax.jit(counted)


def end(system):
    y0 = nhjax.initial_state(system, *START)
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=5)
    return sol.ys.q[-1]


def test_system_as_argument_of_jit_runs_as_in_a_closure():
    system, calls = skate(2.0), []
    compiled = traced(calls)
    inside = jax.jit(lambda: end(system))()
    np.testing.assert_allclose(compiled(system), inside, rtol=1e-15)
    compiled(skate(3.0))
    assert len(calls) == 1


def test_system_with_another_function_recompiles_and_uses_it():
    calls = []
    compiled = traced(calls)
    pushed = compiled(skate(2.0))
    free = compiled(dataclasses.replace(skate(2.0), force=None))
    assert len(calls) == 2
    assert jnp.abs(pushed - free).max() > 1e-3


def test_batch_of_systems_under_vmap_equals_single_systems():
    masses = jnp.array([1.0, 2.0, 5.0])
    batch = jax.vmap(skate)(masses)
    single = jnp.stack([end(skate(mass)) for mass in masses])
    np.testing.assert_allclose(jax.vmap(end)(batch), single, rtol=1e-14)


def test_gradient_with_respect_to_a_system_equals_differences():
    gradient = jax.grad(lambda system: end(system)[0])(skate(2.0)).lagrangian.mass
    step = 1e-4
    ahead, behind = (end(skate(2.0 + x))[0] for x in (step, -step))
    np.testing.assert_allclose(gradient, (ahead - behind) / (2 * step), rtol=1e-7)


def test_hamiltonian_system_as_argument_of_jit_runs():
    system = nhjax.HamiltonianSystem(lambda t, q, p, args: 0.5 * (p @ p + q @ q))
    y0 = nhjax.initial_state(system, jnp.ones(2), p=jnp.zeros(2))
    method = nhjax.LobattoIIIAB(4)
    run = jax.jit(lambda s, y: nhjax.integrate(s, method, y, dt=0.1, num_steps=10))
    np.testing.assert_allclose(run(system, y0).ys.q[-1], jnp.cos(1.0), rtol=1e-9)


MODELS = [name for name in vars(systems) if hasattr(getattr(systems, name), "system")]


@pytest.mark.parametrize("name", MODELS)
def test_leaves_of_gallery_system_are_arrays(name):
    leaves = jax.tree.leaves(getattr(systems, name)().system)
    assert all(map(eqx.is_array, leaves))
