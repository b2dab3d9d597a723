"""The interface of a configuration manifold: a Lie group with a retraction.

`AbstractLieGroup` derives every tangent map by automatic differentiation from a few
basic maps. `AbstractMotionGroup` adds shorter formulas for groups whose retraction
satisfies τ(-ξ) = τ(ξ)⁻¹.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._errors import ShapeError


Element = PyTree[Array]
Vector = Float[Array, " n"]


class AbstractLieGroup(eqx.Module):
    """A configuration manifold: a Lie group G with a retraction τ: 𝔤 -> G.

    The stage equations of a step are written in a chart y -> g_o τ(y), whose origin g_o
    is in the middle or at the start of the step (paper, section 5). Velocities and
    momenta are left-trivialised: they are vectors of 𝔤 and 𝔤*.

    To define your own group, write a subclass with `dim`, `identity`, `check`,
    `compose`, `inverse`, `retract` and `local`. All other methods, except `matrix` and
    `hat`, follow from these by automatic differentiation, and can be overridden with
    closed forms. An element is a pytree of arrays. The retraction must satisfy τ(0) = e
    and dτ_0 = I.
    """

    @property
    @abstractmethod
    def dim(self) -> int:
        """Return the dimension n of the group."""

    @abstractmethod
    def identity(self, dtype: DTypeLike | None = None) -> Element:
        """Return the identity element e."""

    @abstractmethod
    def check(self, q: Element, name: str = "q") -> Element:
        """Return `q`, or raise a `ShapeError` if it cannot be an element.

        The error message refers to the element by `name`.
        """

    @abstractmethod
    def compose(self, g: Element, h: Element) -> Element:
        """Compute the product g h of two elements."""

    @abstractmethod
    def inverse(self, g: Element) -> Element:
        """Compute the inverse element g⁻¹."""

    @abstractmethod
    def retract(self, xi: Vector) -> Element:
        """Compute the element τ(ξ) from a vector ξ of the Lie algebra."""

    @abstractmethod
    def local(self, g: Element) -> Vector:
        """Compute τ⁻¹(g), the vector ξ with τ(ξ) = g, for g near the identity."""

    @property
    def is_flat(self) -> bool:
        """Return whether dτ = I and Ad = I everywhere, as on a vector space.

        The step equations then omit both maps.
        """
        return False

    def in_chart(self, xi: Vector) -> BoolScalar:
        """Return whether τ is invertible around ξ, with a margin."""
        return jnp.asarray(True)

    def distance_to_group(self, q: Element) -> FloatScalar:
        """Compute the distance of the values in `q` from the group."""
        return jnp.zeros((), _dtype(q))

    def normalise(self, q: Element) -> Element:
        """Return the element of the group nearest to `q`."""
        return q

    # A user's group may omit the two methods below. The integrators do not call them,
    # and they do not follow from the other methods.

    def matrix(self, g: Element) -> Float[Array, "k k"]:
        """Return the matrix that represents the element g."""
        raise NotImplementedError(_no_matrix(self, "matrix"))

    def hat(self, xi: Vector) -> Float[Array, "k k"]:
        """Return ξ^, the matrix that represents a vector of the Lie algebra."""
        raise NotImplementedError(_no_matrix(self, "hat"))

    def act(self, g: Element, xi: Vector) -> Element:
        """Compute g τ(ξ), the end of the motion ξ that starts at g."""
        return self.compose(g, self.retract(xi))

    def act_back(self, g: Element, xi: Vector) -> Element:
        """Compute g τ(ξ)⁻¹, the start of the motion ξ that ends at g."""
        return self.compose(g, self.inverse(self.retract(xi)))

    def no_compensation(self, q: Element) -> Element:
        """Return the initial compensation of `advance`, which is zero."""
        return jax.tree.map(jnp.zeros_like, q)

    def wrapped(self, q: Element, compensation: Element) -> Element:
        """Return `q` with its angles reduced to one turn.

        The functions of a system are called with this element. An angle that has grown
        over many turns is replaced by the equivalent angle between -π and π, plus
        the compensation, because a smaller number has a smaller rounding error.
        """
        return q

    def advance(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Compute q τ(ξ) and the compensation, the accumulated rounding error.

        The next call adds the compensation, so that rounding errors do not grow over
        many steps. A group without compensated summation returns the compensation
        unchanged.
        """
        return self.act(q, xi), compensation

    def advance_across(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Compute q τ(-ξ)⁻¹ τ(ξ) and its compensation.

        In the chart, q moves from -ξ to ξ.
        """
        return self.advance(self.act_back(q, -xi), xi, compensation)

    def tangent(self, g: Element, eta: Vector) -> Element:
        """Compute T L_g η, the derivative of ε -> g τ(εη) at ε = 0, shaped like g."""
        return _jvp(lambda z: self.act(g, z), jnp.zeros_like(eta), eta)

    def left_gradient(self, function: Callable[[Element], Array], q: Element) -> Vector:
        """Compute L_q^* D f(q), the gradient of ξ -> f(q τ(ξ)) at ξ = 0."""
        zero = jnp.zeros(self.dim, _dtype(q))
        return transpose(lambda eta: self.tangent(q, eta), zero)(jax.grad(function)(q))

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ξ η, the left-trivialised tangent: D τ(ξ) η = τ(ξ) (dτ_ξ η)^."""
        back = self.inverse(self.retract(xi))
        return _jvp(lambda z: self.local(self.compose(back, self.retract(z))), xi, eta)

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ξ⁻¹ η, the inverse of the left-trivialised tangent."""
        columns = jax.vmap(lambda e: self.dtau(xi, e), out_axes=1)
        return jnp.linalg.solve(columns(jnp.eye(self.dim, dtype=xi.dtype)), eta)

    def ddtau(self, xi: Vector, eta: Vector, delta: Vector) -> Vector:
        """Compute the second tangent ddτ_ξ(η, δ) of τ.

        It is defined by ∂_ξ(dτ_ξ η) δ = dτ_ξ ddτ_ξ(η, δ).
        """
        # For fixed y = dτ_ξ η, the derivative of dτ_ξ⁻¹ y along δ is -ddτ_ξ(η, δ). The
        # inverse is simpler than dτ: for the Cayley map it is a polynomial.
        y = self.dtau(xi, eta)
        return -_jvp(lambda z: self.dtau_inv(z, y), xi, delta)

    def dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Compute dτ_ξ^* μ, for which ⟨dτ_ξ^* μ, η⟩ = ⟨μ, dτ_ξ η⟩."""
        return transpose(lambda eta: self.dtau(xi, eta), mu)(mu)

    def right_dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Compute (Ad_{τ(ξ)} dτ_ξ)^* μ, the dual of the right-trivialised tangent."""
        return self.dtau_dual(xi, self.to_end(xi, mu))

    def dtau_inv_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Compute (dτ_ξ⁻¹)^* μ, the dual of `dtau_inv`."""
        return transpose(lambda eta: self.dtau_inv(xi, eta), mu)(mu)

    def ddtau_dual(self, xi: Vector, eta: Vector, mu: Vector) -> Vector:
        """Compute (ddτ_ξ(η, ·))^* μ, whose pairing with δ is ⟨μ, ddτ_ξ(η, δ)⟩."""
        y = self.dtau(xi, eta)
        return transpose(lambda z: -self.dtau_inv(z, y), xi)(mu)

    def Ad(self, g: Element, eta: Vector) -> Vector:
        """Compute Ad_g η = g η g⁻¹, the adjoint action of the group."""
        back = self.inverse(g)

        def conjugate(z):
            return self.local(self.compose(self.act(g, z), back))

        return _jvp(conjugate, jnp.zeros_like(eta), eta)

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Compute ad_ξ η = [ξ, η], the bracket of the Lie algebra."""
        return _jvp(lambda z: self.Ad(self.retract(z), eta), jnp.zeros_like(xi), xi)

    def Ad_dual(self, g: Element, mu: Vector) -> Vector:
        """Compute Ad_g^* μ, for which ⟨Ad_g^* μ, η⟩ = ⟨μ, Ad_g η⟩."""
        return transpose(lambda eta: self.Ad(g, eta), mu)(mu)

    def to_end(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ, the covector μ at g transported to g τ(ξ)."""
        return self.Ad_dual(self.retract(xi), mu)

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ - μ; subclasses may do this without cancellation."""
        return self.to_end(xi, mu) - mu

    def to_start(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)⁻¹}^* μ, the covector μ at g τ(ξ) transported to g."""
        return self.Ad_dual(self.inverse(self.retract(xi)), mu)

    def to_start_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)⁻¹}^* μ - μ; subclasses may do this without cancellation."""
        return self.to_start(xi, mu) - mu

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Compute ad_ξ^* μ, for which ⟨ad_ξ^* μ, η⟩ = ⟨μ, ad_ξ η⟩."""
        return transpose(lambda eta: self.ad(xi, eta), mu)(mu)


class AbstractMotionGroup(AbstractLieGroup):
    """A group of rotations or rigid motions, with τ(-ξ) = τ(ξ)⁻¹."""

    @abstractmethod
    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ - μ, without cancellation."""

    def to_end(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ as the sum of μ and its change."""
        return mu + self.to_end_change(xi, mu)

    def to_start(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(-ξ)}^* μ, which equals Ad_{τ(ξ)⁻¹}^* μ."""
        return self.to_end(-xi, mu)

    def to_start_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(-ξ)}^* μ - μ, without cancellation."""
        return self.to_end_change(-xi, mu)

    def act_back(self, g: Element, xi: Vector) -> Element:
        """Compute g τ(-ξ), which equals g τ(ξ)⁻¹."""
        return self.act(g, -xi)

    def advance_across(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Compute q τ(ξ) τ(ξ), which equals q τ(-ξ)⁻¹ τ(ξ)."""
        middle, compensation = self.advance(q, xi, compensation)
        return self.advance(middle, xi, compensation)

    def right_dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Compute dτ_{-ξ}^* μ, which equals (Ad_{τ(ξ)} dτ_ξ)^* μ."""
        return self.dtau_dual(-xi, mu)


def transpose(
    function: Callable[[Vector], PyTree[Array]], at: Vector
) -> Callable[[PyTree[Array]], Vector]:
    """Return the transpose of the derivative of a function at the point `at`."""
    _, pullback = jax.vjp(function, at)
    return lambda covector: pullback(covector)[0]


def check_shape(
    q: Element, shape: tuple[int, ...], group: str, name: str, numbers: str = ""
) -> Element:
    """Return `q`, or raise a `ShapeError` if it is not one array of this shape.

    The message names the `numbers` of which an element consists.
    """
    if numbers:
        numbers = f", {numbers}"
    if isinstance(q, (tuple, list, dict)):
        raise ShapeError(
            f"`{name}` is {eqx.tree_pformat(q)}, but the manifold {group} needs an "
            f"array of shape {shape}{numbers}."
        )
    if jnp.shape(q) != shape:
        is_batch = jnp.ndim(q) > len(shape)
        advice = " For many trajectories use `jax.vmap`." if is_batch else ""
        raise ShapeError(
            f"`{name}` has shape {jnp.shape(q)}, but the manifold {group} needs shape "
            f"{shape}{numbers}.{advice}"
        )
    return q


def homogeneous(
    corner: Float[Array, "n n"], column: Float[Array, " n"], last: float
) -> Float[Array, "n+1 n+1"]:
    """Assemble the matrix [[corner, column], [0, last]] in homogeneous coordinates.

    It represents a motion if last = 1, and a velocity if last = 0.
    """
    rows = jnp.concatenate([corner, column[:, None]], axis=1)
    n = column.shape[0]
    row = np.zeros((1, n + 1), column.dtype)
    row[0, n] = last
    return jnp.concatenate([rows, row])


def _jvp(function, at, direction):
    return jax.jvp(function, (at,), (direction,))[1]


def _dtype(q):
    return jnp.result_type(*jax.tree.leaves(q))


def _no_matrix(group, method):
    name = type(group).__name__
    return (
        f"{name} has no matrix representation. The integrators do not need one; to "
        f"add one, define `{name}.{method}`."
    )
