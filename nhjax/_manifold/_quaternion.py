"""The algebra of unit quaternions (w, x, y, z), which stand for rotations of space."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._bilinear import bilinear, matrix_of


Quaternion = Float[Array, "4"]
Vector3 = Float[Array, "3"]


def dot(a: Float[Array, " n"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """Compute the scalar product a·b of two vectors."""
    # A matrix product would not be fused with the operations around it.
    return jnp.sum(a * b)


# The coefficients (e_j × e_k)_i of the cross product.
_CROSS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 0, 1)


def _product_tensor() -> np.ndarray:
    """Make the coefficients (1_j ∘ 1_k)_i of the product of quaternions 1, i, j, k."""
    tensor = np.zeros((4, 4, 4))
    tensor[0] = np.diag([1.0, -1.0, -1.0, -1.0])
    tensor[1:, 0, 1:] = tensor[1:, 1:, 0] = np.eye(3)
    tensor[1:, 1:, 1:] = _CROSS
    return tensor


_PRODUCT = _product_tensor()
# The coefficients of ((w, x), v) -> w v + x × v and of ((w, x), v) -> 2 x × v.
_SCALED_AND_TURNED = _PRODUCT[1:, :, 1:]
_TURNED_TWICE = 2 * _SCALED_AND_TURNED * (np.arange(4) > 0)[:, None]


def cross(a: Vector3, b: Vector3) -> Vector3:
    """Compute the cross product a × b."""
    return bilinear(_CROSS, a, b)


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Compute the product p ∘ q of two quaternions."""
    return bilinear(_PRODUCT, p, q)


def multiply_vector(q: Quaternion, v: Vector3) -> Quaternion:
    """Compute the product q ∘ (0, v) of a quaternion and a vector."""
    return bilinear(_PRODUCT[:, :, 1:], q, v)


def conjugate(q: Quaternion) -> Quaternion:
    """Compute the conjugate of a unit quaternion, which is its inverse."""
    return jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype) * q


def rotate(q: Quaternion, v: Vector3) -> Vector3:
    """Compute R(q) v, the vector v rotated by the unit quaternion q."""
    return v + rotation_change(q, v)


def rotation_change(q: Quaternion, v: Vector3) -> Vector3:
    """Compute R(q) v - v, without cancellation."""
    return bilinear(_SCALED_AND_TURNED, q, bilinear(_TURNED_TWICE, q, v))


def cross_matrix(v: Vector3) -> Float[Array, "3 3"]:
    """Return the matrix of the linear map x -> v × x."""
    return matrix_of(_CROSS, v)


def rotation_matrix(q: Quaternion) -> Float[Array, "3 3"]:
    """Compute the rotation matrix R(q) of a unit quaternion."""
    return jax.vmap(lambda e: rotate(q, e), out_axes=1)(jnp.eye(3, dtype=q.dtype))
