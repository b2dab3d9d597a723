from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._errors import ShapeError
from ._arguments import check_type


class State(eqx.Module):
    """The state of a mechanical system at one time, or a trajectory of them.

    - `q`: the configuration, shape (n,); on a group an element, on a product of groups
        a tuple of elements.
    - `v`: the velocity, shape (n,); on a group the body velocity.
    - `p`: the momentum, shape (n,), with p = D2L(t, q, v) or v = D2H(t, q, p).
    - `multiplier`: shape (m + k,): λ of the m nonholonomic constraints, then ν of the k
        holonomic ones. The reaction on the system is λᵀ D2Φ + νᵀ L_q^* DΓ, with ♭_H D2Ψ
        in place of D2Φ for a Hamiltonian system.

    Make one with `nhjax.initial_state`, which sees to it that the four agree.
    """

    q: PyTree[Array]
    v: Float[Array, " n"]
    p: Float[Array, " n"]
    multiplier: Float[Array, " l"]


def check_time_and_state(function: str, t: Any, y: Any, first: str = "") -> None:
    """Raise if `y` is not one `State`, or if `t` is a `State`."""
    advice = f"Call it as `{function}({first}t, y, args)`."
    if isinstance(t, State):
        raise TypeError(f"`t` must be a time, got an nhjax.State. {advice}")
    check_type("y", y, State, advice)
    if jnp.ndim(y.p) > 1:
        raise ShapeError(
            f"`y.p` has shape {y.p.shape}, but the state at one time has shape (n,). "
            f"For a trajectory use `jax.vmap` over `t` and `y`."
        )
