"""Terms of order h in the Jacobian of simplified Newton, and their effect."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax import systems
from nhjax._step import first_step_state
from nhjax._step._jacobian import factorise_stage_jacobian, simplified_newton_update
from nhjax._step._step import equations_of_step, starting_values, StepArguments
from support.forms import in_space
from support.long import exhaustive, long


def contraction(example, method, h):
    """Return spectral radii of an iteration with and without terms of order h.

    Automatic differentiation computes the derivative of the whole iteration with
    respect to the unknowns, independently of the formulas of these terms.
    """
    system, y0, t = example.system, example.initial_state(), jnp.zeros(())

    @jax.jit
    def rates(h):
        start = first_step_state(system, method, t, y0, None)
        arguments = StepArguments(system, t, h, start, None)
        stages = equations_of_step(arguments, method)
        lin = start.lin
        x0 = starting_values(stages, system.fibre_coordinate(y0), lin)
        x = nhjax.Newton().solve(stages, x0, lin, jnp.asarray(False)).x
        z, unravel = ravel_pytree(x)

        def slope(jacobian):
            factors = factorise_stage_jacobian(stages, x0, lin, jacobian)
            return jax.jacfwd(
                lambda z: ravel_pytree(
                    simplified_newton_update(stages, factors, unravel(z))[0]
                )[0]
            )(z)

        return [slope(jacobian) for jacobian in ("leading", "first_order")]

    sizes = (jnp.asarray(h), jnp.asarray(h / 2))
    return np.array(
        [[np.abs(np.linalg.eigvals(J)).max() for J in rates(h)] for h in sizes]
    )


@pytest.mark.parametrize(
    ("example", "chart"),
    [
        (systems.ChaplyginSleigh(), "middle"),
        (systems.Unicycle(), "start"),
        long(systems.Suslov(), "middle"),
        exhaustive(systems.HeavyTopSE3(), "middle"),
    ],
    ids=lambda x: x if isinstance(x, str) else type(x).__name__,
)
def test_first_order_iteration_contracts_by_the_square_of_the_step(example, chart):
    method = nhjax.LobattoIIIAB(3, chart=chart)
    (leading, full), (leading_half, full_half) = contraction(example, method, 0.02)
    # The leading part leaves out the terms of order h, so it contracts by O(h).
    assert 1.8 < leading / leading_half < 2.2
    assert 3.6 < full / full_half < 4.4


def run(example, stages, dt, **solver):
    return jax.jit(
        lambda y0: nhjax.integrate(
            example.system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=dt,
            num_steps=20,
            stage_solver=nhjax.SimplifiedNewton(fallback=False, **solver),
            throw=False,
        )
    )(example.initial_state())


def test_first_order_terms_solve_large_steps_where_leading_part_fails():
    sleigh = systems.ChaplyginSleigh()
    leading = run(sleigh, 5, 0.5, jacobian="leading", max_iterations=100)
    assert leading.result == nhjax.RESULTS.nonlinear_max_iterations
    sol = run(sleigh, 5, 0.5)
    assert sol.result == nhjax.RESULTS.successful
    assert sol.stats["num_iterations"] <= 20 * 20
    newton = nhjax.integrate(
        sleigh.system,
        nhjax.LobattoIIIAB(5),
        sleigh.initial_state(),
        dt=0.5,
        num_steps=20,
        stage_solver=nhjax.Newton(),
    )
    for name in ("q", "v", "multiplier"):
        one, other = (getattr(s.ys, name) for s in (sol, newton))
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12, err_msg=name)


def test_first_order_terms_that_vanish_are_left_out():
    particle = systems.NonholonomicParticle()
    default, leading = (
        jax.make_jaxpr(
            lambda y0, solver=solver: (
                nhjax.integrate(
                    particle.system,
                    nhjax.LobattoIIIAB(3),
                    y0,
                    dt=0.1,
                    num_steps=2,
                    stage_solver=solver,
                    throw=False,
                ).ys.q
            )
        )(particle.initial_state())
        for solver in (
            nhjax.SimplifiedNewton(fallback=False),
            nhjax.SimplifiedNewton(fallback=False, jacobian="leading"),
        )
    )
    assert str(default) == str(leading)


@jax.custom_vjp
def in_reverse_mode_alone(v):
    """A force of v with a derivative rule only for reverse mode."""
    return -0.1 * v


in_reverse_mode_alone.defvjp(
    lambda v: (in_reverse_mode_alone(v), None), lambda _, rate: (-0.1 * rate,)
)


def from_outside(v):
    """The same force, computed in a callback outside of JAX."""
    shape = jax.ShapeDtypeStruct(v.shape, v.dtype)
    return jax.pure_callback(
        lambda v: -0.1 * np.asarray(v), shape, v, vmap_method="expand_dims"
    )


@pytest.mark.parametrize(
    ("force", "like"),
    [
        (in_reverse_mode_alone, lambda v: -0.1 * v),
        (from_outside, lambda v: -0.1 * v),
        # Their slopes at rest are not finite, or too large for a series.
        (lambda v: -jnp.linalg.norm(v) * v, lambda v: -jnp.abs(v) * v),
        (lambda v: -0.5 * jnp.tanh(v / 0.01), lambda v: -0.5 * jnp.tanh(v / 0.01)),
    ],
    ids=["reverse mode", "callback", "drag at rest", "steep friction"],
)
def test_first_order_terms_with_forces_of_infinite_slope_solve_steps(force, like):
    def fall(force, solver):
        system = nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * v @ v - q[0],
            force=lambda t, q, v, args: force(v),
        )
        y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2))
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=0.1,
            num_steps=10,
            stage_solver=solver,
        )

    sol = fall(force, nhjax.SimplifiedNewton(fallback=False))
    leading = fall(like, nhjax.SimplifiedNewton(fallback=False, jacobian="leading"))
    np.testing.assert_allclose(sol.ys.v, leading.ys.v, rtol=0, atol=1e-13)


def test_first_order_terms_that_are_unavailable_raise():
    wrong: Any = "exact"
    with pytest.raises(ValueError, match="jacobian must be one of 'leading'"):
        nhjax.SimplifiedNewton(jacobian=wrong)
    start = in_space("none", False)
    with pytest.raises(ValueError, match="not available for Hamiltonian systems"):
        nhjax.integrate(
            start.forms["hamiltonian"],
            nhjax.LobattoIIIAB(2),
            start.y0,
            dt=0.1,
            num_steps=1,
            stage_solver=nhjax.SimplifiedNewton(jacobian="first_order"),
        )
