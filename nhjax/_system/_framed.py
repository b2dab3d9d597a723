"""Systems whose positions are given together with their frames."""

from typing import TypeVar

import equinox as eqx
import jax
from jaxtyping import Array, PyTree

from .._custom_types import PhaseFunction, PositionFunction
from .._manifold import framed, is_framed, unframed
from ._abstract import AbstractMechanicalSystem
from ._hamiltonian import HamiltonianSystem
from ._lagrangian import LagrangianSystem


S = TypeVar("S", bound=AbstractMechanicalSystem)


def with_frames(system: S, q: PyTree[Array]) -> tuple[S, PyTree[Array]]:
    """Return the system in the same configuration, given with its frames.

    The methods of the system then need no trigonometric functions to turn vectors
    between the frames of the body and of the plane, and may be given positions both
    with frames and without. Its functions are called with positions alone. Where the
    manifold has no frames nothing changes.
    """
    # A subclass may have methods of its own, which know nothing of frames.
    if type(system) not in (LagrangianSystem, HamiltonianSystem):
        return system, q
    position = framed(system.manifold_of(q), q)
    if not any(map(is_framed, jax.tree.leaves(position, is_leaf=is_framed))):
        return system, q
    names = [name for name in system.signatures() if getattr(system, name) is not None]
    functions = [getattr(system, name) for name in names]
    system = eqx.tree_at(
        lambda system: [getattr(system, name) for name in names],
        system,
        [_OfPosition(function) for function in functions],
    )
    return system, position


class _OfPosition(eqx.Module):
    """A function of (t, q, args) or (t, q, u, args), for a q that may have frames."""

    function: PhaseFunction | PositionFunction

    def __call__(self, t, q, *rest):
        return self.function(t, unframed(q), *rest)
