"""Unit quaternions (w, x, y, z) as rotations of space."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


Quaternion = Float[Array, "4"]
Vector3 = Float[Array, "3"]


def dot(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """a·b."""
    # A matrix product would not be fused with what surrounds it.
    return jnp.sum(a * b)


def cross(a: Vector3, b: Vector3) -> Vector3:
    """a × b."""
    # Shifts of whole vectors make a third of the operations of nine scalars.
    return _shift(a * _shift(b) - _shift(a) * b)


def _shift(v):
    return jnp.concatenate([v[1:], v[:1]])


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """The product p ∘ q."""
    vector = p[:1] * q[1:] + q[:1] * p[1:] + cross(p[1:], q[1:])
    return jnp.concatenate([p[:1] * q[:1] - dot(p[1:], q[1:]), vector])


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse of a unit quaternion."""
    return jnp.concatenate([q[:1], -q[1:]])


def rotate(q: Quaternion, v: Vector3) -> Vector3:
    """R(q) v."""
    return v + rotation_change(q, v)


def rotation_change(q: Quaternion, v: Vector3) -> Vector3:
    """R(q) v - v, without cancellation."""
    twice = 2 * cross(q[1:], v)
    return q[:1] * twice + cross(q[1:], twice)


def cross_matrix(v: Vector3) -> Float[Array, "3 3"]:
    """The matrix of v ×."""
    return jax.vmap(lambda e: cross(v, e), out_axes=1)(jnp.eye(3, dtype=v.dtype))


def rotation_matrix(q: Quaternion) -> Float[Array, "3 3"]:
    """R(q)."""
    return jax.vmap(lambda e: rotate(q, e), out_axes=1)(jnp.eye(3, dtype=q.dtype))
