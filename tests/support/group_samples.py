"""Groups, and vectors and elements at every scale of their charts."""

from functools import cache
from math import sqrt

import hypothesis
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import scipy.linalg
from jax.flatten_util import ravel_pytree

from nhjax._manifold import (
    Cayley,
    Euclidean,
    Exponential,
    ProductGroup,
    SE2,
    SE3,
    SO2,
    SO3,
)


RETRACTIONS = (Cayley(), Exponential())
SIMPLE = [group(r) for r in RETRACTIONS for group in (SO2, SO3, SE2, SE3)]
MIXED = ProductGroup(SO3(), Euclidean(2), ProductGroup(SE2(Exponential()), SO2()))
GROUPS = [*SIMPLE, Euclidean(3), MIXED]

# Angles: zero, tiny, on both sides of each change of formula, and at the edge of the
# chart. The series in θ² is used up to 2; some functions are evaluated at θ²/4.
SWITCHES = [sqrt(2), 2 * sqrt(2)]
INSIDE = [0.0, 1e-12, 1e-8, 1e-4, 0.01, 0.3, 1.0, 3.0]
INSIDE += [s * (1 + e) for s in SWITCHES for e in (-1e-9, 1e-9)]
EDGE = {Cayley: [20.0, 66.0], Exponential: [4.5, 6.2]}


def name_of(group):
    retraction = getattr(group, "retraction", None)
    suffix = f"-{type(retraction).__name__}" if retraction else ""
    return type(group).__name__ + suffix


def over(groups):
    return pytest.mark.parametrize("group", groups, ids=name_of)


def rotation_part(group):
    """The slice of the algebra vector that turns; the rest translates."""
    return {
        SO2: slice(0, 1), SO3: slice(0, 3), SE2: slice(2, 3), SE3: slice(3, 6)
    }.get(type(group), slice(0, 0))  # fmt: skip


def vectors(group, angles, seed=0):
    """Vectors of the algebra, one for each angle; translations are of order one."""
    if isinstance(group, ProductGroup):
        parts = [vectors(g, angles, seed + k) for k, g in enumerate(group.factors)]
        return np.concatenate(parts, axis=1)
    xi = np.random.default_rng(seed).normal(size=(len(angles), group.dim))
    turning = rotation_part(group)
    norm = np.linalg.norm(xi[:, turning], axis=1, keepdims=True)
    xi[:, turning] *= np.asarray(angles)[:, None] / np.where(norm > 0, norm, 1.0)
    return xi


def chart(group, seed=0):
    """Vectors over the whole chart."""
    edge = EDGE.get(type(getattr(group, "retraction", None)), [])
    return vectors(group, INSIDE + edge, seed)


def directions(group, like, seed):
    return np.random.default_rng(seed).normal(size=(len(like), group.dim))


def elements(group, seed):
    """Elements anywhere in the group, with translations of order one."""
    xi, zeta = vectors(group, np.linspace(0, 2, 16), seed), vectors(group, 16 * [1.0])
    return _elements(group)(xi, zeta)


@cache
def _elements(group):
    return batched(lambda x, z: group.act(group.retract(x), z))


def distance(a, b):
    """The largest difference relative to the size (at least 1) of the values."""
    a, b = ravel_pytree(a)[0], ravel_pytree(b)[0]
    size = np.maximum(1.0, np.max(np.abs(b)))
    return float(np.max(np.abs(a - b)) / size)


def batched(function):
    # Compilation takes most of the time; without optimisation it takes half as long.
    quick = {"xla_backend_optimization_level": 0}
    return jax.jit(jax.vmap(function), compiler_options=quick)


def tau_of_matrix(group, X):
    """τ by its definition on matrices, which may be complex."""
    if isinstance(group.retraction, Exponential):
        return scipy.linalg.expm(X)
    identity = np.eye(len(X))
    return np.linalg.solve(identity - X / 2, identity + X / 2)


def seeded(test):
    """Run the test with random directions, at every scale of `INSIDE` and the edge."""
    drawn = hypothesis.given(seed=st.integers(0, 2**20))(test)
    return hypothesis.settings(max_examples=5, deadline=None)(drawn)


@cache
def compiled(group, *names):
    """The composition of named maps of a group over a batch; the last acts first."""
    *outer, inner = (getattr(group, name) for name in names)

    def composition(x, y):
        y = inner(x, y)
        for apply in reversed(outer):
            y = apply(x, y)
        return y

    return batched(composition)
