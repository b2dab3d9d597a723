from collections.abc import Callable
from functools import reduce
from itertools import accumulate
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, DTypeLike, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._errors import ShapeError
from ._group import AbstractLieGroup


Element = tuple[PyTree[Array], ...]
Vector = Float[Array, " n"]


class ProductGroup(AbstractLieGroup):
    """The direct product of Lie groups, which are called its factors.

    An element is a tuple of elements, one for each factor. A vector of the Lie algebra
    or of its dual is the concatenation of the factors' vectors. A factor can itself be
    a product.

    **Arguments:**

    - `factors`: the groups, at least one, as positional arguments.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> group = nhjax.ProductGroup(nhjax.Euclidean(2), nhjax.SO3())
        >>> position, attitude = group.retract(jnp.arange(5.0))
        >>> position.shape, attitude.shape
        ((2,), (4,))
    """

    factors: tuple[AbstractLieGroup, ...]

    def __init__(self, *factors: AbstractLieGroup):
        self.factors = factors

    def __check_init__(self):
        _check_factors(self.factors)

    @property
    def dim(self) -> int:
        """Return the dimension of the product, the sum of the factors' dimensions."""
        return sum(group.dim for group in self.factors)

    @property
    def is_flat(self) -> bool:
        """Return whether all factors are flat."""
        return all(group.is_flat for group in self.factors)

    def identity(self, dtype: DTypeLike | None = None) -> Element:
        """Return the tuple of the factors' identities."""
        return tuple(group.identity(dtype) for group in self.factors)

    def check(self, q: Element, name: str = "q") -> Element:
        """Return `q`, or raise a `ShapeError` if it is not a tuple of elements."""
        if not isinstance(q, tuple) or len(q) != len(self.factors):
            kinds = ", ".join(type(group).__name__ for group in self.factors)
            raise ShapeError(
                f"`{name}` must be a tuple of {len(self.factors)} elements, one for "
                f"each factor of ProductGroup({kinds}), got {eqx.tree_pformat(q)}."
            )
        for k, (group, part) in enumerate(zip(self.factors, q, strict=True)):
            group.check(part, f"{name}[{k}]")
        return q

    def in_chart(self, xi: Vector) -> BoolScalar:
        """Return whether every factor's vector lies in that factor's chart."""
        inside = self._map(lambda group, x: group.in_chart(x), xi)
        return reduce(jnp.logical_and, inside)

    def distance_to_group(self, q: Element) -> FloatScalar:
        """Compute the largest distance of a part of `q` from its factor."""
        return reduce(
            jnp.maximum, self._map(lambda group, g: group.distance_to_group(g), q)
        )

    def normalise(self, q: Element) -> Element:
        """Normalise every factor's part of `q`."""
        return self._tuple(lambda group, g: group.normalise(g), q)

    def compose(self, g: Element, h: Element) -> Element:
        """Compute the tuple of the factors' products."""
        return self._tuple(lambda group, g, h: group.compose(g, h), g, h)

    def inverse(self, g: Element) -> Element:
        """Compute the tuple of the factors' inverses."""
        return self._tuple(lambda group, g: group.inverse(g), g)

    def retract(self, xi: Vector) -> Element:
        """Compute the tuple of the factors' τ(ξ)."""
        return self._tuple(lambda group, x: group.retract(x), xi)

    def local(self, g: Element) -> Vector:
        """Compute the concatenated vectors τ⁻¹(g) of the factors."""
        return self._vector(lambda group, g: group.local(g), g)

    def act(self, g: Element, xi: Vector) -> Element:
        """Compute the tuple of the factors' g τ(ξ)."""
        return self._tuple(lambda group, g, x: group.act(g, x), g, xi)

    def act_back(self, g: Element, xi: Vector) -> Element:
        """Compute the tuple of the factors' g τ(ξ)⁻¹."""
        return self._tuple(lambda group, g, x: group.act_back(g, x), g, xi)

    def no_compensation(self, q: Element) -> Element:
        """Return the tuple of the factors' initial compensations of `advance`."""
        return self._tuple(lambda group, g: group.no_compensation(g), q)

    def wrapped(self, q: Element, compensation: Element) -> Element:
        """Return `q` with the angles of every factor reduced to one turn."""
        return self._tuple(lambda group, *of: group.wrapped(*of), q, compensation)

    def advance(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Advance each factor's part of q, with its own compensation."""
        return self._pair(lambda group, *of: group.advance(*of), q, xi, compensation)

    def advance_across(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Advance each factor's part of q from -ξ to ξ in the chart of this factor."""
        return self._pair(
            lambda group, *of: group.advance_across(*of), q, xi, compensation
        )

    def matrix(self, g: Element) -> Float[Array, "k k"]:
        """Return the block-diagonal matrix of the factors' matrices of g."""
        return block_diag(*self._map(lambda group, g: group.matrix(g), g))

    def hat(self, xi: Vector) -> Float[Array, "k k"]:
        """Return the block-diagonal matrix of the factors' matrices ξ^."""
        return block_diag(*self._map(lambda group, x: group.hat(x), xi))

    def tangent(self, g: Element, eta: Vector) -> Element:
        """Compute the tuple of the factors' tangents T L_g η."""
        return self._tuple(lambda group, g, y: group.tangent(g, y), g, eta)

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """Apply every factor's dτ to its parts of the vectors."""
        return self._vector(lambda group, x, y: group.dtau(x, y), xi, eta)

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """Apply every factor's dτ⁻¹ to its parts of the vectors."""
        return self._vector(lambda group, x, y: group.dtau_inv(x, y), xi, eta)

    def dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Apply every factor's dτ^* to its parts of the vectors."""
        return self._vector(lambda group, x, m: group.dtau_dual(x, m), xi, mu)

    def right_dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Apply every factor's (Ad_{τ(ξ)} dτ_ξ)^* to its parts of the vectors."""
        return self._vector(lambda group, x, m: group.right_dtau_dual(x, m), xi, mu)

    def dtau_inv_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Apply every factor's (dτ⁻¹)^* to its parts of the vectors."""
        return self._vector(lambda group, x, m: group.dtau_inv_dual(x, m), xi, mu)

    def Ad(self, g: Element, eta: Vector) -> Vector:
        """Apply every factor's Ad_g to its part of the vector."""
        return self._vector(lambda group, g, y: group.Ad(g, y), g, eta)

    def Ad_dual(self, g: Element, mu: Vector) -> Vector:
        """Apply every factor's Ad_g^* to its part of the covector."""
        return self._vector(lambda group, g, m: group.Ad_dual(g, m), g, mu)

    def to_end(self, xi: Vector, mu: Vector) -> Vector:
        """Apply every factor's Ad_{τ(ξ)}^* to its part of the covector."""
        return self._vector(lambda group, x, m: group.to_end(x, m), xi, mu)

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Concatenate the factors' changes Ad_{τ(ξ)}^* μ - μ."""
        return self._vector(lambda group, x, m: group.to_end_change(x, m), xi, mu)

    def to_start(self, xi: Vector, mu: Vector) -> Vector:
        """Apply every factor's Ad_{τ(ξ)⁻¹}^* to its part of the covector."""
        return self._vector(lambda group, x, m: group.to_start(x, m), xi, mu)

    def to_start_change(self, xi: Vector, mu: Vector) -> Vector:
        """Concatenate the factors' changes Ad_{τ(ξ)⁻¹}^* μ - μ."""
        return self._vector(lambda group, x, m: group.to_start_change(x, m), xi, mu)

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Apply every factor's ad_ξ to its parts of the vectors."""
        return self._vector(lambda group, x, y: group.ad(x, y), xi, eta)

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Apply every factor's ad_ξ^* to its parts of the vectors."""
        return self._vector(lambda group, x, m: group.ad_dual(x, m), xi, mu)

    def _map(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Call a function with each factor and its parts of the arguments."""
        parts = [a if isinstance(a, tuple) else self._split(a) for a in arguments]
        return [function(*part) for part in zip(self.factors, *parts, strict=True)]

    def _pair(self, function, *arguments) -> tuple[Element, Element]:
        pairs = self._map(function, *arguments)
        return tuple(g for g, _ in pairs), tuple(c for _, c in pairs)

    def _tuple(self, function, *arguments) -> Element:
        return tuple(self._map(function, *arguments))

    def _vector(self, function, *arguments) -> Vector:
        return jnp.concatenate(self._map(function, *arguments))

    def _split(self, vector: Vector) -> list[Array]:
        ends = accumulate(group.dim for group in self.factors)
        return [vector[k - f.dim : k] for k, f in zip(ends, self.factors, strict=True)]


def _check_factors(factors: tuple[object, ...]) -> None:
    if not factors:
        raise ValueError("ProductGroup: pass at least one factor.")
    for k, factor in enumerate(factors):
        if not isinstance(factor, AbstractLieGroup):
            raise TypeError(
                f"ProductGroup: factor {k} must be a Lie group, such as `SO3()` or "
                f"`Euclidean(2)`, got {factor!r}."
            )
