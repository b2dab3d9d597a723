"""Perturbed states, and the rates at which they change, for linear stability."""

import operator
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._system import AbstractMechanicalSystem, linearise, State


Indices = tuple[int, ...]


def perturbed(
    system: AbstractMechanicalSystem, y: State, x: Float[Array, " x"]
) -> tuple[PyTree[Array], Float[Array, " n"]]:
    """Perturb (q, u) of a state by x = (ξ, w), to (q τ(ξ), u + w)."""
    xi, w = jnp.split(x, 2)
    return system.manifold_of(y.q).act(y.q, xi), system.fibre_coordinate(y) + w


def rates_of_change(
    system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
) -> Callable[[Float[Array, " x"]], Float[Array, " x"]]:
    """Make the function x -> (v - v_0 - ad_v₀ ξ, u̇) of perturbations x = (ξ, w).

    Its derivative at zero is that of the equations of motion: in the frame of a body
    that moves with v_0, a perturbation of the configuration changes at the rate
    ξ̇ = δv - ad_v₀ ξ.
    """
    manifold = system.manifold_of(y.q)
    v0 = system.velocity(t, y.q, system.fibre_coordinate(y), args)

    def turning(xi):
        if manifold.is_flat:
            return jnp.zeros_like(xi)
        # ad_v is the transpose of ad*_v.
        _, transposed = jax.vjp(lambda mu: manifold.ad_dual(v0, mu), jnp.zeros_like(xi))
        return transposed(xi)[0]

    def rates(x):
        q, u = perturbed(system, y, x)
        xi = x[: x.shape[0] // 2]
        change = system.velocity(t, q, u, args) - v0 - turning(xi)
        return jnp.concatenate([change, linearise(system, t, q, u, args).acceleration])

    return rates


def indices(name: str, values: Sequence[int], dim: int) -> Indices:
    """Return the indices of coordinates as a tuple, or raise a `ValueError`."""
    try:
        found = tuple(operator.index(value) for value in values)
    except TypeError:
        raise TypeError(
            f"`{name}` must be a sequence of integers, got {values!r}."
        ) from None
    wrong = [i for i in found if not 0 <= i < dim]
    if wrong:
        raise ValueError(
            f"`{name}` has the index {wrong[0]}, but indices of {dim} coordinates go "
            f"from 0 to {dim - 1}."
        )
    if len(set(found)) < len(found):
        raise ValueError(f"`{name}` has an index twice: {found}.")
    return found


def check_independent(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
    positions: Sequence[int] | None,
    velocities: Sequence[int] | None,
) -> tuple[Indices, Indices] | None:
    """Check the choice of independent coordinates; None if none are chosen."""
    if positions is None and velocities is None:
        return None
    if positions is None or velocities is None:
        missing = "positions" if positions is None else "velocities"
        raise ValueError(
            f"Give `positions` and `velocities` together: `{missing}` is missing."
        )
    dim, count = y.p.shape[0], y.multiplier.shape[0]
    chosen = (
        indices("positions", positions, dim),
        indices("velocities", velocities, dim),
    )
    if len(chosen[1]) != dim - count:
        raise ValueError(
            f"`velocities` has {len(chosen[1])} indices, but {dim} velocities with "
            f"{count} constraints have {dim - count} independent ones."
        )
    tied = jax.eval_shape(lambda q: system.position_constraint(t, q, args), y.q).size
    if len(chosen[0]) > dim - tied:
        raise ValueError(
            f"`positions` has {len(chosen[0])} indices, but {dim} coordinates with "
            f"{tied} holonomic constraints have {dim - tied} independent ones."
        )
    return chosen
