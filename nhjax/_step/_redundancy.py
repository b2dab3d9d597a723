"""Redundant constraints: equations of a step of which some follow from the others."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float

from .._numerics import small_einsum
from .._system import Linearisation


class Redundancy(eqx.Module):
    """The equations for the multipliers of redundant constraints.

    With C at the start of the step and C⁻ its inverse of the least norm, P = C C⁻
    projects the values of constraints onto those that their derivatives there can
    reach, of which there are as many as independent constraints. Near the start P Φ
    vanishes only where Φ does. The equations that are left over are replaced by

    (1 - P) diag(C) h δΛ = 0,

    so that multipliers stay among those of the least norm, up to what the derivatives
    change within the step.

    Nonholonomic and holonomic constraints do not mix in P: the former hold at the nodes
    and the latter at the stages, where the rates of these are no zeros. A combination
    of nonholonomic ones that follows from holonomic ones is among what is left over,
    and P has the first diagonal block of C C⁻ for the former and the last for the
    latter. At the end of the step both hold, and so does what follows.
    """

    projector: Float[Array, "l l"]  # P
    rest: Float[Array, "l l"]  # (1 - P) diag(C)

    @classmethod
    def at(cls, lin: Linearisation, m: int) -> "Redundancy":
        """Make the equations for a step from the state of a linearisation.

        `m` is the number of nonholonomic constraints.
        """
        jacobian, reaction, inverse = lin.dense
        compliance = small_einsum("kn,nl->kl", jacobian, reaction)
        whole = small_einsum("kl,lm->km", compliance, inverse)
        projector = jax.scipy.linalg.block_diag(whole[:m, :m], whole[m:, m:])
        unit = jnp.eye(projector.shape[0], dtype=projector.dtype)
        sizes = jnp.sum(jnp.abs(compliance) * unit, axis=1)
        # A row without derivatives is left out; its multiplier has no unit.
        sizes = jnp.where(sizes > 0, sizes, 1)
        return cls(projector, (unit - projector) * sizes[None, :])

    def reduced(
        self, values: Float[Array, "r c"], multipliers: Float[Array, "r c"], first: int
    ) -> Float[Array, "r c"]:
        """Compute P Φ + (1 - P) diag(C) h Λ for the rows from `first` on."""
        rows = slice(first, first + values.shape[1])
        return small_einsum(
            "ab,rb->ra", self.projector[rows, rows], values
        ) + small_einsum("ab,rb->ra", self.rest[rows, rows], multipliers)

    def schur_rest(self, stages: int, m: int) -> Float[Array, "c c"]:
        """Compute the derivative of (1 - P) diag(C) h Λ by all h Λ; m is as in `at`."""
        k = self.rest.shape[0] - m
        counts = (stages - 1) * (m > 0), stages * (k > 0)
        blocks = [self.rest[:m, :m]] * counts[0] + [self.rest[m:, m:]] * counts[1]
        return jax.scipy.linalg.block_diag(*blocks)
