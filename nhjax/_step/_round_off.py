"""The effect of the round-off of a system's functions on the equations of a step."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm, stop_gradient
from .._system import FunctionNoise, Linearisation


class RoundOff(eqx.Module):
    """The round-off of the functions of a system, as sizes of fibre coordinates.

    A size is the fraction `PART` of a round-off, divided by the unit round-off, so that
    it is comparable to the size of the coordinates. The round-off is measured once, at
    the start of a run, because constants inside the functions do not change. Each step
    adds the sizes of its own coordinates. The size in a step of length h is

    `by_velocity` + h `by_force` + `by_position` / h.

    - `by_velocity`: from momenta and constraints on velocities.
    - `by_force`: from forces.
    - `by_position`: from holonomic constraints.
    - `violations`: the violations of the constraints on velocities and on positions
        that round-off can cause, in the units of the constraints.
    """

    by_velocity: FloatScalar
    by_force: FloatScalar
    by_position: FloatScalar
    violations: tuple[Float[Array, " l"], Float[Array, " k"]]

    @classmethod
    def of_arrays(cls, arrays: tuple[Array, ...]) -> "RoundOff":
        """Build an instance from its arrays, in the order of the fields."""
        by_velocity, by_force, by_position, *violations = arrays
        on_velocities, on_positions = violations
        sizes = by_velocity, by_force, by_position
        return cls(*sizes, (on_velocities, on_positions))

    def size(self, h: FloatScalar) -> FloatScalar:
        """Compute the size in a step of length h > 0."""
        return self.by_velocity + h * self.by_force + self.by_position / h


# When the increments of the stages stop falling, they can be six times as large as the
# round-off that the functions of a system cause in them. Increments count as noise up
# to `NOISE_UNITS` = 400 times the unit round-off times a size. With this fraction, they
# count as noise up to 50 times the measured round-off.
PART = 1 / 8


def round_off_of_steps(
    method: AbstractMethod, lin: Linearisation, noise: FunctionNoise
) -> RoundOff:
    """Compute the round-off of steps from the noise of the functions of a system.

    `lin` is the linearisation at the state at which the noise was measured. The inverse
    of the matrix of the method's coefficients magnifies the round-off of constraints.
    """
    lin = stop_gradient(lin)
    inverse = lin.momentum_inverse.absolute()
    by_velocity, by_force = (
        max_norm(inverse.matvec(x)) for x in (noise.momentum, noise.force)
    )
    by_position = jnp.zeros_like(by_velocity)
    if lin.violation.shape[0]:
        kinematic, holonomic = magnifications(method)
        correction = lin.largest_correction(noise.on_velocities)
        by_velocity = by_velocity + kinematic * correction
        k = noise.on_positions.shape[0]
        if k:
            m = lin.violation.shape[0] - k
            sizes = jnp.pad(noise.on_positions, (m, 0))
            by_position = holonomic * lin.largest_correction(sizes)
    units = PART / float(jnp.finfo(by_velocity.dtype).eps)
    sizes = units * by_velocity, units * by_force, units * by_position
    return RoundOff(*sizes, noise.violations)


@functools.lru_cache
def magnifications(method: AbstractMethod) -> tuple[float, float]:
    """Compute how much a step magnifies random errors of its constraints.

    The change h N⁻¹ R δΛ in a step is larger, by the computed factor, than the change
    that would correct the error of a single constraint. The factor is the largest
    Euclidean norm of a row of E (A_{2:} E)⁻¹ for nonholonomic constraints, and of the
    inverse of the matrix with the rows A_{2:} Â and b for holonomic constraints. A_{2:}
    is A without its first row, and E belongs to the closure of the multiplier.
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
