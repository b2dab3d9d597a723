"""Ten random systems: mass matrices that depend on the position, both kinds of
constraint, forces that depend on time and velocity, and groups.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

import nhjax


class Shape(NamedTuple):
    """The shape of a system.

    - `n`, `m`, `k`: the numbers of coordinates, nonholonomic constraints and holonomic
        constraints.
    - `driven`: whether the system has a force.
    - `manifold`: its group, or None for a vector space.
    """

    name: str
    n: int
    m: int = 0
    k: int = 0
    driven: bool = False
    manifold: nhjax.AbstractLieGroup | None = None


def shapes() -> list[Shape]:
    """Return the shapes of the ten systems."""
    plane = nhjax.Euclidean(2)
    return [
        Shape("random 2", 2),
        Shape("random 3, m = 1", 3, 1),
        Shape("random 4, k = 1", 4, 0, 1, driven=True),
        Shape("random 5, m = 2", 5, 2, driven=True),
        Shape("random 6, m = k = 1", 6, 1, 1),
        Shape("random 7, k = 2", 7, 0, 2, driven=True),
        Shape("random 8, m = k = 2", 8, 2, 2, driven=True),
        Shape("random SO(3), m = 1", 3, 1, manifold=nhjax.SO3()),
        Shape(
            "random SE(2) x R², m = 2",
            5,
            2,
            driven=True,
            manifold=nhjax.ProductGroup(nhjax.SE2(), plane),
        ),
        Shape("random SE(3), k = 1", 6, 0, 1, driven=True, manifold=nhjax.SE3()),
    ]


def random_system(
    shape: Shape, seed: int
) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a random system of a shape, and a consistent state of this system."""
    generator = np.random.default_rng(seed)
    n, m, k = shape.n, shape.m, shape.k
    manifold = nhjax.Euclidean(n) if shape.manifold is None else shape.manifold
    start = manifold.identity(float)
    size = coordinates(start).size

    def matrix(rows: int, columns: int, scale: float = 1.0) -> Array:
        entries = generator.standard_normal((rows, columns))
        return jnp.asarray(scale * entries / np.sqrt(columns))

    mixing, bending = matrix(n, n, 0.4), matrix(n, size)
    pull, waves = matrix(size, size), matrix(3, size, 2.0)
    slopes, turning = matrix(m, n), matrix(m, size)
    bowls, tilt = [matrix(size, size) for _ in range(k)], matrix(k, size)
    friction = 0.1 * jnp.asarray(generator.random(n))

    def lagrangian(t, q, v, args):
        x = coordinates(q)
        w = v * (1 + 0.3 * jnp.sin(bending @ x)) + mixing @ v
        potential = 0.5 * jnp.sum((pull @ x) ** 2) + jnp.sum(jnp.cos(waves @ x))
        return 0.5 * v @ v + 0.5 * w @ w - potential

    def nonholonomic(t, q, v, args):
        return (slopes @ v) + 0.5 * jnp.sin(turning @ coordinates(q)) * v[0]

    def level(q):
        x = coordinates(q)
        squares = jnp.stack([0.5 * jnp.sum((bowl @ x) ** 2) for bowl in bowls])
        return squares + tilt @ x

    def force(t, q, v, args):
        return 0.3 * jnp.sin(2 * t) * jnp.cos(jnp.arange(n)) - friction * v

    q = manifold.act(start, jnp.asarray(0.3 * generator.standard_normal(n)))
    # The holonomic constraint is the level set of the functions `level` through q.
    height = level(q) if k else 0.0
    system = nhjax.LagrangianSystem(
        lagrangian,
        nonholonomic=nonholonomic if m else None,
        holonomic=(lambda t, q, args: level(q) - height) if k else None,
        force=force if shape.driven else None,
        manifold=shape.manifold,
    )
    v = jnp.asarray(generator.standard_normal(n))
    return system, nhjax.initial_state(system, q, v, project=True)


def coordinates(q: PyTree[Array]) -> Array:
    """Return the numbers of a configuration as a vector.

    In a pose of SE(2), the cosine and the sine replace the angle: nhjax may subtract
    full turns from the angle, so that functions of it must have the period 2π.
    """
    if not isinstance(q, tuple):
        return q.reshape(-1)
    (x, y, angle), point = q
    pose = jnp.stack([x, y, jnp.cos(angle), jnp.sin(angle)])
    return jnp.concatenate([pose, point])


def random_systems(
    seed: int = 20,
) -> dict[str, Callable[[], tuple[nhjax.LagrangianSystem, nhjax.State]]]:
    """Return the ten systems by their names."""
    return {
        shape.name: lambda shape=shape, k=k: random_system(shape, seed + k)
        for k, shape in enumerate(shapes())
    }
