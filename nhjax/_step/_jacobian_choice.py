"""The choice of what simplified Newton has in its Jacobian."""

from typing import Literal, TypeAlias

import jax
import jax.numpy as jnp

from .._numerics import dependence, full_jacobian, SparseMatrix
from .._system import Linearisation, total_force
from ._equations import StageEquations


# What of the Jacobian simplified Newton inverts; None means what pays.
JacobianName: TypeAlias = Literal["leading", "first_order"] | None

# Terms of order h pay where they make a step quicker than the sweeps that they save:
# up to this many stages, coordinates, and changes of stages with the multipliers, and
# without holonomic constraints. Larger programs of one trajectory are no longer
# compiled as scalars, and become several times slower.
_MOST_STAGES, _MOST_COORDINATES, _MOST_RESPONSES = 5, 6, 100


def takes_first_order_terms(
    stages: StageEquations, lin: Linearisation, jacobian: JacobianName
) -> bool:
    """Tell whether the Jacobian of simplified Newton has terms of order h.

    **Raises:** `ValueError` if they are asked for and not available.
    """
    if jacobian == "leading":
        return False
    has_them = not stages.hamiltonian
    has_them &= stages.redundancy is None and not isinstance(lin.jacobian, SparseMatrix)
    if jacobian == "first_order":
        if not has_them:
            raise ValueError(
                '`SimplifiedNewton(jacobian="first_order")` is not available for '
                "Hamiltonian systems, redundant constraints, or constraints so many "
                'that they are kept sparse; use "leading" or None.'
            )
        return True
    s, n, m = stages.method.stages, stages.p.shape[0], stages.num_nonholonomic
    is_small = s <= _MOST_STAGES and n <= _MOST_COORDINATES
    is_small &= s * n * (s - 1) * m <= _MOST_RESPONSES
    if not has_them or not is_small or stages.num_holonomic > 0:
        return False
    if not _forces_have_slopes(stages):
        return False
    return not stages.manifold.is_flat or _has_terms(stages)


def _forces_have_slopes(stages: StageEquations) -> bool:
    """Tell whether forces can be differentiated by velocities in forward mode.

    Callbacks cannot, nor functions that have a rule for reverse mode alone. Nothing
    else in a step needs this derivative.
    """

    def force(u):
        return total_force(
            stages.system, stages.t, stages.q, u, stages.multiplier, stages.args
        )

    zero = jnp.zeros_like(stages.p)
    try:
        jax.eval_shape(lambda u: full_jacobian(force, u), zero)
    except (NotImplementedError, TypeError, ValueError):
        return False
    return True


def _has_terms(stages: StageEquations) -> bool:
    # On a vector space they vanish unless momenta depend on positions, or forces on
    # velocities, which the programs of the system tell.
    system, t, args = stages.system, stages.t, stages.args
    q, zero = stages.q, jnp.zeros_like(stages.p)
    by_position = dependence(
        lambda xi: system.momentum(t, stages.manifold.act(q, xi), zero, args), zero
    )
    by_velocity = dependence(
        lambda u: total_force(system, t, q, u, stages.multiplier, args), zero
    )
    return bool(by_position.any() or by_velocity.any())
