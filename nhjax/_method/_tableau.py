"""Butcher tableaux, computed in 60 digits and rounded to float64 once at the end.

A collocation tableau on nodes c_1 < ... < c_s has

    a_ij = ∫_0^{c_i} ℓ_j(θ) dθ,    b_j = ∫_0^1 ℓ_j(θ) dθ,

where ℓ_j is the Lagrange basis on the nodes (Hairer, Lubich, Wanner, "Geometric
Numerical Integration", II.1.2). The symplectic conjugate is â_ij = b_j (1 - a_ji / b_i)
(ibid., VI.4.1); the conjugate of Lobatto IIIA is Lobatto IIIB.

For dense output, the Lagrange basis is expanded in Legendre polynomials of x = 2θ - 1,
ℓ_j(θ) = Σ_n K_nj P_n(x). The coefficients K_nj are of order one for every s; sums of
monomials would have large terms that cancel. The integral of the basis is

    ∫_0^θ ℓ_j = θ K_0j - 2 θ (1 - θ) Σ_{n>=1} K_nj P_n'(x) / (n (n + 1)),

by Legendre's equation ((1 - x²) P_n')' = -n (n + 1) P_n. The integral is exactly 0 at
θ = 0 and exactly K_0j, the weight b_j of a collocation method, at θ = 1.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float


# mpmath has no static types, because it creates its classes for each context.
Number: TypeAlias = Any
Matrix: TypeAlias = Any


BUILT_IN_TOLERANCE = 1e-40
USER_TOLERANCE = 1e-13


@cache
def context() -> Any:
    """Return the context of all computations with mpmath.

    It is independent of a user's `mpmath.mp.dps`. With 60 digits, order conditions can
    be checked to 1e-40 with 20 digits to spare.
    """
    # mpmath is imported here, because `import nhjax` does not need it, and importing it
    # would take a sixth of the time of `import nhjax`.
    import mpmath

    made = mpmath.MPContext()
    made.dps = 60
    return made


@dataclass(frozen=True, eq=False)
class Tableau:
    """A Runge-Kutta tableau (a, b, c) with its symplectic conjugate â.

    The fields hold mpmath numbers: `mp_a` is an s x s matrix, `mp_b` and `mp_c` are
    lists. An order condition or other identity counts as satisfied if its defect is at
    most `tolerance`. The tolerance bounds the round-off of 60 digits for built-in
    tableaux, and of float64 for a user's tableau. Instances compare and hash by
    identity; the functions that create them are cached.
    """

    mp_a: Matrix
    mp_b: list[Number]
    mp_c: list[Number]
    tolerance: float

    @property
    def stages(self) -> int:
        """Return the number of stages s."""
        return len(self.mp_b)

    @cached_property
    def mp_a_hat(self) -> Matrix:
        """Compute the symplectic conjugate â_ij = b_j (1 - a_ji / b_i)."""
        a, b, s = self.mp_a, self.mp_b, self.stages
        a_hat = context().matrix(s, s)
        for i in range(s):
            for j in range(s):
                # If a_ji = b_i, the entry is exactly zero, but b_j - b_j a_ji / b_i
                # could differ from zero by one unit of the last digit.
                if a[j, i] != b[i]:
                    a_hat[i, j] = b[j] * (1 - a[j, i] / b[i])
        return a_hat

    @cached_property
    def a(self) -> np.ndarray:
        """Return the coefficients a_ij, a read-only float64 array of shape (s, s)."""
        return to_float64(self.mp_a)

    @cached_property
    def b(self) -> np.ndarray:
        """Return the weights b_j, a read-only float64 array of shape (s,)."""
        return to_float64(self.mp_b)

    @cached_property
    def c(self) -> np.ndarray:
        """Return the nodes c_i, a read-only float64 array of shape (s,)."""
        return to_float64(self.mp_c)

    @cached_property
    def a_hat(self) -> np.ndarray:
        """Return the symplectic conjugate â_ij, a read-only float64 (s, s) array."""
        return to_float64(self.mp_a_hat)


def lagrange_in_legendre(nodes: list[Number]) -> Matrix:
    """Expand the Lagrange basis in the shifted Legendre polynomials on [0, 1].

    The coefficients K_nj satisfy ℓ_j(θ) = Σ_n K_nj P_n(2θ - 1), so that K = V^{-1} with
    V_in = P_n(2 c_i - 1).

    **Arguments:**

    - `nodes`: the distinct nodes c_1..c_s in [0, 1], mpmath numbers.

    **Returns:**

    The s x s mpmath matrix K.
    """
    s = len(nodes)
    vandermonde = context().matrix([legendre(s - 1, 2 * c - 1) for c in nodes])
    return context().inverse(vandermonde)


def _integrated_legendre(degree: int, x: Number) -> list[Number]:
    """Compute ∫_0^θ P_n(2τ - 1) dτ for n = 0..degree, given x = 2θ - 1."""
    p = legendre(degree + 1, x)
    first = (x + 1) / 2
    return [first] + [
        (p[n + 1] - p[n - 1]) / (2 * (2 * n + 1)) for n in range(1, degree + 1)
    ]


def _collocation(points: list[Number]) -> Tableau:
    """Build the collocation tableau with nodes (1 + x) / 2, x in symmetric `points`."""
    s = len(points)
    nodes = [(1 + x) / 2 for x in points]
    k = lagrange_in_legendre(nodes)
    integrals = context().matrix([_integrated_legendre(s - 1, x) for x in points])
    # b_j is K_0j, because only P_0 has a nonzero integral over [0, 1].
    b = [(k[0, j] + k[0, s - 1 - j]) / 2 for j in range(s)]
    raw = integrals * k
    a = context().matrix(s, s)
    for i in range(s):
        for j in range(s):
            # In exact arithmetic a_ij equals its reflection b_j - a_{s+1-i,s+1-j}. The
            # average of both has this symmetry exactly.
            a[i, j] = (raw[i, j] + b[j] - raw[s - 1 - i, s - 1 - j]) / 2
    if points[0] == -1:
        # The integrals to c_1 = 0 and c_s = 1 are known exactly.
        for j in range(s):
            a[0, j], a[s - 1, j] = context().mpf(0), b[j]
    return Tableau(a, b, nodes, BUILT_IN_TOLERANCE)


@cache
def lobatto_tableau(stages: int) -> Tableau:
    """Build the tableau of the Lobatto IIIA method with s stages.

    It is collocation at 0, 1 and the s - 2 zeros of P'_{s-1}(2c - 1) (Hairer, Lubich,
    Wanner, II.1.4). Its symplectic conjugate is Lobatto IIIB.

    **Arguments:**

    - `stages`: s >= 2.

    **Returns:**

    A `Tableau`; equal calls return the same object. Row 1 of `a` is 0, row s is `b`.

    !!! example

        >>> lobatto_tableau(2).a.tolist()
        [[0.0, 0.0], [0.5, 0.5]]
    """
    return _collocation(lobatto_points(stages))


@cache
def gauss_tableau(stages: int) -> Tableau:
    """Build the tableau of the Gauss method with s stages.

    It is collocation at the s zeros of P_s(2c - 1) (Hairer, Lubich, Wanner, II.1.3),
    and its own symplectic conjugate.

    **Arguments:**

    - `stages`: s >= 1.

    **Returns:**

    A `Tableau`; equal calls return the same object.

    !!! example

        >>> gauss_tableau(1).a.tolist(), gauss_tableau(1).b.tolist()
        ([[0.5]], [1.0])
    """
    return _collocation(gauss_points(stages))


@lru_cache(maxsize=128)
def user_tableau(a: tuple[tuple[float, ...], ...], b: tuple[float, ...]) -> Tableau:
    """Build a tableau with c_i = Σ_j a_ij from float64 coefficients, taken as exact.

    **Arguments:**

    - `a`: the rows of the coefficients.
    - `b`: the weights, which must not be zero.

    **Returns:**

    A `Tableau` whose identities are checked to the accuracy of float64 coefficients.

    !!! example

        >>> user_tableau(((0.0, 0.0), (0.5, 0.5)), (0.5, 0.5)).c.tolist()
        [0.0, 1.0]
    """
    mp_a = context().matrix([[context().mpf(x) for x in row] for row in a])
    mp_b = [context().mpf(x) for x in b]
    mp_c = [context().fsum(mp_a[i, j] for j in range(len(b))) for i in range(len(b))]
    return Tableau(mp_a, mp_b, mp_c, USER_TOLERANCE)


def legendre(degree: int, x: Number) -> list[Number]:
    """Evaluate the Legendre polynomials P_0(x), ..., P_degree(x) by their recurrence.

    **Arguments:**

    - `degree`: the highest degree.
    - `x`: an mpmath number, or a number of another type in which multiplication by
        integers is exact.

    **Returns:**

    A list of `degree + 1` values.
    """
    values = [x * 0 + 1, x]
    for n in range(1, degree):
        values.append(((2 * n + 1) * x * values[n] - n * values[n - 1]) / (n + 1))
    return values[: degree + 1]


def lobatto_points(stages: int) -> list[Number]:
    """Compute the Lobatto points on [-1, 1]: -1, the zeros of P'_{s-1}, and 1.

    They are exactly symmetric about 0 and in increasing order.

    **Arguments:**

    - `stages`: s >= 2.

    **Returns:**

    A list of s mpmath numbers.
    """
    n = stages - 1

    def derivative(x: Number) -> tuple[Number, Number]:
        p = legendre(n, x)
        # (1 - x²) P_n' = n (P_{n-1} - x P_n), and P_n'' is from Legendre's equation.
        first = n * (p[n - 1] - x * p[n]) / (1 - x * x)
        return first, (2 * x * first - n * (n + 1) * p[n]) / (1 - x * x)

    guesses = [math.cos(math.pi * k / n) for k in range(1, stages // 2)]
    inner = [_newton(derivative, g) for g in guesses]
    return _mirrored([context().mpf(1), *inner], stages)


def gauss_points(stages: int) -> list[Number]:
    """Compute the Gauss points on [-1, 1], the zeros of P_s.

    They are exactly symmetric about 0 and in increasing order.

    **Arguments:**

    - `stages`: s >= 1.

    **Returns:**

    A list of s mpmath numbers.
    """

    def polynomial(x: Number) -> tuple[Number, Number]:
        p = legendre(stages, x)
        slope = stages * (p[stages - 1] - x * p[stages]) / (1 - x * x)
        return p[stages], slope

    guesses = [
        math.cos(math.pi * (k - 0.25) / (stages + 0.5))
        for k in range(1, stages // 2 + 1)
    ]
    return _mirrored([_newton(polynomial, g) for g in guesses], stages)


def _newton(f: Callable[[Number], tuple[Number, Number]], guess: float) -> Number:
    """Find the root of `f` near `guess`; `f` returns its value and derivative."""
    x = context().mpf(guess)
    for _ in range(100):
        value, slope = f(x)
        step = value / slope
        x = x - step
        # Newton's method converges quadratically: the error after this step is far
        # below 1e-60.
        if abs(step) < context().mpf("1e-40"):
            return x
    raise RuntimeError("Newton's iteration for the nodes of a tableau did not converge")


def _mirrored(right: list[Number], count: int) -> list[Number]:
    """Build all points, symmetric and increasing, from the decreasing positive ones."""
    centre = [context().mpf(0)] if count % 2 else []
    return [-x for x in right] + centre + right[::-1]


def to_float64(x: Matrix | list[Number]) -> np.ndarray:
    """Round mpmath numbers to the nearest float64, as a read-only array.

    **Arguments:**

    - `x`: an mpmath matrix, or a list of mpmath numbers.

    **Returns:**

    A float64 array of shape `(rows, cols)`, or `(len(x),)` for a list.
    """
    rows = x if isinstance(x, list) else x.tolist()
    array = np.array(
        [[float(e) for e in r] if isinstance(r, list) else float(r) for r in rows],
        dtype=np.float64,
    )
    array.setflags(write=False)
    return array


@lru_cache(maxsize=128)
def _basis_coefficients(t: Tableau) -> tuple[np.ndarray, np.ndarray]:
    """Compute K and the rows -2 K_nj / (n (n + 1)), n = 1..s-1, rounded once."""
    s, c = t.stages, t.mp_c
    for i in range(s):
        for j in range(i):
            if abs(c[i] - c[j]) <= t.tolerance:
                raise ValueError(
                    f"c = {t.c.tolist()} has equal entries c_{j + 1} and c_{i + 1}: "
                    "the Lagrange basis needs distinct nodes"
                )
    k = lagrange_in_legendre(c)
    integrated = context().matrix(s, s)
    for n in range(1, s):
        for j in range(s):
            integrated[n, j] = -2 * k[n, j] / (n * (n + 1))
    return to_float64(k), to_float64(integrated)[1:]


def _as_floating(theta: ArrayLike) -> Array:
    array = jnp.asarray(theta)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array
    return array.astype(jnp.result_type(float))


def _combine(polynomials: list[Array], coefficients: np.ndarray) -> Array:
    # The highest precision is requested, because the default on a GPU may be
    # TensorFloat-32.
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
    - `theta`: θ, of any shape. It may be traced, and may lie outside [0, 1].

    **Returns:**

    An array of shape `theta.shape + (s,)` and of the dtype of `theta`.

    **Raises:**

    `ValueError` if two nodes coincide.
    """
    coefficients, _ = _basis_coefficients(t)
    x = 2 * _as_floating(theta) - 1
    p = [jnp.ones_like(x), x]
    for n in range(1, t.stages - 1):
        p.append(((2 * n + 1) * x * p[n] - n * p[n - 1]) / (n + 1))
    return _combine(p[: t.stages], coefficients)


def integrated_lagrange(t: Tableau, theta: ArrayLike) -> Float[Array, "*batch s"]:
    """Evaluate the integrals ∫_0^θ ℓ_1, ..., ∫_0^θ ℓ_s of the Lagrange basis.

    Arguments, result and errors are the same as for `lagrange`.
    """
    coefficients, integrated = _basis_coefficients(t)
    fraction = _as_floating(theta)
    x = 2 * fraction - 1
    linear = _combine([fraction], coefficients[:1])
    if t.stages == 1:
        return linear
    # P_1', P_2', ... are Gegenbauer polynomials C^(3/2); the loop is their recurrence.
    d = [jnp.ones_like(x), 3 * x]
    for n in range(2, t.stages - 1):
        d.append(((2 * n + 1) * x * d[n - 1] - (n + 1) * d[n - 2]) / n)
    bubble = fraction * (1 - fraction)
    return linear + _combine([bubble * p for p in d[: t.stages - 1]], integrated)
