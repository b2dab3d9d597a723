"""Runs that continue bit for bit from a checkpoint, and refused checkpoints."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems
from support.driven import ARGS, DRIVEN, driven_state


CHECKPOINT = SaveAt(checkpoint=True)
PARTICLE, SUSLOV = systems.NonholonomicParticle(), systems.Suslov()
CASES = {
    "particle": (PARTICLE.system, LobattoIIIAB(2), PARTICLE.initial_state),
    "driven": (DRIVEN.system, LobattoIIIAB(3, "propagated"), driven_state),
    "group": (SUSLOV.system, LobattoIIIAB(2), SUSLOV.initial_state),
}


def run_of(name, **fixed):
    system, method, start = CASES[name]
    fixed = {"dt": 0.1, "args": ARGS} | fixed
    return partial(nhjax.integrate, system, method, **fixed), start()


def bytes_of(tree):
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("num_steps", [100_000])
def test_checkpoint_between_two_runs_repeats_one_run_bit_for_bit(
    name, num_steps, tmp_path
):
    run, y0 = run_of(name, saveat=CHECKPOINT)
    whole = run(y0, num_steps=num_steps).checkpoint
    nhjax.save(tmp_path / "run.npz", run(y0, num_steps=40_003).checkpoint)
    rest = run(nhjax.load(tmp_path / "run.npz"), num_steps=num_steps - 40_003)
    assert bytes_of(rest.checkpoint) == bytes_of(whole)
    assert float(rest.t0) == 40_003 * 0.1
    assert int(rest.stats["num_steps"]) == num_steps - 40_003
    assert int(whole.num_steps) == num_steps


def test_state_without_checkpoint_does_not_repeat_a_run_bit_for_bit():
    run, y0 = run_of("driven", saveat=SaveAt(t1=True, checkpoint=True))
    whole, half = run(y0, num_steps=2000), run(y0, num_steps=1000)
    state = half.checkpoint.state
    rest = run(state, t0=half.t1, num_steps=1000)
    assert bytes_of(rest.ys) != bytes_of(whole.ys)
    np.testing.assert_allclose(rest.ys.q, whole.ys.q, rtol=0, atol=1e-9)


def test_checkpoint_between_two_runs_saves_the_same_steps():
    run, y0 = run_of("driven", saveat=SaveAt(steps=3, checkpoint=True))
    whole, half = run(y0, num_steps=60), run(y0, num_steps=30)
    rest = run(half.checkpoint, num_steps=30)
    joined = jax.tree.map(
        lambda *x: jnp.concatenate(x), (half.ts, half.ys), (rest.ts, rest.ys)
    )
    assert bytes_of(joined) == bytes_of((whole.ts, whole.ys))


def test_checkpoint_of_a_batch_continues_with_different_lengths():
    run, y0 = run_of("particle", saveat=CHECKPOINT)
    several = jax.tree.map(lambda x: jnp.stack([x] * 3), y0)
    counts = jnp.array([3, 5, 8])
    go = jax.jit(jax.vmap(lambda y, n: run(y, num_steps=n).checkpoint))
    half = go(several, counts)
    assert half.num_steps.tolist() == [3, 5, 8]
    whole = go(half, 10 - counts)
    for leaf in jax.tree.leaves((whole.state, whole.p_compensation)):
        np.testing.assert_array_equal(leaf, jnp.stack([leaf[0]] * 3))
    np.testing.assert_allclose(whole.t, [1.0] * 3, rtol=1e-15)


def test_checkpoint_between_two_runs_has_the_gradient_of_one_run():
    run, y0 = run_of("driven")

    def end(y):
        return jnp.sum(jnp.sin(y.q)) + jnp.sum(y.multiplier)

    def of_state(y0, dt, args, parts):
        for _ in range(parts):
            steps = 6 // parts
            sol = run(y0, dt=dt, num_steps=steps, args=args, saveat=CHECKPOINT)
            y0 = sol.checkpoint
        return end(y0.state)

    def gradient(parts):
        return jax.jit(jax.grad(partial(of_state, parts=parts), argnums=(0, 1, 2)))

    one, two = (gradient(parts)(y0, 0.1, ARGS) for parts in (1, 2))
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-12)


def test_checkpoint_with_other_dt_or_args_starts_at_its_time():
    run, y0 = run_of("driven")
    half = run(y0, num_steps=10, saveat=CHECKPOINT).checkpoint
    other = {"dt": 0.05, "num_steps": 20, "args": jax.tree.map(lambda x: x + 0.5, ARGS)}
    from_state = run(half.state, t0=half.t, **other)
    from_checkpoint = run(half, **other, saveat=SaveAt(t1=True, checkpoint=True))
    np.testing.assert_allclose(from_checkpoint.ts, from_state.ts, rtol=1e-15)
    assert from_checkpoint.result == nhjax.RESULTS.successful
    # A checkpoint carries the last Λ^s of the propagated closure, as the state does.
    np.testing.assert_allclose(
        from_checkpoint.ys.q, from_state.ys.q, rtol=0, atol=1e-12
    )
    last = from_checkpoint.checkpoint
    np.testing.assert_allclose(last.t, 2.0, rtol=1e-14)


def test_checkpoint_of_a_failed_run_can_be_resumed():
    run, y0 = run_of("driven", saveat=SaveAt(steps=True, checkpoint=True))
    hasty = nhjax.Newton(max_iterations=2)
    sol = run(y0, num_steps=5, stage_solver=hasty, throw=False)
    failed = int(sol.stats["failed_step"])
    assert int(sol.checkpoint.num_steps) == failed < 5
    rest = run(sol.checkpoint, num_steps=5 - failed)
    np.testing.assert_allclose(
        rest.ys.q[-1], run(y0, num_steps=5).ys.q[-1], rtol=0, atol=1e-13
    )


def _wrong_system():
    run, _ = run_of("particle")
    other, y0 = run_of("group", saveat=CHECKPOINT)
    return run(other(y0, num_steps=1).checkpoint, num_steps=1)


def _time_given():
    run, y0 = run_of("particle", saveat=CHECKPOINT)
    return run(run(y0, num_steps=1).checkpoint, num_steps=1, t0=0.0)


def _batch_given():
    run, y0 = run_of("particle", saveat=CHECKPOINT)
    one = run(y0, num_steps=1).checkpoint
    wrong = nhjax.Checkpoint(**{**vars(one), "num_steps": jnp.zeros(2, jnp.int32)})
    return run(wrong, num_steps=1)


def _too_many():
    run, y0 = run_of("particle", saveat=CHECKPOINT)
    return run(run(y0, num_steps=1).checkpoint, num_steps=2**31 - 1)


def _no_flag():
    wrong: Any = 1
    return SaveAt(checkpoint=wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (_wrong_system, r"`y0\.state\.v` has shape"),
        (_time_given, "`t0` is given together with a checkpoint"),
        (_batch_given, r"`y0\.num_steps` has arrays of .*\(2,\).* is needed"),
        (_too_many, r"more than 2\^31 - 1 steps together"),
        (_no_flag, "`checkpoint` must be True or False"),
    ],
)
def test_checkpoint_of_another_system_raises(wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        wrong()
