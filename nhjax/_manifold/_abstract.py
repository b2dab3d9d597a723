from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
from jaxtyping import Array, Float, PyTree


class AbstractLieGroup(eqx.Module):
    """A configuration manifold: a Lie group G with a retraction τ: 𝔤 -> G.

    The stage equations are written on the chart Ξ -> g_k τ(Ξ) around the current
    configuration (paper, section 5). Velocities and momenta are left-trivialised, that
    is, vectors of 𝔤 and 𝔤*.
    """

    @property
    @abstractmethod
    def dim(self) -> int:
        """The dimension of the group."""

    @abstractmethod
    def check(self, q: PyTree[Array]) -> PyTree[Array]:
        """The element `q`, or an exception if it cannot be one of this group."""

    @abstractmethod
    def act(self, q: PyTree[Array], xi: Float[Array, " n"]) -> PyTree[Array]:
        """The element g τ(Ξ)."""

    @abstractmethod
    def advance(
        self,
        q: PyTree[Array],
        xi: Float[Array, " n"],
        compensation: PyTree[Array],
    ) -> tuple[PyTree[Array], PyTree[Array]]:
        """g τ(Ξ) with the rounding error of the sum carried in `compensation`."""

    @abstractmethod
    def no_compensation(self, q: PyTree[Array]) -> PyTree[Array]:
        """The compensation to start `advance` from."""

    @abstractmethod
    def left_gradient(
        self, function: Callable[[PyTree[Array]], Array], q: PyTree[Array]
    ) -> Float[Array, " n"]:
        """L_g^* D f(g), the derivative along ξ -> g τ(ξ) at ξ = 0."""
