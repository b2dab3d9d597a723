"""The exceptions that nhjax raises, and the one place where a condition is enforced."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
from jaxtyping import Array, Bool
import numpy as np


T = TypeVar("T")


class ShapeError(ValueError):
    """An argument, or the value of a user's function, has the wrong shape."""


class DTypeError(TypeError):
    """An argument is not made of floating-point numbers, or of unlike ones."""


class NonFiniteError(ValueError):
    """An argument, or the value of a user's function at it, is not finite."""


class ConstraintViolationError(ValueError):
    """The state does not satisfy the constraints."""


class IrregularLagrangianError(ValueError):
    """The mass matrix D2D2L is singular: the Legendre transform is not invertible."""


class DependentConstraintsError(ValueError):
    """D2Φ has not full rank: the paper's admissibility condition fails."""


class IncompatibleConstraintsError(ValueError):
    """C = D2Φ M⁻¹ D2Φᵀ is singular: the paper's compatibility condition fails."""


class NewtonError(RuntimeError):
    """A nonlinear equation outside the time loop could not be solved."""


class IntegrationError(RuntimeError):
    """A trajectory could not be continued; the message names lane, step and reason."""


def is_traced(*arrays: object) -> bool:
    """Whether any of the arrays has no value yet (inside jit, vmap or grad)."""
    return any(isinstance(x, jax.core.Tracer) for x in arrays)


def require(
    tree: T,
    ok: Bool[Array, ""] | np.bool_ | bool,
    error: Callable[[], Exception],
    under_jit: str,
) -> T:
    """Return `tree` if `ok`; otherwise raise.

    With a concrete `ok` the exception made by `error` is raised here and now, with the
    offending values in its message. With a traced one they are not known yet: the
    message `under_jit` is raised when the compiled program runs.
    """
    if is_traced(ok):
        return eqx.error_if(tree, ~ok, under_jit)  # pyright: ignore[reportArgumentType, reportOperatorIssue]
    if not bool(ok):
        raise error()
    return tree
