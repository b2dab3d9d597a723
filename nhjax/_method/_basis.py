"""The Lagrange basis on the nodes of a tableau and its integral, for dense output.

In x = 2θ - 1 the basis is expanded in Legendre polynomials, ℓ_j(θ) = Σ_n K_nj P_n(x),
with coefficients of order one at any s, where monomials would cancel. Its integral is

    ∫_0^θ ℓ_j = θ K_0j - 2 θ (1 - θ) Σ_{n>=1} K_nj P_n'(x) / (n (n + 1)),

from Legendre's equation ((1 - x²) P_n')' = -n (n + 1) P_n: it is exactly 0 at θ = 0 and
exactly K_0j, the weight b_j of a collocation method, at θ = 1.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ._precision import CONTEXT, to_float64
from ._tableau import lagrange_in_legendre, Tableau


@lru_cache(maxsize=128)
def _coefficients(t: Tableau) -> tuple[np.ndarray, np.ndarray]:
    """Compute K and the rows -2 K_nj / (n (n + 1)), n = 1..s-1, rounded once."""
    s, c = t.stages, t.mp_c
    for i in range(s):
        for j in range(i):
            if abs(c[i] - c[j]) <= t.tolerance:
                raise ValueError(
                    f"c = {t.c.tolist()} has equal entries c_{j + 1} and c_{i + 1}: "
                    "there is no Lagrange basis on these nodes"
                )
    k = lagrange_in_legendre(c)
    integrated = CONTEXT.matrix(s, s)
    for n in range(1, s):
        for j in range(s):
            integrated[n, j] = -2 * k[n, j] / (n * (n + 1))
    return to_float64(k), to_float64(integrated)[1:]


def _floating(theta: ArrayLike) -> Array:
    array = jnp.asarray(theta)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float))


def _combine(polynomials: list[Array], coefficients: np.ndarray) -> Array:
    # Full precision is requested, because the default on a GPU may be TensorFloat-32.
    values = jnp.stack(polynomials, axis=-1)
    return jnp.matmul(
        values,
        jnp.asarray(coefficients, values.dtype),
        precision=jax.lax.Precision.HIGHEST,
    )


def lagrange(t: Tableau, theta: ArrayLike) -> Float[Array, "*batch s"]:
    """Evaluate the Lagrange basis ℓ_1(θ), ..., ℓ_s(θ) on the nodes of a tableau.

    **Arguments:**

    - `t`: a tableau with distinct nodes.
    - `theta`: θ, of any shape; traceable, not restricted to [0, 1].

    **Returns:**

    An array of shape `theta.shape + (s,)` and of the dtype of `theta`.

    **Raises:**

    A `ValueError` if two nodes coincide.
    """
    coefficients, _ = _coefficients(t)
    x = 2 * _floating(theta) - 1
    p = [jnp.ones_like(x), x]
    for n in range(1, t.stages - 1):
        p.append(((2 * n + 1) * x * p[n] - n * p[n - 1]) / (n + 1))
    return _combine(p[: t.stages], coefficients)


def integrated_lagrange(t: Tableau, theta: ArrayLike) -> Float[Array, "*batch s"]:
    """Evaluate the integrals ∫_0^θ ℓ_1, ..., ∫_0^θ ℓ_s of the Lagrange basis.

    Arguments, result and errors are those of `lagrange`.
    """
    coefficients, integrated = _coefficients(t)
    fraction = _floating(theta)
    x = 2 * fraction - 1
    linear = _combine([fraction], coefficients[:1])
    if t.stages == 1:
        return linear
    # P_1', P_2', ...: the Gegenbauer polynomials C^(3/2).
    d = [jnp.ones_like(x), 3 * x]
    for n in range(2, t.stages - 1):
        d.append(((2 * n + 1) * x * d[n - 1] - (n + 1) * d[n - 2]) / n)
    bubble = fraction * (1 - fraction)
    return linear + _combine([bubble * p for p in d[: t.stages - 1]], integrated)
