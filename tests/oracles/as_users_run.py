"""Every feature in brief, as a program of its own: each prints its name if it holds."""

import os
import tempfile
from collections.abc import Callable
from typing import Any

import jax


jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import sympy  # noqa: E402
import xarray  # noqa: E402
from sympy.physics.mechanics import dynamicsymbols  # noqa: E402

import nhjax  # noqa: E402
from nhjax import LobattoIIIAB, SaveAt, systems  # noqa: E402


PARTICLE = systems.NonholonomicParticle()
DT, STEPS = 0.1, 10
TWO = LobattoIIIAB(2)
FEATURES: dict[str, Callable[[], None]] = {}


def feature(function: Callable[[], None]) -> Callable[[], None]:
    """A feature that is tested under the name of its function."""
    FEATURES[function.__name__] = function
    return function


def close(got, expected, atol=1e-12):
    """Compare trees."""
    pairs = zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True)
    for x, y in pairs:
        np.testing.assert_allclose(x, y, rtol=0, atol=atol)


def run(example: Any = PARTICLE, method: Any = None, **options: Any) -> nhjax.Solution:
    """A few steps from the state of an example."""
    arguments: dict[str, Any] = {"y0": example.initial_state(), "dt": DT}
    arguments |= {"num_steps": STEPS} | options
    system = arguments.pop("system", example.system)
    return nhjax.integrate(system, method or LobattoIIIAB(4), **arguments)


def assert_exact(example, sol, atol=1e-7):
    """Compare the end of a run with the exact solution; constraints hold."""
    q, v, _ = example.exact(DT * STEPS)
    close(jax.tree.map(lambda x: x[-1], (sol.ys.q, sol.ys.v)), (q, v), atol)
    assert float(sol.stats["max_constraint_violation"]) < 1e-13
    assert sol.result == nhjax.RESULTS.successful


def of_dt(adjoint=None):
    """A scalar function of the step size."""

    def loss(dt):
        options = {} if adjoint is None else {"adjoint": adjoint}
        return jnp.sum(jnp.sin(run(method=TWO, dt=dt, **options).ys.q))

    return loss


@feature
def propagated_closure():
    assert_exact(PARTICLE, run(method=LobattoIIIAB(4, "propagated")))


@feature
def consistent_closure():
    assert_exact(PARTICLE, run(method=LobattoIIIAB(4, "consistent")))


@feature
def symmetric_closure():
    assert_exact(PARTICLE, run())


@feature
def newtons_method():
    close(run(stage_solver=nhjax.Newton()).ys, run().ys)


@feature
def gauss_without_constraints():
    oscillator = systems.HarmonicOscillator()
    assert_exact(oscillator, run(oscillator, nhjax.Gauss(4)))


@feature
def a_constraint_nonlinear_in_velocities():
    appell = systems.Appell()
    assert_exact(appell, run(appell))


@feature
def holonomic_constraints():
    pendulum = systems.SphericalPendulum()
    assert_exact(pendulum, run(pendulum))


@feature
def both_kinds_of_constraints():
    sleigh = systems.RodSleigh()
    assert_exact(sleigh, run(sleigh))


@feature
def redundant_constraints():
    pendulum = systems.SphericalPendulum()

    def twice(t, q, args):
        return jnp.stack([pendulum.holonomic(t, q, args), q @ q - 1.0])

    system = nhjax.LagrangianSystem(
        pendulum.lagrangian, holonomic=twice, constraints="redundant"
    )
    y0 = nhjax.initial_state(system, pendulum.q0, pendulum.v0)
    sol = run(pendulum, system=system, y0=y0)
    assert_exact(pendulum, sol)
    assert int(sol.stats["num_redundant"]) == 1
    assert not np.any(nhjax.motion(system, 0.0, y0).is_unique)
    report = nhjax.check_system(system, pendulum.q0, pendulum.v0)
    assert report.degrees_of_freedom == 2


@feature
def many_constraints_that_share_few_coordinates():
    chain = systems.PendulumChain(5)
    sol = run(chain, num_steps=3)
    assert float(sol.stats["max_constraint_violation"]) < 1e-13
    start, y = chain.initial_state(), jax.tree.map(lambda x: x[-1], sol.ys)
    close(chain.energy(0.3, y.q, y.v), chain.energy(0.0, start.q, start.v), 1e-7)


@feature
def a_hamiltonian_system():
    pendulum = systems.SphericalPendulum()
    system = nhjax.HamiltonianSystem(
        lambda t, q, p, args: 0.5 * p @ p + q[2], holonomic=pendulum.holonomic
    )
    y0 = nhjax.initial_state(system, pendulum.q0, p=pendulum.v0)
    assert_exact(pendulum, run(pendulum, system=system, y0=y0))


@feature
def a_group():
    suslov = systems.Suslov()
    assert_exact(suslov, run(suslov), 1e-6)


@feature
def a_group_with_the_chart_of_the_paper():
    suslov = systems.Suslov()
    assert_exact(suslov, run(suslov, LobattoIIIAB(4, chart="start")))


@feature
def a_product_of_groups():
    ball = systems.TurntableBall(retraction=nhjax.Exponential())
    assert_exact(ball, run(ball), 1e-6)


@feature
def a_projected_start():
    q = PARTICLE.q0 + 0.1
    y = nhjax.initial_state(PARTICLE.system, q, PARTICLE.v0, project=True)
    assert abs(float(PARTICLE.constraint(0.0, y.q, y.v, None))) < 1e-14


@feature
def time_force_and_args():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        nonholonomic=lambda t, q, v, args: v[1] - jnp.cos(t),
        force=lambda t, q, v, args: -args["friction"] * v,
    )
    args = {"friction": 0.5}
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2), args=args)
    sol = run(system=system, y0=y0, args=args)
    close(sol.ys.v[-1], jnp.array([np.exp(-0.5), np.cos(1.0)]), 1e-9)


@feature
def energy_that_is_kept():
    for example in (PARTICLE, systems.Suslov()):
        start = example.initial_state()
        sol = run(example, TWO, y0=start, num_steps=50, invariants="energy")
        expected = example.energy(0.0, start.q, start.v)
        y = jax.tree.map(lambda x: x[-1], sol.ys)
        close(example.energy(5.0, y.q, y.v), expected, 1e-14)
        assert float(sol.stats["max_invariant_error"]) < 1e-14


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
def dense_output_and_samples():
    ts = jnp.array([0.05, 0.33, 1.0])
    dense = jax.vmap(run(saveat=SaveAt(dense=True)).evaluate)(ts)
    sampled = run(saveat=SaveAt(ts=ts)).ys
    close(sampled, dense)
    close(dense.q[1], PARTICLE.exact(0.33)[0], 1e-5)


@feature
def saved_functions():
    system = PARTICLE.system
    saveat = SaveAt(
        t0=True, steps=2, t1=True, fn=lambda t, y, args: system.energy(t, y)
    )
    energies = run(saveat=saveat).ys
    assert energies.shape == (6,)
    close(energies, jnp.full(6, energies[0]), 1e-5)


@feature
def a_run_that_is_resumed_from_a_file():
    saveat = SaveAt(t1=True, checkpoint=True)
    with tempfile.TemporaryDirectory() as folder:
        half = run(num_steps=4, saveat=saveat)
        nhjax.save(f"{folder}/half.npz", half.checkpoint)
        resumed = nhjax.load(f"{folder}/half.npz")
    rest = run(y0=resumed, num_steps=STEPS - 4, saveat=saveat)
    close(rest.ys, run(saveat=saveat).ys, 0.0)
    assert_exact(PARTICLE, rest)


@feature
def labelled_data():
    data = run(saveat=SaveAt(steps=True)).to_xarray(coordinates=("x", "y", "z"))
    assert data.q.sel(coordinate="z", time=DT * STEPS).shape == ()


@feature
def a_model_from_sympy():
    x, y, _ = coordinates = dynamicsymbols("x y z")
    speeds = [q.diff() for q in coordinates]
    k = sympy.Symbol("k")
    model = nhjax.from_sympy(
        sum(u**2 for u in speeds) / 2 - k * (x**2 + y**2) / 2,
        coordinates,
        nonholonomic=speeds[2] - y * speeds[0],
        parameters={k: 1.0},
    )
    y0 = model.initial_state(PARTICLE.q0, PARTICLE.v0)
    assert_exact(PARTICLE, run(system=model.system, y0=y0, args=model.args))


@feature
def events_that_reset_and_end():
    """A ball falls from 1/2 in unit time and rises with half of its speed."""
    ball = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - args * q[0])
    bounce = nhjax.Event(
        lambda t, y, args: y.q[0],
        direction=False,
        reset=lambda t, y, args: (y.q, -0.5 * y.v),
    )
    end = nhjax.Event(lambda t, y, args: t - 1.25)

    def found(gravity):
        y0 = nhjax.initial_state(ball, jnp.array([0.5]), jnp.zeros(1), args=gravity)
        options = {"args": gravity, "event": [bounce, end], "dt": 0.3, "num_steps": 9}
        sol = nhjax.integrate(ball, TWO, y0, **options)
        return sol.events.ts[0], sol.t1, sol.events.num

    close(found(1.0), (1.0, 1.25, 2))
    rates = jax.vmap(jax.grad(lambda gravity: found(gravity)[0]))(jnp.array([1.0, 4.0]))
    close(rates, jnp.array([-0.5, -0.0625]))


@feature
def batches():
    dts = jnp.array([0.1, 0.05, -0.1])
    batch = jax.jit(jax.vmap(lambda dt: run(dt=dt).ys))(dts)
    close(jax.tree.map(lambda x: x[0], batch), run().ys)


@feature
def an_ensemble_in_chunks_with_statistics():
    def member(dt):
        return run(method=TWO, dt=dt, throw=False)

    dts = np.array([0.1, 0.05, 300.0, 0.02, 0.08])
    reduce = {"mean": nhjax.Mean(), "variance": nhjax.Variance()}
    reduce |= {"least": nhjax.Minimum(), "most": nhjax.Maximum()}
    reduce["counts"] = nhjax.Histogram([-10, 0, 10], of=lambda sol: sol.ys.q)
    outcome = nhjax.ensemble(member, dts, reduce=reduce, chunk_size=2)
    assert outcome.failed.tolist() == [2]
    with tempfile.TemporaryDirectory() as folder:
        options = {"reduce": reduce, "chunk_size": 2, "out": folder}
        for _ in range(2):
            kept = nhjax.ensemble(member, dts, **options)
            close(kept.statistics, outcome.statistics, atol=0)
    q = nhjax.ensemble(member, dts, chunk_size=2).values.ys.q[[0, 1, 3, 4]]
    got = outcome.statistics
    close(got["mean"].ys.q, q.mean(axis=0))
    close(got["variance"].ys.q, q.var(axis=0, ddof=1))
    close((got["least"].ys.q, got["most"].ys.q), (q.min(axis=0), q.max(axis=0)))
    close(got["counts"].counts[..., 1], np.sum(q >= 0, axis=0))


@feature
def an_ensemble_that_is_stored_and_goes_on():
    def member(dt):
        return run(method=TWO, dt=dt, throw=False)

    dts = np.linspace(0.05, 0.1, 5)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "sweep.zarr")
        nhjax.ensemble(member, dts, out=path, chunk_size=2)
        os.remove(os.path.join(path, "q", "c", "1", "0", "0"))
        assert nhjax.ensemble(member, dts, out=path, chunk_size=2).failures() == []
        with xarray.open_zarr(path) as data:
            close(data.q.values, nhjax.ensemble(member, dts).values.ys.q)


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
    """Of 40 members, by every engine.

    Kernels whose parameters turn out to be unused or constant abort XLA's compiler.
    """
    sleigh = systems.RodSleigh()

    def loss(q):
        y0 = nhjax.initial_state(sleigh.system, q, sleigh.v0, project=True)
        sol = run(sleigh, TWO, y0=y0, saveat=SaveAt(steps=True))
        return jnp.sum(sol.ys.q)

    starts = sleigh.q0 + 1e-3 * jnp.arange(40.0)[:, None]
    many = {}
    for engine in ("kernels", "lanes"):
        os.environ["NHJAX_ENGINE"] = engine
        many[engine] = jax.jit(jax.vmap(jax.grad(loss)))(starts)
        jax.clear_caches()
    del os.environ["NHJAX_ENGINE"]
    close(many["kernels"], many["lanes"])
    assert jnp.all(jnp.ptp(many["lanes"], axis=0) > 0)


@feature
def gradients_on_a_group_by_checkpoints():
    suslov, adjoint = systems.Suslov(), nhjax.RecursiveCheckpointAdjoint()

    def loss(dt):
        return jnp.sum(jnp.sin(run(suslov, TWO, dt=dt, adjoint=adjoint).ys.q))

    gradient = jax.jit(jax.grad(loss))(DT)
    close(gradient, (loss(DT + 1e-5) - loss(DT - 1e-5)) / 2e-5, 1e-7)


@feature
def accelerations_and_a_report():
    pendulum = systems.SphericalPendulum()
    y0 = pendulum.initial_state()
    motion = nhjax.motion(pendulum.system, 0.0, y0)
    close(motion.multiplier, pendulum.exact(0.0)[2])
    report = nhjax.check_system(pendulum.system, pendulum.q0, pendulum.v0)
    assert report.degrees_of_freedom == 2
    close(motion.constraint_jacobian[0], 2 * y0.q)
    assert motion.constrained_mass_matrix.shape == (4, 4)
    close(motion.reaction_of_each[0], motion.reaction)
    assert motion.compatibility_matrix.shape == (1, 1)


@feature
def a_steady_motion_and_its_stability():
    pendulum = systems.SphericalPendulum.swinging(0.3, gravity=4.0)
    y0 = pendulum.initial_state()
    hanging: dict[str, Any] = {"positions": (0, 1), "velocities": (0, 1)}
    y = nhjax.steady_motion(pendulum.system, 0.0, y0, **hanging)
    for chosen in ({}, hanging):
        stability = nhjax.linear_stability(pendulum.system, 0.0, y, **chosen)
        close(jnp.sort(jnp.abs(stability.eigenvalues)), jnp.full(4, 2.0), 1e-12)


@feature
def stability_up_to_a_symmetry():
    cosine = 0.25
    radius, speed = (1 - cosine**2) ** 0.5, (1 / cosine - cosine) ** 0.5
    cone = systems.SphericalPendulum(q0=(0, radius, -cosine), v0=(speed, 0, 0))
    stability = nhjax.linear_stability(
        cone.system,
        0.0,
        cone.initial_state(),
        symmetry=lambda q: jnp.stack([-q[1], q[0], 0 * q[2]]),
    )
    assert stability.basis.shape == (6, 3)
    y0 = nhjax.initial_state(cone.system, cone.q0, 1.1 * cone.v0)
    y, rates = nhjax.steady_motion(
        cone.system,
        0.0,
        y0,
        symmetry=lambda q: jnp.stack([-q[1], q[0], 0 * q[2]]),
        held_positions=(2,),
    )
    close([*rates, y.q[2]], [-2.0, -cosine])
    frequency = (1 / cosine + 3 * cosine) ** 0.5
    close([*jnp.sort(stability.eigenvalues.imag)], [-frequency, 0.0, frequency])


@feature
def single_precision():
    sol = run(y0=PARTICLE.initial_state(jnp.float32))
    assert sol.ys.q.dtype == jnp.float32
    close(sol.ys.q[-1].astype(float), PARTICLE.exact(1.0)[0], 1e-5)


@feature
def a_failure_is_told():
    y0 = PARTICLE.initial_state()
    wrong = nhjax.State(y0.q, y0.v + 1.0, y0.p, y0.multiplier)
    sol = run(y0=wrong, throw=False)
    assert sol.result == nhjax.RESULTS.inconsistent_start
    try:
        jax.block_until_ready(jax.jit(lambda y0: run(y0=y0).ys.q)(wrong))
    except RuntimeError as error:
        assert "step 0: The initial state violates" in str(error)  # noqa: PT017
    else:
        raise AssertionError("nothing was raised")


if __name__ == "__main__":
    for name, function in FEATURES.items():
        try:
            function()
        # Whatever is wrong with a feature, the others are tried too; the test of this
        # one fails, since its name does not stand alone on a line.
        except Exception as error:
            print(f"{name}: {type(error).__name__}: {error}".replace("\n", " "))
        else:
            print(name, flush=True)
