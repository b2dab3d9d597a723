"""Elements of groups whose poses carry their frames."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ._abstract import AbstractLieGroup
from ._framed_pose import FramedPose
from ._product import ProductGroup
from ._se2 import SE2


def framed(group: AbstractLieGroup, q: PyTree[Array]) -> PyTree[Array]:
    """Return an element with the frames of those parts that are poses of the plane.

    The methods `act`, `act_back` and `tangent` of the group take it in the place of the
    element. Where no part is such a pose it is the element itself.
    """
    # A subclass may have methods of its own, which know nothing of frames.
    if type(group) is SE2:
        return FramedPose(q, jnp.cos(q[2]), jnp.sin(q[2]))
    if type(group) is ProductGroup:
        return tuple(map(framed, group.factors, q))
    return q


def is_framed(q: Any) -> bool:
    """Tell whether this is a pose with its frame."""
    return isinstance(q, FramedPose)


def unframed(q: PyTree[Array]) -> PyTree[Array]:
    """Return an element of a group without the frames of the poses that it is made of.

    These are the elements that functions of a user are called with.
    """
    return jax.tree.map(lambda x: x.pose if is_framed(x) else x, q, is_leaf=is_framed)
