"""Runs that are exported, serialised, and called in a process without nhjax."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import nhjax
from nhjax import LobattoIIIAB, RESULTS


DISC = nhjax.systems.VerticalRollingDisc()
OTHER_PROCESS = """
import sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
from jax import export
program = export.deserialize(open(sys.argv[1], "rb").read())
given = [jax.numpy.asarray(x) for x in np.load(sys.argv[2]).values()]
q, code = program.call(*given)
slopes = jax.grad(lambda *x: program.call(*x)[0].sum(), argnums=(0, 1, 2))(*given)
assert "nhjax" not in sys.modules
np.savez(sys.argv[3], q, code, *slopes)
"""


def end_of_run(q, p, dt):
    y = nhjax.initial_state(DISC.system, q, p=p, throw=False)
    sol = nhjax.integrate(
        DISC.system, LobattoIIIAB(3), y, dt=dt, num_steps=10, throw=False
    )
    return sol.ys.q[0], sol.result._value


@pytest.mark.long
def test_exported_run_in_another_process_gives_equal_results(tmp_path, monkeypatch):
    y0 = DISC.initial_state()
    given = y0.q, y0.p, jnp.asarray(0.1)
    exported = export.export(jax.jit(end_of_run))(*given)
    program, arguments, results = (tmp_path / x for x in ("run", "in.npz", "out.npz"))
    program.write_bytes(exported.serialize(vjp_order=1))
    np.savez(arguments, *given)
    names = map(str, (program, arguments, results))
    subprocess.run([sys.executable, "-c", OTHER_PROCESS, *names], check=True)
    found = list(np.load(results).values())
    # XLA alone compiles exported programs, whichever engine is chosen.
    monkeypatch.setenv("NHJAX_ENGINE", "xla")
    q, code = jax.jit(end_of_run)(*given)
    slopes = jax.jit(jax.grad(lambda *x: end_of_run(*x)[0].sum(), argnums=(0, 1, 2)))(
        *given
    )
    for got, expected in zip(found, (q, code, *slopes), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-15)


def test_exported_run_without_throw_has_no_callback():
    y0 = DISC.initial_state()

    def run(y, dt, **options):
        return nhjax.integrate(
            DISC.system, LobattoIIIAB(2), y, dt=dt, num_steps=3, **options
        )

    silent = jax.jit(lambda y, dt: run(y, dt, throw=False)).lower(y0, 0.1).as_text()
    loud = jax.jit(run).lower(y0, 0.1).as_text()
    assert "python" in loud
    assert "python" not in silent


@pytest.mark.parametrize(
    "change", [{"dt": 0.0}, {"dt": jnp.nan}, {"t0": 1e18}, {"num_steps": 0}]
)
def test_run_with_invalid_argument_without_throw_returns_its_result(change):
    y0 = DISC.initial_state()

    def run(dt, t0, num_steps):
        return nhjax.integrate(
            DISC.system,
            LobattoIIIAB(2),
            y0,
            dt=dt,
            t0=t0,
            num_steps=num_steps,
            throw=False,
        )

    values = {"dt": 0.1, "t0": 0.0, "num_steps": 3} | change
    sol = jax.jit(run)(*map(jnp.asarray, values.values()))
    assert bool(sol.result == RESULTS.invalid_argument)
    assert int(sol.stats["failed_step"]) == 0
    ((_, _, reason),) = sol.failures()
    assert "An argument of the run is not valid" in reason
    good = jax.jit(run)(0.1, 0.0, jnp.asarray(3))
    assert bool(good.result == RESULTS.successful)


def test_samples_outside_the_run_without_throw_return_their_result():
    y0 = DISC.initial_state()

    def run(ts):
        return nhjax.integrate(
            DISC.system,
            LobattoIIIAB(2),
            y0,
            dt=0.1,
            num_steps=3,
            saveat=nhjax.SaveAt(ts=ts),
            throw=False,
        ).result

    assert bool(jax.jit(run)(jnp.array([0.1, 0.3])) == RESULTS.successful)
    assert bool(jax.jit(run)(jnp.array([0.1, 0.4])) == RESULTS.invalid_argument)
    assert bool(jax.jit(run)(jnp.array([0.2, 0.1])) == RESULTS.invalid_argument)


@pytest.mark.parametrize("ts", [jnp.linspace(0.0, 0.3, 4), np.array([0.1]), [0.0, 0.2]])
def test_samples_with_concrete_times_under_jit_are_checked(ts):
    y0 = DISC.initial_state()

    def run(dt, ts):
        saveat = nhjax.SaveAt(ts=ts)
        return nhjax.integrate(
            DISC.system, LobattoIIIAB(2), y0, dt=dt, num_steps=3, saveat=saveat
        ).ts

    np.testing.assert_allclose(jax.jit(lambda dt: run(dt, ts))(0.1), ts)
    with pytest.raises(ValueError, match="sorted"):
        jax.jit(lambda dt: run(dt, [0.2, 0.1, 0.3]))(0.1)
