"""Short tests of derivatives and of the compiled programs, as users run them."""

import contextlib
import os
from collections.abc import Iterator

import jax
import jax.numpy as jnp

import nhjax
from nhjax import SaveAt, systems
from nhjax.lanes import is_available
from support.user_features import (
    close,
    DT,
    feature,
    of_dt,
    PARTICLE,
    run,
    TWO,
)


@contextlib.contextmanager
def compiled_by(engine: str) -> Iterator[None]:
    """Let one engine compile all programs; end this also if a feature fails."""
    os.environ["NHJAX_ENGINE"] = engine
    try:
        yield
    finally:
        del os.environ["NHJAX_ENGINE"]
        jax.clear_caches()


@feature
def two_functions_that_are_kept_and_their_gradient():
    cvt = systems.ContinuouslyVariableTransmission.low()

    def energies(t, q, v, args):
        return jnp.stack([cvt.driver_energy(q, v), cvt.passenger_energy(q, v)])

    def loss(dt):
        sol = run(cvt, TWO, dt=dt, invariants=energies)
        y = jax.tree.map(lambda x: x[-1], sol.ys)
        return jnp.sum(jnp.sin(y.q)) + energies(1.0, y.q, y.v, None) @ jnp.ones(2)

    gradient = jax.jit(jax.grad(loss))(DT)
    close(gradient, (loss(DT + 1e-5) - loss(DT - 1e-5)) / 2e-5, 1e-7)


@feature
def gradients_and_forward_mode():
    loss = of_dt(nhjax.DirectAdjoint())
    gradient = jax.jit(jax.grad(loss))(DT)
    _, rate = jax.jit(lambda x: jax.jvp(loss, (x,), (1.0,)))(DT)
    close(gradient, rate, 1e-11)
    close(gradient, (loss(DT + 1e-5) - loss(DT - 1e-5)) / 2e-5, 1e-7)


@feature
def gradients_of_a_batch_by_the_reversible_adjoint():
    loss, dts = of_dt(nhjax.ReversibleAdjoint()), jnp.array([DT, 0.5 * DT])
    batch = jax.jit(jax.vmap(jax.grad(loss)))(dts)
    expected = [(loss(dt + 1e-5) - loss(dt - 1e-5)) / 2e-5 for dt in dts]
    close(batch, jnp.stack(expected), 1e-7)


@feature
def gradients_of_an_ensemble_in_its_projected_starts():
    """Check 40 members, with every engine.

    Kernels whose parameters turn out to be unused or constant abort XLA's compiler.
    """
    sleigh = systems.RodSleigh()

    def loss(q):
        y0 = nhjax.initial_state(sleigh.system, q, sleigh.v0, project=True)
        sol = run(sleigh, TWO, y0=y0, saveat=SaveAt(steps=True))
        return jnp.sum(sol.ys.q**2)

    starts = sleigh.q0 + 1e-3 * jnp.arange(40.0)[:, None]
    many = {}
    for engine in ("kernels", "lanes"):
        with compiled_by(engine):
            many[engine] = jax.jit(jax.vmap(jax.grad(loss)))(starts)
    close(many["kernels"], many["lanes"])
    assert jnp.all(jnp.ptp(many["lanes"], axis=0) > 1e-3)


@feature
def gradients_on_a_group_by_checkpoints():
    suslov, adjoint = systems.Suslov(), nhjax.RecursiveCheckpointAdjoint()

    def loss(dt):
        return jnp.sum(jnp.sin(run(suslov, TWO, dt=dt, adjoint=adjoint).ys.q))

    gradient = jax.jit(jax.grad(loss))(DT)
    close(gradient, (loss(DT + 1e-5) - loss(DT - 1e-5)) / 2e-5, 1e-7)


@feature
def second_derivatives():
    slope = jax.grad(of_dt())
    second = jax.jit(jax.hessian(of_dt()))(DT)
    close(second, (slope(DT + 1e-5) - slope(DT - 1e-5)) / 2e-5, 1e-6)


@feature
def one_kernel_in_the_compiled_program():
    """By default, all steps are one operation of the compiled XLA program.

    Another operation before them measures the round-off of the system.
    """
    y0 = PARTICLE.initial_state()
    compiled = {}
    for engine in ("lanes", "kernels") if is_available() else ("kernels",):
        function = jax.jit(lambda y0: run(y0=y0).ys.q)
        with compiled_by(engine):
            _, use = nhjax.engines(function, y0)
            compiled[use.engine] = function.lower(y0).compile().as_text()
    assert 'xla_cpu_small_call="true"' in compiled["kernels"]
    if "lanes" in compiled:
        assert compiled["lanes"].count('custom_call_target="nhjax_lanes_') == 2
        assert " while(" not in compiled["lanes"]
