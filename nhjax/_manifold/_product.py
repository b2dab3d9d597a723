from collections.abc import Callable
from functools import reduce
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, DTypeLike, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._errors import ShapeError
from ._abstract import AbstractLieGroup


Element = tuple[PyTree[Array], ...]
Vector = Float[Array, " n"]


class ProductGroup(AbstractLieGroup):
    """The direct product of groups: a tuple of elements, factor by factor.

    Vectors of the Lie algebra and its dual are those of the factors, concatenated.
    Factors may themselves be products.

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
        if not self.factors:
            raise ValueError("ProductGroup: give at least one factor.")
        for k, factor in enumerate(self.factors):
            if not isinstance(factor, AbstractLieGroup):
                raise TypeError(
                    f"ProductGroup: factor {k} must be a Lie group, such as `SO3()` or "
                    f"`Euclidean(2)`, got {factor!r}."
                )

    @property
    def dim(self) -> int:
        """The sum of the dimensions."""
        return sum(group.dim for group in self.factors)

    @property
    def is_flat(self) -> bool:
        """Whether all factors are flat."""
        return all(group.is_flat for group in self.factors)

    def identity(self, dtype: DTypeLike | None = None) -> Element:
        """The tuple of identities."""
        return tuple(group.identity(dtype) for group in self.factors)

    def check(self, q: Element, name: str = "q") -> Element:
        """`q`, or a `ShapeError` if it is not a tuple of the factors' elements."""
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
        """Whether every factor is in its chart."""
        return reduce(
            jnp.logical_and, self._each(lambda group, x: group.in_chart(x), xi)
        )

    def distance_to_group(self, q: Element) -> FloatScalar:
        """The largest of the factors' defects."""
        return reduce(
            jnp.maximum, self._each(lambda group, g: group.distance_to_group(g), q)
        )

    def normalise(self, q: Element) -> Element:
        """Every factor normalised."""
        return self._tuple(lambda group, g: group.normalise(g), q)

    def compose(self, g: Element, h: Element) -> Element:
        """The tuple of products."""
        return self._tuple(lambda group, g, h: group.compose(g, h), g, h)

    def inverse(self, g: Element) -> Element:
        """The tuple of inverses."""
        return self._tuple(lambda group, g: group.inverse(g), g)

    def retract(self, xi: Vector) -> Element:
        """The tuple of retractions."""
        return self._tuple(lambda group, x: group.retract(x), xi)

    def local(self, g: Element) -> Vector:
        """The factors' τ⁻¹."""
        return self._vector(lambda group, g: group.local(g), g)

    def act(self, g: Element, xi: Vector) -> Element:
        """The tuple of g τ(ξ)."""
        return self._tuple(lambda group, g, x: group.act(g, x), g, xi)

    def no_compensation(self, q: Element) -> Element:
        """The factors' compensations."""
        return self._tuple(lambda group, g: group.no_compensation(g), q)

    def advance(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Every factor advanced."""
        pairs = self._each(
            lambda group, g, x, c: group.advance(g, x, c), q, xi, compensation
        )
        return tuple(g for g, _ in pairs), tuple(c for _, c in pairs)

    def matrix(self, g: Element) -> Float[Array, "k k"]:
        """The factors' matrices as blocks."""
        return block_diag(*self._each(lambda group, g: group.matrix(g), g))

    def hat(self, xi: Vector) -> Float[Array, "k k"]:
        """The factors' matrices as blocks."""
        return block_diag(*self._each(lambda group, x: group.hat(x), xi))

    def tangent(self, g: Element, eta: Vector) -> Element:
        """The tuple of tangents."""
        return self._tuple(lambda group, g, y: group.tangent(g, y), g, eta)

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """The factors' dτ."""
        return self._vector(lambda group, x, y: group.dtau(x, y), xi, eta)

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """The factors' dτ⁻¹."""
        return self._vector(lambda group, x, y: group.dtau_inv(x, y), xi, eta)

    def ddtau(self, xi: Vector, eta: Vector, delta: Vector) -> Vector:
        """The factors' ddτ."""
        return self._vector(lambda group, x, y, d: group.ddtau(x, y, d), xi, eta, delta)

    def dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """The factors' dτ^*."""
        return self._vector(lambda group, x, m: group.dtau_dual(x, m), xi, mu)

    def dtau_inv_dual(self, xi: Vector, mu: Vector) -> Vector:
        """The factors' (dτ⁻¹)^*."""
        return self._vector(lambda group, x, m: group.dtau_inv_dual(x, m), xi, mu)

    def ddtau_dual(self, xi: Vector, eta: Vector, mu: Vector) -> Vector:
        """The factors' ddτ^*."""
        return self._vector(
            lambda group, x, y, m: group.ddtau_dual(x, y, m), xi, eta, mu
        )

    def Ad(self, g: Element, eta: Vector) -> Vector:
        """The factors' Ad."""
        return self._vector(lambda group, g, y: group.Ad(g, y), g, eta)

    def Ad_dual(self, g: Element, mu: Vector) -> Vector:
        """The factors' Ad^*."""
        return self._vector(lambda group, g, m: group.Ad_dual(g, m), g, mu)

    def to_end(self, xi: Vector, mu: Vector) -> Vector:
        """The factors' Ad_{τ(ξ)}^*."""
        return self._vector(lambda group, x, m: group.to_end(x, m), xi, mu)

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """The factors' Ad_{τ(ξ)}^* μ - μ."""
        return self._vector(lambda group, x, m: group.to_end_change(x, m), xi, mu)

    def to_start(self, xi: Vector, mu: Vector) -> Vector:
        """The factors' Ad_{τ(ξ)⁻¹}^*."""
        return self._vector(lambda group, x, m: group.to_start(x, m), xi, mu)

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """The factors' ad."""
        return self._vector(lambda group, x, y: group.ad(x, y), xi, eta)

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """The factors' ad^*."""
        return self._vector(lambda group, x, m: group.ad_dual(x, m), xi, mu)

    def _each(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """`function` of every factor and its parts of elements and of vectors."""
        parts = [a if isinstance(a, tuple) else self._split(a) for a in arguments]
        return [function(*part) for part in zip(self.factors, *parts, strict=True)]

    def _tuple(self, function, *arguments) -> Element:
        return tuple(self._each(function, *arguments))

    def _vector(self, function, *arguments) -> Vector:
        return jnp.concatenate(self._each(function, *arguments))

    def _split(self, vector):
        parts, start = [], 0
        for group in self.factors:
            parts.append(vector[start : start + group.dim])
            start += group.dim
        return parts
