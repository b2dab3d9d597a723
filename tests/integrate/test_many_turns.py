"""Angles that have grown over many turns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax import systems


def disc_with_a_heading_on_a_circle():
    """Return the rolling disc on R^3 x SO(2), where its steps are those on R^4."""
    disc = systems.VerticalRollingDisc()
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: disc.lagrangian(t, jnp.concatenate(q), v, args),
        nonholonomic=lambda t, q, v, args: disc.constraint(
            t, jnp.concatenate(q), v, args
        ),
        manifold=nhjax.ProductGroup(nhjax.Euclidean(3), nhjax.SO2(nhjax.Exponential())),
    )
    return system, (disc.q0[:3], disc.q0[3:]), disc.v0


def unicycle():
    example = systems.Unicycle()
    return example.system, example.q0, example.v0


@pytest.mark.parametrize("problem", [unicycle, disc_with_a_heading_on_a_circle])
def test_angle_after_a_million_turns_does_not_change_the_motion(problem):
    system, q0, v0 = problem()

    @jax.jit
    def run(q):
        y0 = nhjax.initial_state(system, q, v0, project=True)
        sol = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y0, dt=0.1, num_steps=100)
        return jax.tree.map(lambda x: x[-1], sol.ys)

    far = jax.tree.map(lambda x: x.at[-1].add(2 * np.pi * 10**6), q0)
    if isinstance(q0, tuple):
        far = (q0[0], far[1])
    # The angle of the first turn that is equivalent to the rounded angle in `far`.
    near = system.manifold.wrapped(far, jax.tree.map(jnp.zeros_like, far))
    of_far, of_near = run(far), run(near)
    np.testing.assert_allclose(of_far.v, of_near.v, rtol=0, atol=1e-13)
    np.testing.assert_allclose(of_far.p, of_near.p, rtol=0, atol=1e-13)
    difference = jax.tree.map(
        lambda end, start, other, began: (end - start) - (other - began),
        *(of_far.q, far, of_near.q, near),
    )
    # An angle of a million turns is rounded to 9e-10.
    assert np.max(np.abs(ravel_pytree(difference)[0])) < 1e-9
