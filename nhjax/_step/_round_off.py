"""The effect of the round-off of a system's functions on the equations of a step."""

import functools

import jax.numpy as jnp
import numpy as np

from .._custom_types import FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm, nonzero_or_one, stop_gradient
from .._system import FunctionNoise, Linearisation


# When the increments of the stage solver stop falling, they can be six times as large
# as the round-off that the functions of a system cause in them. Increments count as
# noise up to `NOISE_UNITS` = 400 times a given round-off, which is too much here. The
# measured round-off is therefore multiplied by `PART`: increments up to 50 times the
# measured round-off then count as noise.
PART = 1 / 8


def noise_of_step(
    method: AbstractMethod, lin: Linearisation, noise: FunctionNoise, h: FloatScalar
) -> FloatScalar:
    """Estimate the change of fibre coordinates by the round-off of the functions.

    The round-off of the functions is measured once, at the start of a run, because
    constants inside the functions do not change. Its effect on the fibre coordinates
    can change by orders of magnitude, for instance where constraints become dependent.
    Therefore each step computes the effect with its own matrices,

    |N⁻¹| (δp + |h| δf) + |N⁻¹ R| |C⁻¹| (c δφ + ĉ δΓ / |h|),

    with the round-off δp of momenta, δf of forces, δφ of constraints on velocities and
    δΓ of holonomic constraints. `Linearisation` explains the matrices N, R and C, and
    `magnifications` computes the factors c and ĉ.

    **Arguments:** `method`; `lin`, the linearisation at the start of the step; `noise`,
    the round-off of the functions of the system; `h`, the step size, of any sign. If h
    is zero, no step is taken, and the result has no meaning.
    """
    lin, noise, h = stop_gradient((lin, noise, h))
    h = nonzero_or_one(jnp.abs(h))
    gained = noise.momentum + h * noise.force
    changes = max_norm(lin.momentum_inverse.absolute().matvec(gained))
    if lin.violation.shape[0]:
        kinematic, holonomic = magnifications(method)
        missed = kinematic * noise.on_velocities
        k = noise.on_positions.shape[0]
        if k:
            m = lin.violation.shape[0] - k
            on_positions = holonomic / h * noise.on_positions
            missed = jnp.concatenate([missed[:m], missed[m:] + on_positions])
        changes = changes + lin.largest_correction(missed)
    return changes


@functools.lru_cache
def magnifications(method: AbstractMethod) -> tuple[float, float]:
    """Compute how much a step magnifies random errors of its constraints.

    The factor is the ratio of two changes of the fibre coordinates: h N⁻¹ R δΛ in the
    step, and the change that would correct the error of a single constraint. It is
    computed as the largest Euclidean norm of a row of a matrix. For nonholonomic
    constraints this matrix is E (A_{2:} E)⁻¹. For holonomic constraints it is the
    inverse of the matrix with the rows A_{2:} Â and b. A, Â and b are the coefficients
    of the method, A_{2:} is A without its first row, and E is in `closure_weights`.
    Pseudo-inverses are used, because a method that does not support one of the two
    kinds of constraints can have a singular matrix.

    **Returns:** the factor for nonholonomic and the factor for holonomic constraints.
    """

    def largest_row(matrix):
        return float(np.max(np.linalg.norm(matrix, axis=1)))

    a, a_hat, b = (np.asarray(x) for x in (method.a, method.a_hat, method.b))
    e = np.asarray(method.closure_weights.E)
    on_positions = np.concatenate([a[1:] @ a_hat, b[None]])
    return (
        largest_row(e @ np.linalg.pinv(a[1:] @ e)),
        largest_row(np.linalg.pinv(on_positions)),
    )
