"""Ensembles by the native engine equal XLA to round-off, whatever their members do."""

from functools import lru_cache

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from benchmarks.engines import difference, FINAL_TIMES, gallery, program
from nhjax import LobattoIIIAB, systems
from support.long import exhaustive_but, long


pytestmark = pytest.mark.usefixtures("optimised_kernels")

GALLERY = gallery()
# On vector spaces and on each group, with each kind of constraints.
QUICK = (
    "ChaoticSystem",
    "ChaplyginSleigh",
    "RodSleigh",
    "Unicycle",
    "Suslov",
    "HeavyTop",
)
# Rollers, closed loops, large systems and forces; `benchmarks.engines` compares all.
LONG = (
    "AndrewsSqueezer",
    "BallInBowl",
    "CarAxis",
    "FlyballGovernor",
    "HeavyTopSE3",
    "PendulumChain",
    "Rattleback",
    "RollingDisc",
    "SpatialSliderCrank",
    "WhippleBicycle",
)
PARTICLE = systems.NonholonomicParticle()
# Iterations end at round-off, so some steps take one more or one less.
LARGEST_DIFFERENCE_OF_COUNTS, OF_A_MEMBER = 0.03, 0.15


def ensemble(example, members, num_steps):
    """States and step sizes of members that end at times around t = 2.

    The ball in the bowl turns so fast that such steps may have no solution.
    """
    y0 = example.initial_state()
    y0 = jax.tree.map(lambda x: np.broadcast_to(x, (members, *x.shape)), y0)
    end = FINAL_TIMES.get(type(example).__name__, 2.0)
    return y0, np.linspace(0.8, 1.0, members) * end / num_steps


def by_both(function, args, monkeypatch):
    """The results of one traced program by the native engine and by XLA."""
    program, shapes = jax.make_jaxpr(jax.vmap(function), return_shape=True)(*args)
    found = []
    for engine in ("lanes", "xla"):
        monkeypatch.setenv("NHJAX_ENGINE", engine)

        # A new function each time, since compiled programs keep their engine.
        @jax.jit
        def run(leaves):
            return jax.extend.core.jaxpr_as_fun(program)(*leaves)

        leaves = jax.tree.leaves(args)
        found.append(jax.tree.unflatten(jax.tree.structure(shapes), run(leaves)))
    return found


@pytest.mark.parametrize("name", exhaustive_but(QUICK, QUICK + LONG))
def test_ensemble_by_native_engine_equals_xla(name, monkeypatch):
    num_steps = 20
    function = program(GALLERY[name], "end", 2, num_steps)
    args = ensemble(GALLERY[name], 9, num_steps)
    (lanes, lane_counts), (expected, counts) = by_both(function, args, monkeypatch)
    assert np.all(np.asarray(counts) > 0)
    assert difference(lanes, expected) < 1e-12
    change = np.asarray(lane_counts) / np.asarray(counts) - 1
    assert np.abs(np.mean(change)) <= LARGEST_DIFFERENCE_OF_COUNTS
    assert np.all(np.abs(change) <= OF_A_MEMBER)


@pytest.mark.parametrize(
    "kind", ["rows", "dense", "jvp", long("checkpoints"), "reversible"]
)
def test_output_and_derivatives_by_native_engine_equal_xla(kind, monkeypatch):
    function = program(PARTICLE, kind, 2, 10)
    args = ensemble(PARTICLE, 5, 10)
    (lanes, _), (expected, counts) = by_both(function, args, monkeypatch)
    assert np.all(np.asarray(counts) > 0)
    assert difference(lanes, expected) < 1e-12


@lru_cache
def ten_steps(name):
    """The last state and the statistics of each member of an ensemble."""

    @jax.jit
    @jax.vmap
    def run(y0, dt):
        sol = nhjax.integrate(
            GALLERY[name].system, LobattoIIIAB(2), y0, dt=dt, num_steps=10, throw=False
        )
        return sol.ys, sol.stats["num_iterations"], sol.stats["failed_step"]

    return run


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200, 1e308, -0.0])
@pytest.mark.parametrize("name", ["NonholonomicParticle", "ChaplyginSleigh"])
def test_member_that_fails_in_an_ensemble_does_not_change_others(name, value):
    """The 11 members fill one vector register and a part of another; some diverge."""
    run, wild = ten_steps(name), [1, 4, 10]
    y0, dt = ensemble(GALLERY[name], 11, 10)
    expected = run(y0, dt)
    q = np.array(y0.q)
    q[wild] = value
    got = run(nhjax.State(jnp.asarray(q), y0.v, y0.p, y0.multiplier), dt)
    others = [k for k in range(11) if k not in wild]
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(np.asarray(x)[others], np.asarray(y)[others])


@pytest.mark.parametrize("members", [1, 7, 8, 9, 1000])
def test_ensemble_of_any_size_equals_its_members(members):
    @jax.jit
    @jax.vmap
    def run(dt):
        return nhjax.integrate(
            PARTICLE.system,
            LobattoIIIAB(2),
            PARTICLE.initial_state(),
            dt=dt,
            num_steps=3,
            throw=False,
        ).ys.q

    dt = jnp.linspace(0.1, 0.2, members)
    q = run(dt)
    # All lanes of a vector compute alike, so the place of a member does not matter.
    np.testing.assert_array_equal(q[::-1], run(dt[::-1]))
    np.testing.assert_array_equal(q[:1], run(dt[:1]))


def test_engine_of_steps_does_not_depend_on_the_function_of_the_saved_ends():
    """The native engine has no Fourier transforms."""

    def spectrum(t, y, args):
        return jnp.abs(jnp.fft.fft(y.q))

    def run(y0, **saved):
        saveat = nhjax.SaveAt(fn=spectrum, **saved)
        options = {"dt": 0.1, "num_steps": 10, "saveat": saveat}
        return nhjax.integrate(PARTICLE.system, LobattoIIIAB(2), y0, **options).ys

    y0 = PARTICLE.initial_state()
    for saved in ({"t1": True}, {"t0": True, "t1": True}):
        uses = nhjax.engines(lambda y0, saved=saved: run(y0, **saved), y0)
        assert {use.engine for use in uses} == {"lanes"}
    uses = nhjax.engines(lambda y0: run(y0, t0=True, steps=True), y0)
    assert "xla" in {use.engine for use in uses}
    both = jax.jit(lambda y0: run(y0, t0=True, t1=True))(y0)
    np.testing.assert_allclose(both[0], spectrum(0.0, y0, None), rtol=1e-14)
