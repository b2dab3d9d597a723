"""Gradients of batches and on several devices."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, systems
from support.helpers import scalar
from support.long import long


PARTICLE = systems.NonholonomicParticle()


def particle_run(q, dt, mass, friction):
    """A particle with friction, from a projected state."""
    example = eqx.tree_at(lambda e: e.mass, PARTICLE, mass)
    system = nhjax.LagrangianSystem(
        example.lagrangian,
        nonholonomic=example.constraint,
        force=lambda t, q, v, args: -args["friction"] * v,
    )
    args = {"friction": friction}
    y0 = nhjax.initial_state(system, q, PARTICLE.v0, args=args, project=True)
    return scalar(
        nhjax.integrate(system, LobattoIIIAB(2), y0, dt=dt, num_steps=5, args=args).ys
    )


@pytest.fixture(scope="module")
def single():
    return jax.jit(jax.grad(particle_run, argnums=(0, 1, 2, 3)))


LANES = (
    jnp.array([[0.5, -0.3, 0.2], [1.0, 0.0, 0.0], [-0.2, 0.8, 0.1]]),
    jnp.array([0.1, 0.05, -0.1]),
    jnp.array([1.0, 1.5, 2.0]),
    jnp.array([0.0, 0.1, 0.2]),
)


@pytest.mark.parametrize("axes", [long((0, None, None, None)), (None, 0, 0, 0)])
def test_gradients_of_a_batch_equal_single_runs(axes, single):
    given = [x if axis == 0 else x[0] for x, axis in zip(LANES, axes, strict=True)]
    batch = jax.jit(
        jax.vmap(jax.grad(particle_run, argnums=(0, 1, 2, 3)), in_axes=axes)
    )(*given)
    for k in range(3):
        lane = [x[k] if axis == 0 else x for x, axis in zip(given, axes, strict=True)]
        for got, expected in zip(batch, single(*lane), strict=True):
            np.testing.assert_allclose(got[k], expected, rtol=1e-12, atol=1e-13)


def test_gradients_of_a_jitted_batch_with_unbatched_results_equal_single_runs():
    """The times of nodes are not batched, whichever member failed."""

    def ends(mass, q):
        example = eqx.tree_at(lambda e: e.mass, PARTICLE, mass)

        def end(q):
            y0 = nhjax.initial_state(example.system, q, PARTICLE.v0, project=True)
            return nhjax.integrate(
                example.system,
                LobattoIIIAB(2),
                y0,
                dt=0.1,
                num_steps=3,
                saveat=nhjax.SaveAt(steps=True, fn=lambda t, y, args: (t, y.q)),
            ).ys

        return jax.vmap(end)(q)

    def loss(mass, q):
        ts, positions = ends(mass, q)
        return jnp.sum(positions**2) + jnp.sum(ts)

    masses = jnp.array([1.0, 1.5])
    got = jax.jit(jax.vmap(jax.grad(loss), in_axes=(0, None)))(masses, LANES[0])
    lane = jax.jit(jax.grad(loss))
    expected = [sum(lane(mass, q[None]) for q in LANES[0]) for mass in masses]
    np.testing.assert_allclose(got, jnp.stack(expected), rtol=1e-12)


def test_gradients_of_an_ensemble_equal_single_runs():
    chaotic = systems.ChaoticSystem()

    def end(q, v):
        y0 = nhjax.initial_state(chaotic.system, q, v)
        method = LobattoIIIAB(2)
        ys = nhjax.integrate(chaotic.system, method, y0, dt=0.1, num_steps=5).ys
        return scalar(ys)

    q0, v0 = chaotic.ensemble(100)
    total = jax.grad(lambda q, v: jnp.sum(jax.vmap(end)(q, v)), argnums=(0, 1))
    got = jax.jit(total)(q0, v0)
    member = jax.jit(jax.grad(end, argnums=(0, 1)))
    members = [member(q, v) for q, v in zip(q0, v0, strict=True)]
    expected = jax.tree.map(lambda *x: jnp.stack(x), *members)
    assert got[0].shape == (101, 7)
    for x, y in zip(got, expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12)


SHARDED = """
import jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
import jax.numpy as jnp
import numpy as np
from functools import partial
from jax.sharding import Mesh, PartitionSpec as P
import nhjax

assert len(jax.devices()) == 4
example = nhjax.systems.NonholonomicParticle()
mesh = Mesh(np.array(jax.devices()), ("lanes",))


def run(speed, stiffness, adjoint):
    system = nhjax.systems.NonholonomicParticle(1.0, stiffness).system
    y0 = nhjax.initial_state(system, example.q0, speed * example.v0)
    ys = nhjax.integrate(
        system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=5, adjoint=adjoint
    ).ys
    return jnp.sum(jnp.sin(ys.q)) + jnp.sum(ys.p**2)


def total(speeds, stiffness, adjoint):
    each = jax.vmap(lambda s: run(s, stiffness, adjoint))(speeds)
    return jnp.sum(each), each


def sharded(speeds, stiffness, adjoint):
    @partial(
        jax.shard_map,
        mesh=mesh,
        in_specs=(P("lanes"), P()),
        out_specs=P("lanes"),
        check_vma=False,
    )
    def each(speeds, stiffness):
        return jax.vmap(lambda s: run(s, stiffness, adjoint))(speeds)

    each = each(speeds, stiffness)
    return jnp.sum(each), each


speeds, stiffness = jnp.linspace(0.5, 1.5, 8), jnp.asarray(1.3)
for adjoint in (nhjax.DirectAdjoint(), nhjax.ReversibleAdjoint()):
    got, expected = [
        jax.jit(jax.value_and_grad(f, argnums=(0, 1), has_aux=True), static_argnums=2)(
            speeds, stiffness, adjoint
        )
        for f in (sharded, total)
    ]
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12), got, expected)
    assert len(got[0][1].sharding.device_set) == 4
"""


@pytest.mark.long
def test_shards_on_several_devices_equal_one_device():
    flags = os.environ.get("XLA_FLAGS", "")
    flags = f"{flags} --xla_force_host_platform_device_count=4"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", SHARDED],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
