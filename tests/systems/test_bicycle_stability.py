"""The eigenvalues of the bicycle against those in print."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from benchmarks.rolling import published_eigenvalues
from nhjax.systems import WhippleBicycle
from support import bicycle as oracle
from support.library_motion import motion_at


# Meijaard et al. (2007), section 5(b): M, C1, K0 and K2.
MATRICES = (
    [[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]],
    [[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]],
    [[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]],
    [[0.0, 76.59734589573222], [0.0, 2.65431523794604]],
)
WEAVE, CAPSIZE = 4.29238253634111, 6.02426201538837


def test_linear_equations_of_the_oracle_equal_published_ones():
    for matrix, printed in zip(
        oracle.canonical(oracle.BENCHMARK), MATRICES, strict=True
    ):
        np.testing.assert_allclose(matrix, printed, rtol=0, atol=1.5e-14 * 10)


# Compiling its derivative takes most of a minute.
@pytest.fixture(scope="module")
def multipliers():
    """A function (speeds, step sizes) -> eigenvalues of the linearised step.

    Lean, steer and their rates determine a consistent state. A step maps these four
    numbers to the same numbers at its end; its derivative has the eigenvalues exp(λ h).
    """
    system = WhippleBicycle().system
    method = nhjax.LobattoIIIAB(5)

    def monodromy(speed, h):
        def after(z):
            lean, steer, *rates = z
            start = WhippleBicycle.running(speed, *rates, lean=lean, steer=steer)
            q, v = start.q0, start.v0
            _, multiplier = motion_at(system, 0.0, q, v)
            p = system.momentum(0.0, q, v)
            y = nhjax.State(q, v, p, jax.lax.stop_gradient(multiplier))
            y = nhjax.step(system, method, 0.0, h, y, throw=False)
            return jnp.stack([y.q[3], y.q[5], y.v[3], y.v[5]])

        return jax.jacfwd(after)(jnp.zeros(4))

    @jax.jit
    def of_all(speeds, hs):
        return jax.vmap(lambda h: jax.vmap(monodromy, (0, None))(speeds, h))(hs)

    def eigenvalues(speeds, h):
        """Richardson's extrapolation from h, 3h/4 and h/2: the errors are h⁸, h¹⁰..."""
        hs = h * np.array([1.0, 0.75, 0.5])
        steps = np.asarray(of_all(jnp.asarray(speeds, float), jnp.asarray(hs)))
        found = [
            [np.sort_complex(np.log(np.linalg.eigvals(A).astype(complex))) for A in row]
            for row in steps
        ]
        rates = np.array(found) / hs[:, None, None]
        terms = (hs[:, None] / h) ** np.array([0, 8, 10])
        return np.einsum("h,hvk->vk", np.linalg.inv(terms)[0], rates)

    return eigenvalues


@pytest.mark.long
def test_eigenvalues_of_the_bicycle_equal_published_ones(multipliers):
    found = multipliers(np.arange(11.0), 0.015)
    np.testing.assert_allclose(found, published_eigenvalues(), rtol=0, atol=2e-12)


@pytest.mark.long
def test_eigenvalues_of_small_steps_equal_published_ones(multipliers):
    # At rest the derivatives of multipliers are smaller than their round-off, which
    # grows like 1 / h.
    found = multipliers(np.arange(11.0), 0.004)
    np.testing.assert_allclose(found, published_eigenvalues(), rtol=0, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize(
    ("printed", "first"),
    [(WEAVE, "complex"), (CAPSIZE, "real")],
    ids=["weave", "capsize"],
)
def test_speeds_of_neutral_stability_equal_published_ones(multipliers, printed, first):
    speeds = np.round(printed, 2) + 0.002 * np.arange(-5, 6)
    eigenvalues = multipliers(speeds, 0.015)
    oscillates = np.abs(eigenvalues.imag) > 1e-3
    assert np.all(oscillates.sum(axis=1) == 2)
    chosen = oscillates if first == "complex" else ~oscillates
    growth = np.max(np.where(chosen, eigenvalues.real, -np.inf), axis=1)
    # The speed as a polynomial in the growth rate, at zero.
    (speed,) = np.polynomial.Polynomial.fit(growth, speeds, 4)(np.zeros(1))
    assert speed == pytest.approx(printed, rel=0, abs=4e-12)
