"""The exceptions that nhjax raises, and the one place where a condition is enforced."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool


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
    return any(isinstance(x, Tracer) for x in arrays)


class Check(NamedTuple):
    """A condition, the exception if it fails, and the message if only at run time."""

    ok: Bool[Array, ""] | np.bool_ | bool
    error: Callable[[], Exception]
    under_jit: str


def require(tree: T, *checks: Check) -> T:
    """Return `tree` if all checks hold; otherwise raise for the first that fails.

    With a concrete condition the exception made by `error` is raised here and now, with
    the offending values in its message. With a traced one they are not known yet: the
    message `under_jit` is raised when the compiled program runs.
    """
    for check in checks:
        if not is_traced(check.ok) and not check.ok:
            raise check.error()
    traced = [check for check in checks if is_traced(check.ok)]
    if not traced:
        return tree
    # One call-back for all of them: each costs as much to compile as the arithmetic.
    bad = ~jnp.stack([jnp.asarray(check.ok) for check in traced])
    return eqx.branched_error_if(
        tree, jnp.any(bad), jnp.argmax(bad), [check.under_jit for check in traced]
    )
