"""Redundant constraints: some equations of a step follow from the others."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float

from .._numerics import small_einsum
from .._system import Linearisation


class Redundancy(eqx.Module):
    """The equations for the multipliers of redundant constraints.

    With the Delassus matrix C at the start of the step and its least-norm inverse C⁻,
    P = C C⁻ projects the values of the constraints onto the range of C. The dimension
    of this range is the number of independent constraints. Near the start of the step,
    P Φ = 0 implies Φ = 0. The other equations, (1 - P) Φ = 0, are replaced by

    (1 - P) diag(C) h Λ = 0,

    with the step size h and the multipliers Λ of the constraints Φ, so that the
    multipliers keep the least norm, up to the change of the constraint derivatives
    within the step.

    P must not mix nonholonomic and holonomic constraints: nonholonomic constraints are
    imposed at the nodes, but holonomic constraints at the stages, where the rates of
    holonomic constraints do not vanish. Therefore P is block diagonal, with the first
    and the last diagonal block of C C⁻. If a combination of nonholonomic constraints
    follows from holonomic ones, it is among the replaced equations. At the end of the
    step both kinds of constraints hold, and so do all equations that follow from them.
    """

    projector: Float[Array, "l l"]  # P
    rest: Float[Array, "l l"]  # (1 - P) diag(C)

    @classmethod
    def at(cls, lin: Linearisation, m: int) -> "Redundancy":
        """Return the equations of a step, from the linearisation at its start.

        `m` is the number of nonholonomic constraints.
        """
        jacobian, reaction, inverse = lin.dense
        delassus = small_einsum("kn,nl->kl", jacobian, reaction)
        whole = small_einsum("kl,lm->km", delassus, inverse)
        projector = jax.scipy.linalg.block_diag(whole[:m, :m], whole[m:, m:])
        unit = jnp.eye(projector.shape[0], dtype=projector.dtype)
        sizes = jnp.sum(jnp.abs(delassus) * unit, axis=1)
        # If the derivatives of a constraint are zero, they give no scale for the
        # equation of its multiplier. The scale is then one.
        sizes = jnp.where(sizes > 0, sizes, 1)
        return cls(projector, (unit - projector) * sizes[None, :])

    def reduced(
        self, values: Float[Array, "r c"], multipliers: Float[Array, "r c"], first: int
    ) -> Float[Array, "r c"]:
        """Compute P Φ + (1 - P) diag(C) h Λ for the constraints from number `first` on.

        `values` are Φ and `multipliers` h Λ, with one row for each node or stage.
        """
        rows = slice(first, first + values.shape[1])
        return small_einsum(
            "ab,rb->ra", self.projector[rows, rows], values
        ) + small_einsum("ab,rb->ra", self.rest[rows, rows], multipliers)

    def schur_rest(self, stages: int, m: int) -> Float[Array, "c c"]:
        """Compute the derivative of (1 - P) diag(C) h Λ with respect to all h Λ.

        `m` is the number of nonholonomic constraints.
        """
        k = self.rest.shape[0] - m
        counts = (stages - 1) * (m > 0), stages * (k > 0)
        blocks = [self.rest[:m, :m]] * counts[0] + [self.rest[m:, m:]] * counts[1]
        return jax.scipy.linalg.block_diag(*blocks)
