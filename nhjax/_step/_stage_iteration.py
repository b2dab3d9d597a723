"""The residual of all stage equations, and a sweep of simplified Newton over them."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._custom_types import BoolScalar, FloatScalar
from .._numerics import matvec, max_norm, Sizes, stop_gradient, unit
from .._system import Linearisation
from ._equations import (
    constraint_values,
    end_residual,
    invariant_correction,
    invariant_errors,
    is_in_chart,
    node_residual,
    stage_forces,
    stage_velocities,
    StageEquations,
    StageForces,
    StageUnknowns,
)
from ._leading_structure import LeadingStructure


class Evaluation(NamedTuple):
    """The stage equations, evaluated by a stage solver at its last iterate.

    `newton` tells whether Newton's method had to take over from simplified Newton.
    """

    forces: StageForces
    node_residual: Float[Array, "r n"]
    newton: BoolScalar


def corrected(
    stages: StageEquations, structure: LeadingStructure, x: StageUnknowns
) -> tuple[StageUnknowns, Evaluation]:
    """Make a sweep of simplified Newton; return its result and the values at x."""
    # Each residual is evaluated at the newest iterate (Gauss-Seidel): this costs the
    # same as evaluating all of them at the last iterate, and contracts faster.
    forces = stage_forces(stages, x)
    x_next = structure.correct_stages(stages, x, forces.residual)
    r_nodes = node_residual(stages, x_next, forces.force)
    change = x_next.velocity - x.velocity
    x_next = structure.correct_nodes(stages, x_next, r_nodes, change)
    if stages.invariants is not None:
        # Before the constraints, so that these see what impulses change: where a system
        # is nearly at rest, the work of reactions on that is not small beside it.
        error = invariant_errors(stages, x_next)
        x_next = structure.correct_impulses(stages, x_next, error)
    if stages.constrained:
        x_next = _constrain(stages, structure, x_next)
    return x_next, Evaluation(forces, r_nodes, jnp.asarray(False))


def _constrain(
    stages: StageEquations, structure: LeadingStructure, x: StageUnknowns
) -> StageUnknowns:
    kinematic, holonomic = constraint_values(stages, x)
    x = structure.correct_multipliers(stages, x, kinematic, holonomic)
    if stages.end_multiplier_is_unknown:
        # λ_c depends on v_{k+1} at zeroth order: it must see the new velocity, or the
        # two errors would feed each other and contract only as the root of the rate.
        x = structure.correct_end(stages, x, end_residual(stages, x))
    return x


def stage_residual(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, " k"], Evaluation]:
    """Evaluate all equations of a step (the paper's four summaries) in one vector.

    A stage solver of a user's own looks for the stages at which it vanishes; see the
    page on extending in the documentation.

    **Arguments:**

    - `stages`: the equations of the step, as `AbstractStageSolver.solve` is given them.
    - `x`: the unknowns, of the same structure as the starting values that it is given.

    **Returns:** the residuals, of shape (k,) with as many entries as `x` has numbers,
    in the units of momenta and of the constraints; and what was evaluated on the way,
    which belongs into the field `aux` of `Solved`.

    !!! example

        >>> import nhjax
        >>> import equinox as eqx
        >>> class Told(nhjax.AbstractStageSolver):
        ...     solver: nhjax.Newton = nhjax.Newton()
        ...     max_iterations: int = eqx.field(static=True, default=30)
        ...     tolerance: float = 0.0
        ...     def solve(self, stages, x0, lin, skip):
        ...         r, _ = nhjax.stage_residual(stages, x0)
        ...         assert r.shape == (20,)
        ...         return self.solver.solve(stages, x0, lin, skip)
        ...     def frozen_newton_map(self, stages, lin, x):
        ...         return self.solver.frozen_newton_map(stages, lin, x)
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=1, stage_solver=Told())
        >>> int(sol.stats["num_steps"])
        1
    """
    forces = stage_forces(stages, x)
    r_nodes = node_residual(stages, x, forces.force)
    parts = [forces.residual, r_nodes]
    if stages.hamiltonian:
        parts.append(x.velocity - stage_velocities(stages, x))
    parts += constraint_values(stages, x)
    if stages.end_multiplier_is_unknown:
        parts += end_residual(stages, x)
    if stages.invariants is not None:
        # The same equation as that of simplified Newton.
        weights = stop_gradient(invariant_correction(stages, x))
        parts.append(-weights.change(x.impulse, invariant_errors(stages, x)))
    return (
        ravel_pytree(parts)[0],
        Evaluation(forces, r_nodes, jnp.asarray(False)),
    )


def sizes(
    stages: StageEquations, x: StageUnknowns, x_next: StageUnknowns, lin: Linearisation
) -> Sizes:
    """Measure an increment and the fibre coordinates that it leads to.

    Of the coordinates only those at the end of the step are measured: they are enough
    to judge the increment, and to look at all of them would cost time.
    """
    increment = increment_size(stages, x, x_next, lin)
    return Sizes(increment, max_norm(x_next.node_fibre_coordinate[-1]))


def fibre_coordinate_size(stages: StageEquations, x: StageUnknowns) -> FloatScalar:
    """Measure the fibre coordinates of the stages and of the nodes; take the smaller.

    While an iteration is far from a solution, one of the two can be much larger than
    any size that has to do with the other.
    """
    u = x.momentum if stages.hamiltonian else x.velocity
    return jnp.minimum(max_norm(u), max_norm(x.node_fibre_coordinate))


def increment_size(
    stages: StageEquations, x: StageUnknowns, x_next: StageUnknowns, lin: Linearisation
) -> FloatScalar:
    """Measure an increment by its largest change of fibre coordinates.

    The size is infinite once the iterates have left the chart.
    """
    changes = [
        x_next.node_fibre_coordinate - x.node_fibre_coordinate,
        x_next.velocity - x.velocity,
    ]
    if stages.hamiltonian:
        changes[1] = matvec(lin.metric_inverse, changes[1])
        changes.append(x_next.momentum - x.momentum)
    if stages.constrained:
        # Multipliers count by their effect h N⁻¹ R δΛ on u, separately from the changes
        # of u itself: Λ can still be wrong where the stages and nodes happen to be
        # right.
        before, after = map(stages.multiplier_change, (x, x_next))
        reaction = lin.reaction
        if before.shape[1] == 1 and isinstance(reaction, jax.Array):
            # With one constraint the largest entry of the column decides, and it is the
            # same for all iterates.
            reaction = max_norm(reaction).reshape(1, 1)
        change = matvec(reaction, after - before)
        changes.append(stages.h * change)
    size = max_norm(*changes)
    if stages.manifold.is_flat:
        return size
    return jnp.where(is_in_chart(stages, x_next), size, jnp.inf)


def unknown_units(stages: StageEquations, lin: Linearisation) -> list[FloatScalar]:
    """Return the size of each field of `StageUnknowns` that changes u by one.

    As in `increment_size`, multipliers count by the effect h N⁻¹ R δΛ on u. By their
    own size the round-off of a multiplier, which grows like 1 / h, could not be told
    from an iteration that does not converge.
    """
    h = jnp.abs(stages.h)
    one = jnp.ones_like(h)
    velocity = 1 / unit(max_norm(lin.metric_inverse)) if stages.hamiltonian else one
    # Of a sparse matrix this is the product of its largest factors.
    sizes_of_reaction = map(max_norm, jax.tree.leaves(lin.reaction))
    multiplier = 1 / unit(h * math.prod(sizes_of_reaction))
    sizes = {
        "velocity": velocity,
        "momentum": one,
        "node_fibre_coordinate": one,
        "closure": multiplier,
        "holonomic": multiplier,
        "end_acceleration": 1 / unit(h),
        "end_multiplier": multiplier,
    }
    if stages.invariants is not None:
        largest = max_norm(matvec(lin.momentum_inverse, stages.invariants.covectors))
        sizes["impulse"] = 1 / unit(largest)
    names = [field.name for field in dataclasses.fields(StageUnknowns)]
    return [sizes[name] for name in names if name in sizes]
