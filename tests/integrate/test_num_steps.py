"""Runs of any length by one compiled program, if the output does not depend on it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from support.long import long
from support.particle_run import assert_trees_equal, PARTICLE


# Two programs agree bit for bit only in optimised kernels, as users have them. Without
# optimisation, one program may round a product before it is added, and the other may
# not.
pytestmark = pytest.mark.usefixtures("optimised_kernels")

REVERSIBLE = nhjax.ReversibleAdjoint()
ADJOINTS = [
    nhjax.DirectAdjoint(),
    nhjax.RecursiveCheckpointAdjoint(),
    REVERSIBLE,
]
traces: list[int] = []


def counted(t, q, v, args):
    traces.append(1)
    return 0.5 * (v @ v) - 0.5 * (q[0] ** 2 + q[1] ** 2)


SYSTEM = nhjax.LagrangianSystem(counted, nonholonomic=PARTICLE.constraint)


def run(num_steps: Any, y0: Any = None, **others: Any) -> nhjax.Solution:
    arguments: dict[str, Any] = {"dt": 0.1} | others
    return nhjax.integrate(
        SYSTEM,
        nhjax.LobattoIIIAB(3),
        PARTICLE.initial_state() if y0 is None else y0,
        num_steps=num_steps,
        **arguments,
    )


def static(num_steps: int, **others: Any) -> nhjax.Solution:
    """A run under the user's own `jit`, where an int stays static."""
    return jax.jit(lambda y0: run(num_steps, y0, **others))(PARTICLE.initial_state())


def norms(t, y, args):
    return y.q @ y.q


# Compiled once ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "saveat",
    [SaveAt(t1=True), SaveAt(t0=True, t1=True), SaveAt(t1=True, fn=norms)],
    ids=["end", "both ends", "function"],
)
@pytest.mark.parametrize("adjoint", ADJOINTS, ids=lambda x: type(x).__name__)
def test_num_steps_of_another_value_does_not_retrace(saveat, adjoint):
    run(3, saveat=saveat, adjoint=adjoint)
    count = len(traces)
    ends = [run(n, saveat=saveat, adjoint=adjoint).t1 for n in (1, 7, 20)]
    assert len(traces) == count
    np.testing.assert_allclose(ends, [0.1, 0.7, 2.0])


@pytest.mark.parametrize("num_steps", [1, 2, 33])
def test_num_steps_traced_equals_static(num_steps):
    got, expected = run(num_steps), static(num_steps)
    assert_trees_equal(
        (got.ys, got.ts, got.t1), (expected.ys, expected.ts, expected.t1)
    )
    assert_trees_equal(got.stats, expected.stats)


def test_num_steps_as_array_under_jit_is_accepted():
    program = jax.jit(lambda n: run(n))
    first = program(3)
    count = len(traces)
    assert_trees_equal(program(20).ys, run(20).ys)
    assert_trees_equal(first.ys, run(3).ys)
    assert len(traces) == count
    for length in (np.asarray(20), jnp.asarray(20, jnp.int16), np.int64(20)):
        assert_trees_equal(run(length).ys, run(20).ys)


def test_num_steps_under_vmap_may_differ_by_member():
    lengths = jnp.array([5, 1, 20])
    batch = jax.jit(jax.vmap(lambda n: run(n)))(lengths)
    np.testing.assert_array_equal(batch.stats["num_steps"], lengths)
    for lane, length in enumerate((5, 1, 20)):
        member = jax.tree.map(lambda x, lane=lane: x[lane], batch.ys)
        assert_trees_equal(member, run(length).ys)


def test_num_steps_under_vmap_by_xla_may_differ_by_member(monkeypatch):
    monkeypatch.setenv("NHJAX_ENGINE", "xla")
    batch = jax.jit(jax.vmap(lambda n: run(n)))(jnp.array([5, 20]))
    for lane, length in enumerate((5, 20)):
        np.testing.assert_allclose(batch.ys.q[lane], run(length).ys.q, rtol=1e-13)


@pytest.mark.parametrize("engine", ["lanes", "kernels"])
def test_num_steps_traced_compiles_one_kernel(monkeypatch, engine):
    monkeypatch.setenv("NHJAX_ENGINE", engine)
    y0 = PARTICLE.initial_state()
    # The first kernel measures round-off.
    _, use = nhjax.engines(lambda n: run(n, y0, throw=False).ys.q, 3)
    assert use.engine == engine


def test_num_steps_in_chunks_saves_any_number_of_states():
    @jax.jit
    def chunk(y0, t0):
        sol = run(4, y0, t0=t0, saveat=SaveAt(steps=True))
        return jax.tree.map(lambda x: x[-1], sol.ys), sol.t1, sol.ys.q

    y, t, q = chunk(PARTICLE.initial_state(), 0.0)
    pieces, count = [q], len(traces)
    for _ in range(2):
        y, t, q = chunk(y, t)
        pieces.append(q)
    assert len(traces) == count
    whole = run(12, saveat=SaveAt(steps=True)).ys.q
    np.testing.assert_allclose(np.concatenate(pieces), whole, rtol=1e-13)


# Derivatives --------------------------------------------------------------------------


def end(dt, num_steps, adjoint):
    ys = run(num_steps, dt=dt, adjoint=adjoint).ys
    return jnp.sum(jnp.sin(ys.q)) + jnp.sum(ys.p)


@pytest.fixture(scope="module")
def pushed():
    """The derivative by forward mode of a run with a static length."""
    return jax.jvp(lambda x: end(x, 8, ADJOINTS[0]), (0.1,), (1.0,))


@pytest.fixture(scope="module")
def reversible():
    """The gradient by the reversible adjoint, one program for all lengths."""
    return jax.jit(lambda x, n: jax.grad(end)(x, n, REVERSIBLE))


@pytest.mark.parametrize("adjoint", ADJOINTS[:2], ids=["direct", "checkpoints"])
def test_num_steps_traced_in_forward_mode_has_derivatives(adjoint, pushed):
    got = jax.jit(lambda n: jax.jvp(lambda x: end(x, n, adjoint), (0.1,), (1.0,)))(8)
    np.testing.assert_allclose(got, pushed, rtol=1e-12)


def test_num_steps_traced_with_reversible_adjoint_has_gradients(reversible):
    for num_steps in (1, 8):
        expected = jax.grad(lambda x, n=num_steps: end(x, n, ADJOINTS[0]))(0.1)
        got = reversible(0.1, num_steps)
        np.testing.assert_allclose(got, expected, rtol=1e-11)


def test_num_steps_under_vmap_has_gradients_of_single_runs(reversible):
    lengths = jnp.array([3, 8])
    gradient = jax.vmap(lambda n: jax.grad(end)(0.1, n, REVERSIBLE))
    got = jax.jit(gradient)(lengths)
    for lane, num_steps in enumerate((3, 8)):
        expected = reversible(0.1, num_steps)
        np.testing.assert_allclose(got[lane], expected, rtol=1e-11)


@pytest.mark.parametrize("adjoint", ADJOINTS[:2], ids=["direct", "checkpoints"])
def test_num_steps_traced_in_reverse_mode_raises(adjoint):
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        jax.jit(jax.grad(end), static_argnums=2)(0.1, 8, adjoint)


@pytest.mark.parametrize(
    "adjoint",
    [*map(long, ADJOINTS[:-1]), ADJOINTS[-1]],
    ids=lambda x: type(x).__name__,
)
def test_num_steps_as_int_inside_a_gradient_stays_static(adjoint):
    assert np.isfinite(jax.grad(end)(0.1, 4, adjoint))

    # This also holds if only a closure contains the differentiated number.
    def loss(friction):
        system = nhjax.LagrangianSystem(counted, force=lambda t, q, v, a: -friction * v)
        y0 = nhjax.initial_state(SYSTEM, PARTICLE.q0, PARTICLE.v0)
        y0 = nhjax.State(y0.q, y0.v, y0.p, jnp.zeros(0))
        sol = nhjax.integrate(
            system, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=4, adjoint=adjoint
        )
        return jnp.sum(sol.ys.q)

    assert jax.grad(loss)(0.1) < 0


# What is refused ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"saveat": SaveAt(steps=2, t1=True)}, r"`SaveAt\(steps=...\)` depends on it"),
        ({"saveat": SaveAt(dense=True)}, r"`SaveAt\(dense=True\)` depends on it"),
        ({"saveat": SaveAt(ts=[0.1])}, r"`SaveAt\(ts=...\)` depends on it"),
        ({"progress_meter": nhjax.TextProgressMeter()}, "`progress_meter` depends on"),
    ],
)
def test_num_steps_traced_with_output_of_its_length_raises(options, reason):
    for number in (jnp.asarray(4), np.asarray(4)):
        with pytest.raises(TypeError, match=f"known when tracing.*because.*{reason}"):
            run(number, **options)
    with pytest.raises(TypeError, match=f"known when tracing.*because.*{reason}"):
        jax.jit(lambda n: run(n, **options).t1)(4)


@pytest.mark.parametrize(
    ("num_steps", "exception", "message"),
    [
        (jnp.asarray(4.0), TypeError, "must be an int, or an integer array.*float64"),
        (jnp.asarray(True), TypeError, "must be an int, or an integer array.*bool"),
        (jnp.array([4]), nhjax.ShapeError, r"shape \(1,\), but a scalar.*jax.vmap"),
        (jnp.asarray(0), ValueError, "must be in 1.*, got 0"),
        (np.asarray(-3), ValueError, "must be in 1.*, got -3"),
        (jnp.asarray(2**31), ValueError, "must be in 1.*, got 2147483648"),
        ("4", TypeError, "must be an int, or an integer array.*got '4' of type str"),
    ],
)
def test_num_steps_of_a_wrong_value_raises(num_steps, exception, message):
    with pytest.raises(exception, match=f"`num_steps` .*{message}"):
        run(num_steps)


@pytest.mark.parametrize("num_steps", [0, -1, 2**31])
def test_num_steps_of_a_wrong_value_under_jit_raises(num_steps):
    with pytest.raises((RuntimeError, ValueError), match="`num_steps` must be in 1"):
        jax.block_until_ready(jax.jit(lambda n: run(n).ys.q)(num_steps))
