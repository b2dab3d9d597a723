import equinox as eqx
from jaxtyping import Array, Float, PyTree


class State(eqx.Module):
    """The state of a mechanical system at one time, or a trajectory of them.

    - `q`: the configuration, shape (n,); on a group an element, on a product of groups
        a tuple of elements.
    - `v`: the velocity, shape (n,); on a group the body velocity.
    - `p`: the momentum D2L(t, q, v), shape (n,).
    - `multiplier`: λ, shape (m + k,), nonholonomic constraints first, then holonomic
        ones; the reaction on the system is λᵀ D2Φ.

    Make one with `nhjax.initial_state`, which sees to it that the four agree.
    """

    q: PyTree[Array]
    v: Float[Array, " n"]
    p: Float[Array, " n"]
    multiplier: Float[Array, " l"]
