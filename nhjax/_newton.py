"""The two solvers of the stage equations."""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
from jax.flatten_util import ravel_pytree
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import FloatScalar, FloatScalarLike
from ._iteration import dense_increment, iterate, relative_size, Solved
from ._linearisation import inverse, Linearisation
from ._stages import StageForces, Stages, StageSystem


class Evaluation(NamedTuple):
    """What a solver leaves behind: the equations at the last iterate."""

    forces: StageForces
    node_residual: Float[Array, "r n"]


class AbstractStageSolver(eqx.Module):
    """How the stage equations of a step are solved."""

    max_iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[FloatScalarLike]

    def __check_init__(self):
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(
                f"{type(self).__name__}: `max_iterations` must be an int >= 1, got "
                f"{self.max_iterations!r}."
            )

    @abstractmethod
    def solve(
        self, stages: StageSystem, x0: Stages, lin: Linearisation, skip: Array
    ) -> Solved[Stages, Evaluation]:
        """Solve the stage equations from `x0`; does nothing where `skip` is true."""


class SimplifiedNewton(AbstractStageSolver):
    """Simplified Newton on the stage system, with its leading structure as Jacobian.

    The mass matrix M and C = B M⁻¹ Bᵀ are inverted once a step, at its start; each
    iteration costs one evaluation of the stage equations and a few small products, and
    reduces the error by a factor O(h).

    **Arguments:**

    - `max_iterations`: the number of iterations after which a step counts as failed.
    - `tolerance`: the size of the increment, relative to the velocities, at which to
        stop; 0, the default, iterates to round-off. Changing it recompiles nothing.

    !!! example

        >>> import nhjax
        >>> nhjax.SimplifiedNewton(max_iterations=80).max_iterations
        80
    """

    max_iterations: int = eqx.field(static=True, default=50)
    tolerance: FloatScalarLike = eqx.field(converter=jnp.asarray, default=0.0)

    def solve(
        self, stages: StageSystem, x0: Stages, lin: Linearisation, skip: Array
    ) -> Solved[Stages, Evaluation]:
        """Solve the stage equations from `x0`; does nothing where `skip` is true."""

        h = stages.h
        weights = stages.node_weights
        if stages.constrained:
            E = stages.closure("E")
            # B at the stages, as far as it is known before the step; M⁻¹ Bᵀ.
            jacobian = jnp.concatenate([lin.jacobian[None], stages.node_jacobian(x0)])
            reaction = jnp.einsum("kn,jmn->jkm", lin.mass_inverse, jacobian)
            blocks = jnp.einsum("ian,jnb->ijab", jacobian[1:], reaction)
            schur = jnp.einsum("ij,jl,ijab->ialb", weights, E, blocks)
            size = schur.shape[0] * schur.shape[1]
            # Invertible for small h by H2 (or its analogue for the symmetric closure)
            # and the compatibility condition.
            schur_inverse = inverse(schur.reshape(size, size))
            end = eqx.tree_at(
                lambda z: (z.jacobian, z.reaction, z.compliance_inverse),
                lin,
                (jacobian[-1], reaction[-1], inverse(blocks[-1, -1])),
            )

        def sweep(x: Stages):
            # The leading structure of the linearised equations, with M at the start of
            # the step, Bᵢ at the stages and R the node rows of a_ij:
            #   δVᵢ = -M⁻¹ r_V + Σ âᵢⱼ M⁻¹Bⱼᵀ h δΛⱼ,    δΛ = E δy,
            #   δvᵢ = -M⁻¹ r_v + Σ Rᵢⱼ M⁻¹Bⱼᵀ h δΛⱼ,    Bᵢ δvᵢ = -r_Φ.
            # Each residual is evaluated at the newest iterate (Gauss-Seidel): it costs
            # the same and contracts faster.
            forces = stages.evaluate(x)
            dv_stage = -forces.residual @ lin.mass_inverse.T
            x = eqx.tree_at(lambda z: z.velocity, x, x.velocity + dv_stage)
            node_residual = stages.node_residual(x, forces.force)
            dv_node = -node_residual @ lin.mass_inverse.T
            x = eqx.tree_at(lambda z: z.node_velocity, x, x.node_velocity + dv_node)
            dx = Stages(dv_stage, dv_node, None, None, None)
            if stages.constrained:
                x, dx = constrain(x, dx)
            size = _increment_size(stages, dx, x, lin)
            return x, size, Evaluation(forces, node_residual)

        def constrain(x: Stages, dx: Stages) -> tuple[Stages, Stages]:
            phi = stages.node_constraint(x)
            h_dy = -(schur_inverse @ phi.reshape(-1)).reshape(phi.shape)
            push = jnp.einsum("jnm,jm->jn", reaction, E @ h_dy)
            dv_stage = stages.coefficients("a_hat") @ push
            dv_node = weights @ push
            x = Stages(
                x.velocity + dv_stage,
                x.node_velocity + dv_node,
                x.closure + h_dy / h,
                x.end_acceleration,
                x.end_multiplier,
            )
            da = dlam = None
            if stages.symmetric:
                # λ_c depends on v_{k+1} at zeroth order: it must see the new velocity,
                # or the two errors would feed each other and contract only as √h.
                momentum_residual, hidden_residual = stages.end_residual(x)
                da, dlam = end.solve(-momentum_residual, -hidden_residual)
                x = eqx.tree_at(
                    lambda z: (z.end_acceleration, z.end_multiplier),
                    x,
                    (x.end_acceleration + da, x.end_multiplier + dlam),
                )
            return x, Stages(
                dx.velocity + dv_stage, dx.node_velocity + dv_node, h_dy / h, da, dlam
            )

        return iterate(
            sweep,
            x0,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            skip=skip,
        )


class Newton(AbstractStageSolver):
    """Newton's method on the stage system with the exact dense Jacobian.

    Dearer per iteration than `SimplifiedNewton`, but it converges for larger steps and
    for stiff forces. Both give the same trajectory to round-off.

    **Arguments:** as for `SimplifiedNewton`.

    !!! example

        >>> import nhjax
        >>> nhjax.Newton().max_iterations
        30
    """

    max_iterations: int = eqx.field(static=True, default=30)
    tolerance: FloatScalarLike = eqx.field(converter=jnp.asarray, default=0.0)

    def solve(
        self, stages: StageSystem, x0: Stages, lin: Linearisation, skip: Array
    ) -> Solved[Stages, Evaluation]:
        """Solve the stage equations from `x0`; does nothing where `skip` is true."""
        _, unravel = ravel_pytree(x0)

        def residual(z):
            x = unravel(z)
            forces = stages.evaluate(x)
            node_residual = stages.node_residual(x, forces.force)
            parts = [forces.residual, node_residual]
            if stages.constrained:
                parts.append(stages.node_constraint(x))
            if stages.symmetric:
                parts += stages.end_residual(x)
            return ravel_pytree(parts)[0], Evaluation(forces, node_residual)

        def sweep(x: Stages):
            z, _ = ravel_pytree(x)
            dz, values = dense_increment(residual, z)
            return unravel(z + dz), _increment_size(stages, unravel(dz), x, lin), values

        return iterate(
            sweep,
            x0,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            skip=skip,
        )


def _increment_size(
    stages: StageSystem, dx: Stages, x: Stages, lin: Linearisation
) -> FloatScalar:
    # Multipliers count by their effect on velocities, which does not cancel against
    # other increments: Λ can still be wrong where V and v are already right.
    effect = stages.multiplier_effect(dx, lin)
    return relative_size(
        jnp.concatenate([dx.velocity, dx.node_velocity, effect]),
        jnp.concatenate([x.velocity, x.node_velocity]),
    )
