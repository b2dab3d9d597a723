"""The solvers of the stage equations, simplified Newton and Newton's method.

Both solvers stop when the changes of their iterates are round-off, relative to the
scale of the step.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._custom_types import FloatScalar, FloatScalarLike
from .._errors import check_choice
from .._manifold import unframed
from .._numerics import (
    iterate,
    max_norm,
    NOISE_UNITS,
    repeated,
    solve_by_rows,
    Solved,
    uneven_perturbations,
    UpdateNorms,
)
from .._system import all_finite, check_flag, Linearisation, position_terms, real_scalar
from ._equations import (
    Evaluation,
    invariant_correction,
    stage_residual,
    stage_residuals,
    StageEquations,
    StageResiduals,
    StageUnknowns,
    unknown_units,
    with_moved_positions,
)
from ._first_order import forces_have_slopes, JacobianName
from ._jacobian import (
    factorise_stage_jacobian,
    fibre_coordinate_size,
    increment_size,
    Linearised,
    NewtonFactors,
    simplified_newton_update,
    update_norms,
)
from ._round_off import noise_of_step, PART
from ._step import AbstractStageSolver, FrozenNewtonMap


# If the residual, mapped from momenta to fibre coordinates (v or p), is larger than
# this fraction of the fibre coordinates, the iterate is not a solution.
_GROSS = 1e-6
# For systems with more coordinates, or steps with more unknowns, Newton's method solves
# its equations by `jnp.linalg.solve`, and not by blocks.
_MOST_COORDINATES, _MOST_UNKNOWNS = 32, 256
# After this many iterations of simplified Newton, the fallback to Newton's method takes
# less time than further iterations. With a limit above 100, `iterate` would accept a
# last increment that Newton's method can reduce.
_MOST_BEFORE_NEWTON = 100


def tolerance_array(tolerance: FloatScalarLike) -> FloatScalarLike:
    """Convert the `tolerance` of a solver to an array.

    A number becomes a NumPy array on the host, because the default solver is created
    when nhjax is imported, and this import must not start JAX's backends or choose a
    precision.
    """
    if isinstance(tolerance, int | float) and not isinstance(tolerance, bool):
        return np.asarray(float(tolerance))
    return real_scalar("tolerance", tolerance, jnp.result_type(float))


class SimplifiedNewton(AbstractStageSolver):
    """Simplified Newton on the stage equations, with part of their Jacobian.

    The solver inverts the mass matrix M and the Schur complement of the constraints
    once per step, at the start of the step. Each iteration costs one evaluation of the
    stage equations and a few small products.

    The leading part of the Jacobian contains only these two matrices. With the leading
    part alone, an iteration reduces the error by a factor O(h²) on a vector space if M
    is constant, forces do not depend on v, and the constraints are linear in v.
    Otherwise the factor is O(h). The terms of order h are the derivatives of momenta
    with respect to positions, and of forces with respect to velocities, at the start of
    the step. With these terms the factor is always O(h²).

    The leading part and the terms of order h omit the stiffness: the derivatives of
    forces, inertia and reactions with respect to positions. On machines with feedback
    control, stiff springs or light steered parts this omission makes the iteration slow
    or divergent. The full Jacobian has all derivatives, at the starting values of the
    step. It is computed and inverted once a step, which costs as much as 3 to 15
    iterations.

    If simplified Newton does not converge, Newton's method with the exact Jacobian may
    still converge. With the option `fallback`, Newton's method takes over in such a
    step, and `Solution.stats["num_newton_steps"]` counts these steps. A program that
    contains both methods takes about three times as long to compile as simplified
    Newton alone. For this reason a plain call of `integrate`, outside all
    transformations of JAX, first runs without the fallback. If a step was not solved,
    the call repeats the run with the full Jacobian, if `jacobian` is None. If a step is
    still not solved, the call repeats the run with the fallback. In your own
    transformed program (`jax.jit`, `jax.vmap`, `jax.grad`), no run is repeated: request
    the full Jacobian or the fallback there if steps are not solved.

    **Arguments:**

    - `max_iterations`: the number of iterations after which a step counts as failed.
        With the fallback, Newton's method takes over after at most 100 iterations.
    - `tolerance`: the iteration stops at an increment of at most this size, relative
        to the velocities. The default, 0, iterates to round-off. Changing the tolerance
        does not recompile.
    - `fallback`: whether `nhjax.Newton()` takes over a step that is not solved: True,
        False, or None. None, the default, uses the fallback only in plain calls, as
        described above. Derivatives of a run with the fallback use the exact Jacobian,
        as with `nhjax.Newton()`.
    - `jacobian`: the part of the Jacobian that is used.
        - `"leading"`, the leading part alone, or `"first_order"`, the leading part with
            the terms of order h.
        - `"full"`, the full Jacobian, for machines whose steps need many iterations or
            are not solved.
        - None, the default: the terms of order h are included if they should reduce the
            run time. This is assumed if all m constraints are nonholonomic, there are
            s <= 5 stages and n <= 6 coordinates, and s (s - 1) n m <= 100. The terms
            are not available for Hamiltonian systems, for redundant constraints, and
            for so many constraints that their matrices are sparse.

    !!! example

        >>> import nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum()
        >>> sol = nhjax.integrate(pendulum.system, nhjax.LobattoIIIAB(3),
        ...     pendulum.initial_state(), dt=0.1, num_steps=20,
        ...     stage_solver=nhjax.SimplifiedNewton(max_iterations=80))
        >>> int(sol.stats["num_steps"])
        20
    """

    max_iterations: int = eqx.field(static=True, default=2000)
    tolerance: FloatScalarLike = eqx.field(converter=tolerance_array, default=0.0)
    fallback: bool | None = eqx.field(static=True, default=None)
    jacobian: JacobianName = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.jacobian is not None:
            check_choice("jacobian", self.jacobian, ("leading", "first_order", "full"))
        if self.fallback is not None:
            check_flag("fallback", self.fallback)

    def solve(
        self, stages: StageEquations, x0: StageUnknowns, lin: Linearisation, skip: Array
    ) -> Solved[StageUnknowns, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""
        factors = factorise_stage_jacobian(stages, x0, lin, self.jacobian)
        scale = fibre_coordinate_scale(stages, x0, lin)

        def iteration(x: StageUnknowns):
            x_next, evaluation = simplified_newton_update(stages, factors, x)
            return x_next, update_norms(stages, x, x_next, lin), evaluation

        limit = self.max_iterations
        if self.fallback:
            limit = min(limit, _MOST_BEFORE_NEWTON)
        solved = _iterated(self, iteration, x0, scale, skip, limit)
        if not self.fallback:
            return solved
        # If the first iterate is not finite, the functions of the system are not finite
        # at the state itself, and Newton's method cannot help.
        hopeless = (solved.num_iterations <= 1) & ~all_finite(solved.x)
        ends = solved.converged | hopeless

        def by_newton():
            newton = self._newton.solve(stages, x0, lin, ends)
            count = solved.num_iterations + newton.num_iterations
            aux = newton.aux._replace(newton=jnp.ones_like(ends))
            return newton._replace(num_iterations=count, aux=aux)

        return jax.lax.cond(ends, lambda: solved, by_newton)

    @property
    def _newton(self) -> "Newton":
        return Newton(tolerance=self.tolerance)

    def frozen_newton_map(
        self, stages: StageEquations, lin: Linearisation, x: StageUnknowns
    ) -> FrozenNewtonMap:
        """Build the iteration of `solve` with constraint Jacobians at the solution.

        With the fallback this is the iteration of Newton's method, which also contracts
        in steps that Newton's method had to solve.
        """
        if self.fallback:
            return self._newton.frozen_newton_map(stages, lin, x)
        factors = factorise_stage_jacobian(stages, x, lin, self.jacobian)
        return lambda stages, x: simplified_newton_update(stages, factors, x)[0]


def is_simplified_alone(stage_solver: AbstractStageSolver) -> bool:
    """Return whether the solver is simplified Newton without the fallback."""
    return isinstance(stage_solver, SimplifiedNewton) and not stage_solver.fallback


def has_default_jacobian(stage_solver: AbstractStageSolver) -> bool:
    """Return whether the solver is simplified Newton with its default Jacobian."""
    return isinstance(stage_solver, SimplifiedNewton) and stage_solver.jacobian is None


def solvers_of_unsolved_steps(
    stage_solver: AbstractStageSolver,
) -> list[SimplifiedNewton]:
    """List, in order, the solvers with which a plain call repeats a failed run."""
    is_simplified = isinstance(stage_solver, SimplifiedNewton)
    if not is_simplified or stage_solver.fallback is not None:
        return []
    by_newton = replace(stage_solver, fallback=True)
    if stage_solver.jacobian is not None:
        return [by_newton]
    return [replace(stage_solver, jacobian="full"), by_newton]


class Newton(AbstractStageSolver):
    """Newton's method on the stage equations, with their exact Jacobian.

    The Jacobian is computed at each iterate and eliminated by blocks. An iteration
    costs more than an iteration of `SimplifiedNewton`, but the method converges for
    larger steps and for stiff forces. Stiff forces magnify round-off in the increments.
    This solver distinguishes such round-off from the increments of an iteration that
    has not converged. Both solvers give the same trajectory to round-off.

    **Arguments:** `max_iterations` and `tolerance`, as for `SimplifiedNewton`.

    !!! example

        >>> import nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum()
        >>> sol = nhjax.integrate(pendulum.system, nhjax.LobattoIIIAB(3),
        ...     pendulum.initial_state(), dt=0.1, num_steps=20,
        ...     stage_solver=nhjax.Newton())
        >>> int(sol.stats["num_steps"])
        20
    """

    max_iterations: int = eqx.field(static=True, default=300)
    tolerance: FloatScalarLike = eqx.field(converter=tolerance_array, default=0.0)

    def solve(
        self, stages: StageEquations, x0: StageUnknowns, lin: Linearisation, skip: Array
    ) -> Solved[StageUnknowns, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""
        scale = fibre_coordinate_scale(stages, x0, lin)
        eps = float(jnp.finfo(stages.p.dtype).eps)
        nudge = eps**0.5
        moved = with_moved_positions(stages, jnp.asarray(nudge, stages.p.dtype))

        def iteration(x: StageUnknowns):
            z, unravel = ravel_pytree(x)
            r, push, evaluation = jax.linearize(
                lambda x: stage_residuals(stages, x), x, has_aux=True
            )
            # The round-off of the residuals is measured: x is changed by a few units in
            # the last place, and the Jacobian predicts the change without round-off.
            near_z = z + 8 * eps * uneven_perturbations(z)
            near = stage_residuals(stages, unravel(near_z))[0]
            change = stage_residuals(moved, x)[0]
            rights = [_minus(side, r) for side in (change, near)]
            dz, by_moving, by_steps = _solved(stages, x, lin, push, [r, *rights])
            x_next = unravel(z - dz)
            # Two kinds of round-off move the stages: the round-off of the positions,
            # which stiff forces magnify, and the round-off of the equations, which is
            # magnified if the equations are nearly dependent.
            by_positions, by_equations = (
                increment_size(stages, x, unravel(z + noise), lin)
                for noise in (-by_moving, (near_z - z) - by_steps)
            )
            noise = jnp.maximum(by_positions / nudge, PART * by_equations / eps)
            found = UpdateNorms(
                increment_size(stages, x, x_next, lin),
                fibre_coordinate_size(stages, x_next),
                noise,
            )
            return x_next, found, evaluation

        solved = _iterated(self, iteration, x0, scale, skip, self.max_iterations)
        # Where forces grow without bound, increments are small even far from a
        # solution. Therefore the residual is checked too.
        gross = lin.momentum_inverse.matvec(solved.aux.forces.residual)
        found = fibre_coordinate_size(stages, solved.x)
        measure = jnp.maximum(scale.size + scale.round_off, found)
        allowed = 1e3 * jnp.asarray(self.tolerance, measure.dtype)
        size = jnp.maximum(scale.size, found)
        near = jnp.maximum(_GROSS * measure, allowed * size)
        is_near = skip | (max_norm(gross) <= near)
        return solved._replace(
            converged=solved.converged & is_near,
            exhausted=solved.exhausted | (solved.converged & ~is_near),
        )

    def frozen_newton_map(
        self, stages: StageEquations, lin: Linearisation, x: StageUnknowns
    ) -> FrozenNewtonMap:
        """Build Newton's iteration with the constant Jacobian at the solution."""
        z, unravel = ravel_pytree(x)
        jacobian = jax.jacfwd(lambda z: stage_residual(stages, unravel(z))[0])(z)
        jacobian_inverse = jnp.linalg.inv(jacobian)

        def update(stages: StageEquations, x: StageUnknowns) -> StageUnknowns:
            residual, _ = stage_residual(stages, x)
            return unravel(ravel_pytree(x)[0] - jacobian_inverse @ residual)

        return update


def _solved(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    push: Linearised,
    rights: list[StageResiduals],
) -> Float[Array, "r k"]:
    """Solve the linearised equations J dx = r of a step for each r in `rights`.

    `push` multiplies by J. The equations are eliminated by blocks, with one round of
    refinement for the first r. Rows are not exchanged between blocks, so that the
    elimination can lose digits even if J is regular. If the refinement detects such a
    loss, the equations are solved by elimination with partial pivoting of all rows.
    Larger systems, and systems whose forces have no forward-mode derivatives, are
    solved by `jnp.linalg.solve`.
    """
    flat = jnp.stack([ravel_pytree(r)[0] for r in rights])
    _, residuals = ravel_pytree(rights[0])
    z, unravel = ravel_pytree(x)
    size, dtype = len(z), z.dtype

    def pushed(z):
        return ravel_pytree(push(unravel(z)))[0]

    if not _eliminates_blocks(stages, size):
        jacobian = jax.vmap(pushed, out_axes=1)(jnp.eye(size, dtype=dtype))
        return jnp.linalg.solve(jacobian, flat.T).T
    factors = NewtonFactors.at(stages, x, lin, push)
    units = unknown_units(stages, lin)

    def measured(z):
        leaves = jax.tree.leaves(unravel(z))
        pairs = zip(leaves, units, strict=True)
        return max_norm(*(leaf / unit for leaf, unit in pairs if leaf.size))

    eps = float(jnp.finfo(dtype).eps)

    def by_blocks(k, carry):
        sides, found = carry
        dx = ravel_pytree(factors.solve(stages, push, residuals(sides[k])))[0]

        def with_rest():
            return sides.at[1].set(sides[0] - pushed(dx))

        # The second right-hand side is the residual that the first solution leaves.
        sides = jax.lax.cond(k == 0, with_rest, lambda: sides)
        return sides, found.at[k].set(dx)

    sides = jnp.concatenate([flat[:1], jnp.zeros_like(flat[:1]), flat[1:]])
    _, found = repeated(len(sides), by_blocks, (sides, jnp.zeros_like(sides)))
    is_solved = measured(found[1]) <= eps**0.5 * measured(found[0])
    found = jnp.concatenate([found[:1] + found[1:2], found[2:]])

    def by_rows(carry):
        is_solved, _ = carry

        def put_column(k, table):
            # `is_solved` is false here, but makes the column depend on the carry. XLA
            # would move a column without this dependence out of the loop, and compute
            # it even if the loop makes no iteration.
            unit = (jnp.arange(size, dtype=k.dtype) == k) & ~is_solved
            column = pushed(unit.astype(dtype))[:, None]
            return jax.lax.dynamic_update_slice_in_dim(table, column, k, axis=1)

        table = jnp.zeros((size, size), dtype)
        found = solve_by_rows(repeated(size, put_column, table), flat.T).T
        return jnp.asarray(True), found

    # Under `jax.vmap`, a `cond` always computes both branches. This loop computes
    # nothing if the equations of all members are solved.
    _, found = jax.lax.while_loop(lambda carry: ~carry[0], by_rows, (is_solved, found))
    return found


def _eliminates_blocks(stages: StageEquations, size: int) -> bool:
    """Return whether Newton's method eliminates its equations by blocks."""
    is_small = stages.p.shape[0] <= _MOST_COORDINATES and size <= _MOST_UNKNOWNS
    return is_small and forces_have_slopes(stages)


def _minus(tree: StageResiduals, other: StageResiduals) -> StageResiduals:
    return jax.tree.map(jnp.subtract, tree, other)


class Scale(NamedTuple):
    """The size of the fibre coordinates of a step, and their additional round-off.

    The fibre coordinates are v, or p for a Hamiltonian system. All fields are in units
    of fibre coordinates. `round_off` and `noise` are values of round-off divided by the
    unit round-off. The round-off of fibre coordinates is about the unit round-off times
    `size + round_off`. The measured round-off of the functions of the system changes
    fibre coordinates by about the unit round-off times `noise`.
    """

    size: FloatScalar
    round_off: FloatScalar
    noise: FloatScalar


def _iterated(
    stage_solver: AbstractStageSolver,
    iteration: Callable[[StageUnknowns], tuple[StageUnknowns, UpdateNorms, Evaluation]],
    x0: StageUnknowns,
    scale: Scale,
    skip: Array,
    max_iterations: int,
) -> Solved[StageUnknowns, Evaluation]:
    """Repeat the `iteration` of a solver until it converges or fails."""
    return iterate(
        iteration,
        x0,
        scale.size,
        max_iterations=max_iterations,
        tolerance=stage_solver.tolerance,
        round_off=scale.round_off,
        noise=scale.noise,
        noise_units=NOISE_UNITS,
        skip=skip,
    )


def fibre_coordinate_scale(
    stages: StageEquations, x0: StageUnknowns, lin: Linearisation
) -> Scale:
    """Estimate the size of the fibre coordinates of a step and their round-off.

    The size is the sum of three sizes: of the coordinates at the starting values x0, of
    their change over the step, and of the part of this change that reactions cause and
    forces may cancel. For a system at rest only the changes remain.

    The additional round-off has these parts:

    - The round-off of positions, which acts through the constraints. For holonomic
        constraints it is divided by h. For nonholonomic constraints it matters if a
        coordinate has grown large, such as the heading of a car after many turns.
    - The round-off of invariants, which acts through the impulses that keep them.

    The additional round-off is at least `PART` times the measured round-off of the
    functions of the system.
    """
    h = jnp.abs(stages.h)
    rate = max_norm(lin.acceleration)
    if stages.constrained:
        rate = rate + max_norm(lin.reaction.absolute().matvec(jnp.abs(lin.multiplier)))
    size = h * rate + max_norm(
        x0.node_fibre_coordinate, x0.momentum if stages.hamiltonian else x0.velocity
    )
    round_off = jnp.zeros_like(size)
    m, k = stages.num_nonholonomic, stages.num_holonomic
    t, q, args = stages.t, unframed(stages.q), stages.args

    if k:
        sizes = position_terms(stages.system, t, q, args, lin)
        correction = lin.largest_correction(jnp.pad(sizes, (m, 0)))
        round_off = round_off + correction / h
    if m:
        sizes = jnp.pad(_kinematic_scale(stages, q, x0), (0, k))
        round_off = round_off + lin.largest_correction(sizes)
    if stages.invariants is not None:
        round_off = round_off + invariant_correction(stages, x0).noise
    noise = jnp.zeros_like(size)
    if stages.noise is not None:
        eps = float(jnp.finfo(size.dtype).eps)
        noise = noise_of_step(stages.method, lin, stages.noise, h) / eps
        round_off = jnp.maximum(round_off, PART * noise)
    return Scale(size, round_off, noise)


def _kinematic_scale(
    stages: StageEquations, q: PyTree[Array], x0: StageUnknowns
) -> Float[Array, " m"]:
    """Estimate how nonholonomic constraints change if q changes by its own size.

    One direction of change is enough for an estimate. Changing each coordinate
    separately would need one derivative per coordinate.
    """
    system, t, args = stages.system, stages.t, stages.args
    u = x0.momentum[0] if stages.hamiltonian else x0.velocity[0]
    change = jax.jvp(
        lambda q: system.kinematic_constraint(t, q, u, args),
        (q,),
        (uneven_perturbations(q),),
    )[1]
    # A slope that is not finite does not measure the round-off.
    return jnp.where(jnp.isfinite(change), jnp.abs(change), 0)
