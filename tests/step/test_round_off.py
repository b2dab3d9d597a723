"""Solved steps near rest are not refused, and starts with round-off alone are taken."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax._numerics import measured_noise


@pytest.mark.parametrize("dt", [1e-3, 5e-2])
@pytest.mark.parametrize(
    "solver", [nhjax.SimplifiedNewton(fallback=False), nhjax.Newton()]
)
def test_steps_of_slow_bicycle_are_accepted_by_both_solvers(dt, solver):
    bicycle = nhjax.systems.WhippleBicycle()
    system, y0 = bicycle.system, bicycle.initial_state()
    for scale in (1e-6, 1e-4, 1e-2):
        y = nhjax.initial_state(system, y0.q, scale * y0.v, project=True)
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(4),
            y,
            dt=dt,
            num_steps=10,
            throw=False,
            stage_solver=solver,
        )
        assert bool(sol.result == nhjax.RESULTS.successful), (scale, dt)
        assert float(sol.stats["max_constraint_violation"]) < 1e-15


def test_noise_of_function_includes_constants_that_cancel():
    x = jnp.array([1e-7, 1e-7, 0.0])

    def height(dx):
        q = x + dx
        return ((1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0])[None]

    (noise,) = measured_noise(height, 3, jnp.zeros(1))
    # The standard deviation of one rounding of a number between 1 and 2 is 6e-17.
    assert 2e-17 < noise < 5e-16


@pytest.mark.parametrize("jump", [jnp.sign, jnp.abs])
def test_noise_at_jump_or_kink_of_friction_at_rest_is_round_off(jump):
    (noise,) = measured_noise(lambda dx: 5.0 * jump(dx), 1, jnp.zeros(1))
    assert noise < 1e-15


def test_noise_of_smooth_function_in_small_units_is_round_off():
    # A length of 1e-8 units in which the function turns.
    (noise,) = measured_noise(lambda dx: jnp.sin(0.4 + dx / 1e-8), 1, jnp.zeros(1))
    assert noise < 1e-14


def test_starts_near_upright_with_round_off_in_a_height_are_taken():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: (1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0],
    )
    rng = np.random.default_rng(0)
    x = jnp.asarray(10 ** rng.uniform(-8, -3, 100))
    q = jnp.stack([x, x, jnp.zeros_like(x)], axis=1)

    def start(q):
        return nhjax.initial_state(system, q, jnp.zeros(3), throw=False).q

    assert bool(jnp.all(jnp.isfinite(jax.vmap(start)(q))))


@pytest.mark.parametrize("error", [1e-11, 1e-9])
def test_start_that_violates_height_by_more_than_round_off_is_refused(error):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: (1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0],
    )
    q = jnp.array([1e-5, 1e-5 + error, 0.0])
    with pytest.raises(nhjax.ConstraintViolationError, match="Γ"):
        nhjax.initial_state(system, q, jnp.zeros(3))
