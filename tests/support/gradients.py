"""Gradients along one direction, compared with differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from support.helpers import (
    central_difference,
    direction,
    dot,
    moved,
)


STEPS = 200


def assert_gradient(loss, given, epsilon=1e-4, rtol=1e-8):
    """Compare the gradient along one direction of `given` with differences."""
    program, along = jax.jit(jax.value_and_grad(loss)), direction(given)
    # `moved` by 0 makes the types as strong as below, so that one program suffices.
    _, gradient = program(moved(given, along, 0.0))
    expected = central_difference(
        lambda eps: program(moved(given, along, eps))[0], epsilon
    )
    assert abs(expected) > 1e-3
    np.testing.assert_allclose(dot(gradient, along), expected, rtol=rtol)


def split(example):
    """The variables to differentiate an example in, and a function that rebuilds it.

    The configuration moves in the chart around that of the given example.
    """
    rest = eqx.tree_at(lambda e: e.q0, example, None)
    parameters, fixed = eqx.partition(rest, eqx.is_inexact_array)
    manifold = example.system.manifold_of(example.q0)
    given = {"parameters": parameters, "xi": jnp.zeros(manifold.dim)}

    def joined(given):
        q0 = manifold.act(example.q0, given["xi"])
        moved = eqx.combine(given["parameters"], fixed)
        return eqx.tree_at(lambda e: e.q0, moved, q0, is_leaf=lambda x: x is None)

    return given, joined
