"""The eigenvalues of the bicycle against those in print."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
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
# Table 2: the two real eigenvalues and the pair, which is real in the first row. In 50
# digits, the linear equations have these to 1e-13 but for 18.15788466125202 at 7 m/s.
EIGENVALUES = (
    (-5.53094371765393, -3.13164324790656, (3.13164324790656, 5.53094371765393)),
    (-7.11008014637442, -3.13423125066578, 3.52696170990070 + 0.8077402751993j),
    (-8.67387984831735, -3.07158645641514, 2.68234517512745 + 1.68066296590675j),
    (-10.35101467245920, -2.63366137253667, 1.70675605663975 + 2.31582447384325j),
    (-12.15861426576447, -1.42944427361326, 0.41325331521125 + 3.07910818603206j),
    (-14.07838969279822, -0.32286642900409, -0.77534188219585 + 4.46486771378823j),
    (-16.0853712309803, -0.00406690076970, -1.52644486584142 + 5.87673060598709j),
    (-18.15788466125262, 0.10268170574766, -2.13875644258362 + 7.19525913329805j),
    (-20.27940894394569, 0.14327879765713, -2.69348683581097 + 8.46037971396931j),
    (-22.43788559040858, 0.15790184030917, -3.21675402252485 + 9.69377351531791j),
    (-24.62459635017404, 0.16105338653172, -3.72016840437287 + 10.90681139476287j),
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

    Lean, steer and their rates make a consistent state, a step follows, and its
    derivative is that of the same four numbers at its end. The mode exp(λ h) has the
    logarithm λ h.
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


def printed_eigenvalues():
    rows = []
    for *real, pair in EIGENVALUES:
        both = pair if isinstance(pair, tuple) else (pair, np.conj(pair))
        rows.append(np.sort_complex(np.array([*real, *both])))
    return np.array(rows)


@pytest.mark.long
def test_eigenvalues_of_the_bicycle_equal_published_ones(multipliers):
    found = multipliers(np.arange(11.0), 0.015)
    np.testing.assert_allclose(found, printed_eigenvalues(), rtol=0, atol=2e-12)


@pytest.mark.long
def test_eigenvalues_of_small_steps_equal_published_ones(multipliers):
    # At rest the derivatives of multipliers are smaller than their round-off, which
    # grows like 1 / h.
    found = multipliers(np.arange(11.0), 0.004)
    np.testing.assert_allclose(found, printed_eigenvalues(), rtol=0, atol=1e-9)


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
