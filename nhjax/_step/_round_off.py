"""The round-off of the functions of a system, as the equations of a step feel it."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._method import AbstractMethod
from .._numerics import frozen, max_norm
from .._system import FunctionNoise, Linearisation


class RoundOff(eqx.Module):
    """The round-off of the functions of a system, as sizes of fibre coordinates.

    A size is the round-off in units of the unit round-off, so that it is comparable to
    the sizes of the coordinates themselves. It is measured once, at the start of a run:
    constants inside the functions do not change, and sizes of coordinates are taken
    into account in each step. The size in a step of length h is

    `by_velocity` + h `by_force` + `by_position` / h:

    momenta and nonholonomic constraints; forces; and holonomic constraints. The
    `violations` of constraints on velocities and positions that round-off can amount to
    are in the units of these.
    """

    by_velocity: FloatScalar
    by_force: FloatScalar
    by_position: FloatScalar
    violations: tuple[Float[Array, " l"], Float[Array, " k"]]

    @classmethod
    def of_arrays(cls, arrays: tuple[Array, ...]) -> "RoundOff":
        """Make it from its arrays, in the order of the fields."""
        by_velocity, by_force, by_position, *violations = arrays
        on_velocities, on_positions = violations
        sizes = by_velocity, by_force, by_position
        return cls(*sizes, (on_velocities, on_positions))

    def size(self, h: FloatScalar) -> FloatScalar:
        """Compute the size in a step of length h > 0."""
        return self.by_velocity + h * self.by_force + self.by_position / h


# An increment of stages that has stopped falling can be six times as large as the
# round-off that the functions of a system leave in it. It counts as noise up to 400
# units of a size, so that a size is this part of the measured round-off.
PART = 1 / 8


def round_off_of_steps(
    method: AbstractMethod, lin: Linearisation, noise: FunctionNoise
) -> RoundOff:
    """Compute the round-off of steps from the noise of the functions of a system.

    `lin` is the linearisation at the state. The iteration on the stages magnifies the
    round-off of constraints by the inverse of the method's coefficients.
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

    The first number is that of nonholonomic constraints, the second that of holonomic
    ones: h N⁻¹ R δΛ is so much larger than the change that would make up for the error
    of one constraint. They are largest root sums of squares of rows of the inverses of
    R E and of (A Â, b); see `StageEquations`. Pseudo-inverses, since a method that is not
    meant for one kind of constraints may have a singular matrix for it.
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
