"""The base classes and helpers that all examples of the gallery share."""

import abc
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, DTypeLike, PyTree

from .._custom_types import Args, FloatScalarLike
from .._errors import is_traced, ShapeError
from .._initial import initial_state
from .._manifold import AbstractLieGroup
from .._system import LagrangianSystem, parameter as parameter, State


# The Gauss-Legendre rule for one panel (subinterval). The rule is exact to round-off if
# the panel is shorter than the distance to the nearest complex singularity of the
# integrand.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(20)


def coordinates(
    value: ArrayLike | tuple[float, ...] | tuple[tuple[float, ...], ...],
) -> Array:
    """Convert a tuple or an array of coordinates to a floating-point array."""
    array = jnp.asarray(value)
    if not jnp.issubdtype(array.dtype, jnp.inexact):
        array = array.astype(jnp.result_type(float))
    return array


def pair(value: tuple) -> tuple[Array, Array]:
    """Convert an element of a product of two groups to floating-point arrays."""
    first, second = value
    return coordinates(first), coordinates(second)


def require_positive(**parameters: Array) -> None:
    """Raise for a parameter that is not positive, unless it is being traced."""
    for name, value in parameters.items():
        if not is_traced(value) and not np.all(np.asarray(value) > 0):
            raise ValueError(f"`{name}` must be positive, got {value}.")


def require_not_negative(**parameters: Array) -> None:
    """Raise for a parameter that is negative, unless it is being traced."""
    for name, value in parameters.items():
        if not is_traced(value) and not np.all(np.asarray(value) >= 0):
            raise ValueError(f"`{name}` must not be negative, got {value}.")


def require_possible(possible: Array, message: str) -> None:
    """Raise with the message if `possible` is false, unless it is being traced."""
    if not is_traced(possible) and not np.all(np.asarray(possible)):
        raise ValueError(message)


def require_shape(shape: tuple[int, ...], **parameters: Array) -> None:
    """Raise for a parameter whose shape is not `shape`."""
    for name, value in parameters.items():
        if value.shape != shape:
            raise ValueError(f"`{name}` must have shape {shape}, got {value.shape}.")


def require_nonzero(name: str, value: float, consequence: str) -> None:
    """Raise if `value` is 0, because an exact solution divides by it."""
    if value == 0:
        raise ValueError(f"`{name}` must be nonzero, got {value}: {consequence}.")


def require_consistent(name: str, violation: ArrayLike, scale: ArrayLike) -> None:
    """Raise if the data `name` violate a constraint by more than √ε (1 + |scale|).

    Here ε is the machine epsilon, and |scale| the largest absolute value in `scale`. An
    exact solution uses the constraint to eliminate velocities. With data that violate
    the constraint, the formula would silently give the solution for other data.
    """
    largest = np.max(np.abs(np.asarray(violation)))
    sizes = np.asarray(scale)
    tolerance = math.sqrt(jnp.finfo(sizes.dtype).eps) * (1 + np.max(np.abs(sizes)))
    if not largest <= tolerance:
        raise ValueError(
            f"`{name}` violates the constraint by {largest:.3e}; the exact solution "
            "needs consistent initial data."
        )


def given_forces(
    args: Args, shape: tuple[int, ...], dtype: DTypeLike, what: str
) -> Array:
    """Return the forces in `args` as an array, which is zero if `args` is None.

    Raise a `ShapeError` unless the forces have the given shape. `what` describes the
    forces in messages.
    """
    if args is None:
        return jnp.zeros(shape, dtype)
    try:
        forces = jnp.asarray(args, dtype)
    except (TypeError, ValueError):
        # `args` contains something that is not a number, or its parts have different
        # shapes.
        forces = None
    if forces is None or forces.shape != shape:
        raise ShapeError(
            f"`args` must be None or {what}, of shape {shape}, got "
            f"{eqx.tree_pformat(args)}. For many runs use `jax.vmap` over `args`."
        )
    return forces


def on_host(tree: PyTree[Array]) -> PyTree[np.ndarray]:
    """Convert the arrays of `tree` to float64 on the host, for exact solutions."""
    return jax.tree.map(lambda x: np.asarray(x, dtype=np.float64), tree)


def integral(
    integrand: Callable[[np.ndarray], np.ndarray], t: float, rate: float
) -> np.ndarray:
    """Integrate a function of time over [0, t] to round-off.

    `integrand` maps an array of times to values whose last axes are the axes of the
    times; `rate` is the inverse of the shortest time scale on which the values vary.
    """
    panels = math.ceil(abs(t) * rate) + 1
    edges = np.linspace(0.0, t, panels + 1)
    half_width = 0.5 * t / panels
    times = 0.5 * (edges[1:] + edges[:-1])[:, None] + half_width * NODES
    return np.asarray(half_width * np.sum(integrand(times) * WEIGHTS, axis=(-2, -1)))


class AbstractExample(eqx.Module):
    """An example of the gallery: a system with parameters and default initial data.

    On a Lie group, `q` is an element of the group (on a product of groups, a tuple of
    arrays), and `v` is the body velocity.
    """

    q0: eqx.AbstractVar[PyTree[Array]]
    v0: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def lagrangian(self, t: FloatScalarLike, q: Any, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L(t, q, v)."""

    @abc.abstractmethod
    def invariants(self, t: FloatScalarLike, q: Any, v: Array) -> dict[str, Array]:
        """Compute the conserved quantities at one point (q, v), by name."""

    @property
    @abc.abstractmethod
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""

    def energy(self, t: FloatScalarLike, q: Any, v: Array) -> Array:
        """Compute the energy D2L · v - L at one point (q, v)."""
        value, momentum = jax.value_and_grad(self.lagrangian, argnums=2)(t, q, v, None)
        return momentum @ v - value

    def initial_state(
        self, dtype: DTypeLike | None = None, *, args: Args = None
    ) -> State:
        """Create the consistent state at (`q0`, `v0`).

        `dtype` defaults to JAX's default float. Pass the `args` of the run, because the
        multiplier depends on the forces in `args`.
        """
        if dtype is None:
            dtype = jnp.result_type(float)
        q0, v0 = jax.tree.map(lambda x: x.astype(dtype), (self.q0, self.v0))
        return initial_state(self.system, q0, v=v0, args=args)


class AbstractNonholonomicExample(AbstractExample):
    """An example of the gallery with nonholonomic constraints."""

    @abc.abstractmethod
    def constraint(self, t: FloatScalarLike, q: Any, v: Array, args: Args) -> Array:
        """Compute the constraint Φ(t, q, v), a scalar or of shape (m,)."""

    def _consistent_data(self) -> tuple[Any, np.ndarray]:
        """Return (q0, v0) in float64 on the host; raise if v0 is not consistent."""
        time = jnp.asarray(0.0, dtype=self.v0.dtype)
        violation = self.constraint(time, self.q0, self.v0, None)
        require_consistent("v0", violation, self.v0)
        return on_host(self.q0), on_host(self.v0)


class AbstractConstrainedExample(AbstractNonholonomicExample):
    """An example of the gallery with nonholonomic constraints on a vector space."""

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, nonholonomic=self.constraint)


class AbstractConstrainedGroupExample(AbstractNonholonomicExample):
    """An example of the gallery with nonholonomic constraints on a Lie group."""

    @property
    @abc.abstractmethod
    def manifold(self) -> AbstractLieGroup:
        """Return the configuration manifold, with the example's retraction."""

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, nonholonomic=self.constraint, manifold=self.manifold
        )
