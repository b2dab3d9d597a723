"""The two solvers of the stage equations, simplified Newton and Newton's method."""

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._custom_types import FloatScalarLike
from .._errors import check_choice
from .._numerics import (
    iterate,
    jacobian_and_value,
    max_norm,
    NOISE_UNITS,
    Sizes,
    Solved,
    uneven_perturbations,
)
from .._system import all_finite, check_flag, Linearisation
from ._first_order import JacobianName
from ._jacobian import (
    Evaluation,
    factorise_stage_jacobian,
    fibre_coordinate_size,
    increment_size,
    simplified_newton_update,
    stage_residual,
    update_norms,
)
from ._round_off import PART
from ._scale import fibre_coordinate_scale, Scale
from ._stage_system import nudged, StageEquations
from ._tolerance import check_tolerance, tolerance_array
from ._unknowns import StageUnknowns


# One iteration on the stages of a step. The equations are an argument, so that the
# iteration can be differentiated with respect to the data in them.
FrozenNewtonMap: TypeAlias = Callable[[StageEquations, StageUnknowns], StageUnknowns]


# StageUnknowns with a larger residual than this, relative to the momenta, are no solution.
_GROSS = 1e-6


class AbstractStageSolver(eqx.Module):
    """A solver of the stage equations of a step, the option `stage_solver`."""

    max_iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[FloatScalarLike]

    def __check_init__(self):
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(
                f"{type(self).__name__}: `max_iterations` must be an int >= 1, got "
                f"{self.max_iterations!r}."
            )
        check_tolerance(self.tolerance)

    @abstractmethod
    def solve(
        self, stages: StageEquations, x0: StageUnknowns, lin: Linearisation, skip: Array
    ) -> Solved[StageUnknowns, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""

    @abstractmethod
    def frozen_newton_map(
        self, stages: StageEquations, lin: Linearisation, x: StageUnknowns
    ) -> FrozenNewtonMap:
        """Make an iteration whose fixed points solve the stage equations.

        Its Jacobian is frozen, that is, constant. The iteration contracts at the
        solution `x`, and the derivatives of the solution follow from it by the implicit
        function theorem.
        """


def _iterated(
    stage_solver: AbstractStageSolver,
    sweep: Callable[[StageUnknowns], tuple[StageUnknowns, Sizes, Evaluation]],
    x0: StageUnknowns,
    scale: Scale,
    skip: Array,
) -> Solved[StageUnknowns, Evaluation]:
    """Run the iteration on the stages of a solver, whose own sweep is an argument."""
    return iterate(
        sweep,
        x0,
        scale.size,
        max_iterations=stage_solver.max_iterations,
        tolerance=stage_solver.tolerance,
        round_off=scale.round_off,
        noise_units=NOISE_UNITS,
        skip=skip,
    )


class SimplifiedNewton(AbstractStageSolver):
    """Simplified Newton on the stage equations, with part of their Jacobian.

    The mass matrix M and the Schur complement of the constraints are inverted once a
    step, at its start; each iteration costs one evaluation of the stage equations and a
    few small products. With this leading part alone an iteration reduces the error by a
    factor O(h²) where M is constant, forces do not depend on v and the constraints are
    linear in v, and by a factor O(h) elsewhere and on Lie groups. With the terms of
    order h, derivatives of momenta by positions and of forces by velocities at the
    start of the step, it is O(h²) there too.

    Where this iteration does not converge, Newton's method with the exact Jacobian may.
    With the fallback it takes over in such a step, and
    `Solution.stats["num_newton_steps"]` counts these steps. A program that contains
    both methods takes longer to compile, and runs slower even where the fallback is
    never used. For this reason a plain call of `integrate` first runs without the
    fallback, and is repeated with it if a step was not solved. In a program of your own
    (`jax.jit`, `jax.vmap`, `jax.grad`) a step that is not solved ends the run, unless
    you ask for the fallback.

    **Arguments:**

    - `max_iterations`: the number of iterations after which a step counts as failed.
    - `tolerance`: the size of the increment, relative to the velocities, at which to
        stop; 0, the default, iterates to round-off. Changing it recompiles nothing.
    - `fallback`: whether `nhjax.Newton()` takes over a step that is not solved. It is
        True, False, or None, the default, which means in plain calls alone. Derivatives
        of a run with the fallback use the exact Jacobian, as those of `nhjax.Newton()`
        do.
    - `jacobian`: `"leading"`; `"first_order"`, which has the terms of order h as well;
        or None, the default, which has them where they pay: with s <= 5 stages, n <= 6
        coordinates and m constraints with s (s - 1) n m <= 100, all nonholonomic. They
        are not available for Hamiltonian systems, redundant constraints, and
        constraints so many that they are kept sparse.

    !!! example

        >>> import nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum()
        >>> sol = nhjax.integrate(pendulum.system, nhjax.LobattoIIIAB(3),
        ...     pendulum.initial_state(), dt=0.1, num_steps=20,
        ...     stage_solver=nhjax.SimplifiedNewton(max_iterations=80))
        >>> int(sol.stats["num_steps"])
        20
    """

    max_iterations: int = eqx.field(static=True, default=100)
    tolerance: FloatScalarLike = eqx.field(converter=tolerance_array, default=0.0)
    fallback: bool | None = eqx.field(static=True, default=None)
    jacobian: JacobianName = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.jacobian is not None:
            check_choice("jacobian", self.jacobian, ("leading", "first_order"))
        if self.fallback is not None:
            check_flag("fallback", self.fallback)

    def solve(
        self, stages: StageEquations, x0: StageUnknowns, lin: Linearisation, skip: Array
    ) -> Solved[StageUnknowns, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""
        factors = factorise_stage_jacobian(stages, x0, lin, self.jacobian)
        scale = fibre_coordinate_scale(stages, x0, lin)

        def sweep(x: StageUnknowns):
            x_next, evaluation = simplified_newton_update(stages, factors, x)
            return x_next, update_norms(stages, x, x_next, lin), evaluation

        solved = _iterated(self, sweep, x0, scale, skip)
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
        """Make the iteration of `solve`, with the constraint Jacobians at the solution.

        With the fallback it is the iteration of Newton's method, which contracts also
        where Newton's method had to take over.
        """
        if self.fallback:
            return self._newton.frozen_newton_map(stages, lin, x)
        factors = factorise_stage_jacobian(stages, x, lin, self.jacobian)
        return lambda stages, x: simplified_newton_update(stages, factors, x)[0]


def is_simplified_alone(stage_solver: AbstractStageSolver) -> bool:
    """Tell whether a run does without Newton's method, unless it is repeated."""
    return isinstance(stage_solver, SimplifiedNewton) and not stage_solver.fallback


def leaves_steps_to_newton(stage_solver: AbstractStageSolver) -> bool:
    """Tell whether a plain call that fails is to be repeated with the fallback."""
    return isinstance(stage_solver, SimplifiedNewton) and stage_solver.fallback is None


class Newton(AbstractStageSolver):
    """Newton's method on the stage equations, with their exact dense Jacobian.

    An iteration costs more than one of `SimplifiedNewton`, but the method converges for
    larger steps and for stiff forces. It also tells increments that are round-off,
    magnified by stiff forces, from those of an iteration that has not converged. Both
    solvers give the same trajectory to round-off.

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

    max_iterations: int = eqx.field(static=True, default=30)
    tolerance: FloatScalarLike = eqx.field(converter=tolerance_array, default=0.0)

    def solve(
        self, stages: StageEquations, x0: StageUnknowns, lin: Linearisation, skip: Array
    ) -> Solved[StageUnknowns, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""
        _, unravel = ravel_pytree(x0)
        scale = fibre_coordinate_scale(stages, x0, lin)

        eps = float(jnp.finfo(stages.p.dtype).eps)
        nudge = eps**0.5
        moved = nudged(stages, jnp.asarray(nudge, stages.p.dtype))

        def residual(z):
            return stage_residual(stages, unravel(z))

        def sweep(x: StageUnknowns):
            z, _ = ravel_pytree(x)
            jacobian, r, evaluation = jacobian_and_value(residual, z)
            change = stage_residual(moved, x)[0] - r
            # After a change by a few units of the last digits the equations differ from
            # what the Jacobian predicts by their round-off.
            near = z + 8 * eps * uneven_perturbations(z)
            missed = residual(near)[0] - r - jacobian @ (near - z)
            rights = jnp.stack([r, change, missed], axis=1)
            dz, *noises = jnp.linalg.solve(jacobian, -rights).T
            x_next = unravel(z + dz)
            # Two effects move the stages: the round-off of the positions, magnified by
            # stiff forces, and that of the equations, magnified where these are nearly
            # dependent.
            by_positions, by_equations = (
                increment_size(stages, x, unravel(z + noise), lin) for noise in noises
            )
            noise = jnp.maximum(by_positions / nudge, PART * by_equations / eps)
            found = Sizes(
                increment_size(stages, x, x_next, lin),
                fibre_coordinate_size(stages, x_next),
                noise,
            )
            return x_next, found, evaluation

        solved = _iterated(self, sweep, x0, scale, skip)
        # Where forces grow without bound, increments are small even far from any
        # solution, so that the residual is checked too.
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
        """Make Newton's iteration with its Jacobian fixed, that at the solution."""
        z, unravel = ravel_pytree(x)
        jacobian = jax.jacfwd(lambda z: stage_residual(stages, unravel(z))[0])(z)
        jacobian_inverse = jnp.linalg.inv(jacobian)

        def update(stages: StageEquations, x: StageUnknowns) -> StageUnknowns:
            residual, _ = stage_residual(stages, x)
            return unravel(ravel_pytree(x)[0] - jacobian_inverse @ residual)

        return update
