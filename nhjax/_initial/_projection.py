"""The states on the constraints that are nearest to a given one."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import BoolScalar, FloatScalar
from .._numerics import (
    inverse,
    least_norm_inverse,
    least_norm_solve,
    max_norm,
    NEARLY_DEPENDENT,
    root,
)
from .._system import position_scale, velocity_scale


class Nearest(NamedTuple):
    """The result of a search for the nearest point on a constraint.

    - `x`: the point at which the search ended.
    - `found`: whether it is a solution.
    - `jacobian`: the Jacobian of the constraint where the search started.
    """

    x: Float[Array, " n"]
    found: BoolScalar
    jacobian: Float[Array, "m n"]


def project_position(system, t, q, u, args) -> Nearest:
    """Project q onto Γ = 0: find the stationary point of ½ ξᵀ M ξ on Γ(t, q τ(ξ)) = 0.

    M is the mass matrix at (t, q, u).
    """
    manifold = system.manifold_of(q)
    mass = system.metric(t, q, u, args)
    if system.fibre_coordinate_name == "p":
        mass = inverse(mass)

    def gamma(xi):
        return system.position_constraint(t, manifold.act(q, xi), args)

    def sizes(_):
        return max_norm(*jax.tree.leaves(q)), position_scale(system, t, q, args)

    return _nearest(
        mass, gamma, jnp.zeros_like(u), sizes, system.constraints == "redundant"
    )


def project_fibre_coordinate(system, t, q, u, args) -> Nearest:
    """Project u onto Φ = 0: find the stationary point w of ½ (w-u)ᵀ K (w-u) there.

    The constraint is Φ(t, q, w) = 0, and K the metric on the fibre at (t, q, u).
    """

    def phi(w):
        return system.constraint(t, q, w, args)

    def sizes(jacobian):
        return max_norm(u), velocity_scale(system, jacobian, t, q, u, args)

    metric = system.metric(t, q, u, args)
    return _nearest(metric, phi, u, sizes, system.constraints == "redundant")


def _nearest(
    metric: Float[Array, "n n"],
    constraint: Callable[[Float[Array, " n"]], Float[Array, " m"]],
    x: Float[Array, " n"],
    sizes: Callable[[Float[Array, "m n"]], tuple[FloatScalar, Float[Array, " m"]]],
    is_redundant: bool,
) -> Nearest:
    """Find the stationary point y of ½ (y-x)ᵀ K (y-x) on constraint(y) = 0.

    **Arguments:**

    - `metric`: the matrix K.
    - `constraint`: the function that is to vanish.
    - `x`: the point from which the search starts.
    - `sizes`: called as `sizes(jacobian)`, the sizes of y and of the terms of the
        constraint, to which their round-off is proportional.
    - `is_redundant`: whether constraints may follow from each other.
    """
    jacobian = jax.jacrev(constraint)(x)
    size, terms = sizes(jacobian)
    # The round-off of the constraint moves y too. If y is zero, nothing else does.
    reaction = inverse(metric) @ jacobian.T
    invert, solve = inverse, jnp.linalg.solve
    if is_redundant:
        invert = partial(least_norm_inverse, negligible=NEARLY_DEPENDENT**2)
        solve = least_norm_solve
    response = reaction @ invert(jacobian @ reaction)
    scale = size + max_norm(jnp.abs(response) @ terms)

    def stationarity(z):
        y, multiplier = z
        value, pullback = jax.vjp(constraint, y)
        return metric @ (y - x) - pullback(multiplier)[0], value

    solved = root(
        stationarity,
        (x, jnp.zeros_like(constraint(x))),
        jnp.where(jnp.isfinite(scale), scale, size),
        judged=lambda z: z[0],
        solve=solve,
    )
    return Nearest(solved.x[0], solved.converged, jacobian)
