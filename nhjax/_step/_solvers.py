"""The solvers of the stage equations, simplified Newton and Newton's method.

Both start from values of first order in h and stop by the sizes of their increments,
relative to a scale of the step.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._custom_types import FloatScalar, FloatScalarLike
from .._errors import check_choice, is_traced
from .._manifold import unframed
from .._numerics import (
    absolute,
    iterate,
    jacobian_and_value,
    matvec,
    max_norm,
    NOISE_UNITS,
    Sizes,
    Solved,
    uneven_perturbations,
)
from .._system import all_finite, check_flag, Linearisation, position_scale, real_scalar
from ._equations import impulse_weights, nudged, Stages, StageSystem
from ._factorisation import leading_structure
from ._jacobian_choice import JacobianName
from ._round_off import PART
from ._stage_iteration import (
    corrected,
    Evaluation,
    fibre_coordinate_size,
    increment_size,
    sizes,
    stage_residual,
)


# One iteration on the stages of a step. The equations are an argument, so that the
# iteration can be differentiated with respect to the data in them.
FrozenNewtonMap: TypeAlias = Callable[[StageSystem, Stages], Stages]


# Stages with a larger residual than this, relative to the momenta, are no solution.
_GROSS = 1e-6


def check_tolerance(tolerance: Any) -> None:
    """Raise a `ValueError` unless the `tolerance` of a solver is finite and >= 0."""
    if is_traced(tolerance):
        return
    if not np.all(np.isfinite(tolerance) & (np.asarray(tolerance) >= 0)):
        raise ValueError(
            f"`tolerance` must be finite and >= 0, got {tolerance}; 0 iterates to "
            "round-off."
        )


def tolerance_array(tolerance: FloatScalarLike) -> FloatScalarLike:
    """Convert the `tolerance` of a solver to an array.

    A number becomes an array of NumPy on the host: the default solver is made when
    nhjax is imported, which must not start JAX's backends, nor choose a precision.
    """
    if isinstance(tolerance, int | float) and not isinstance(tolerance, bool):
        return np.asarray(float(tolerance))
    return real_scalar("tolerance", tolerance, jnp.result_type(float))


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
        self, stages: StageSystem, x0: Stages, lin: Linearisation, skip: Array
    ) -> Solved[Stages, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""

    @abstractmethod
    def frozen_newton_map(
        self, stages: StageSystem, lin: Linearisation, x: Stages
    ) -> FrozenNewtonMap:
        """Make an iteration whose fixed points solve the stage equations.

        Its Jacobian is frozen, that is, constant. The iteration contracts at the
        solution `x`, and the derivatives of the solution follow from it by the implicit
        function theorem.
        """


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
        self, stages: StageSystem, x0: Stages, lin: Linearisation, skip: Array
    ) -> Solved[Stages, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""
        structure = leading_structure(stages, x0, lin, self.jacobian)
        scale = fibre_coordinate_scale(stages, x0, lin)

        def sweep(x: Stages):
            x_next, evaluation = corrected(stages, structure, x)
            return x_next, sizes(stages, x, x_next, lin), evaluation

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
        self, stages: StageSystem, lin: Linearisation, x: Stages
    ) -> FrozenNewtonMap:
        """Make the iteration of `solve`, with the constraint Jacobians at the solution.

        With the fallback it is the iteration of Newton's method, which contracts also
        where Newton's method had to take over.
        """
        if self.fallback:
            return self._newton.frozen_newton_map(stages, lin, x)
        structure = leading_structure(stages, x, lin, self.jacobian)
        return lambda stages, x: corrected(stages, structure, x)[0]


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
        self, stages: StageSystem, x0: Stages, lin: Linearisation, skip: Array
    ) -> Solved[Stages, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""
        _, unravel = ravel_pytree(x0)
        scale = fibre_coordinate_scale(stages, x0, lin)

        eps = float(jnp.finfo(stages.p.dtype).eps)
        nudge = eps**0.5
        moved = nudged(stages, jnp.asarray(nudge, stages.p.dtype))

        def residual(z):
            return stage_residual(stages, unravel(z))

        def sweep(x: Stages):
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
        gross = matvec(lin.momentum_inverse, solved.aux.forces.residual)
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
        self, stages: StageSystem, lin: Linearisation, x: Stages
    ) -> FrozenNewtonMap:
        """Make Newton's iteration with its Jacobian fixed, that at the solution."""
        z, unravel = ravel_pytree(x)
        jacobian = jax.jacfwd(lambda z: stage_residual(stages, unravel(z))[0])(z)
        jacobian_inverse = jnp.linalg.inv(jacobian)

        def corrected(stages: StageSystem, x: Stages) -> Stages:
            residual, _ = stage_residual(stages, x)
            return unravel(ravel_pytree(x)[0] - jacobian_inverse @ residual)

        return corrected


class Scale(NamedTuple):
    """The size of the fibre coordinates of a step, and what adds to their round-off.

    Both are in units of fibre coordinates: the round-off of these is about the unit
    round-off times the sum of the two.
    """

    size: FloatScalar
    round_off: FloatScalar


def _iterated(
    stage_solver: AbstractStageSolver,
    sweep: Callable[[Stages], tuple[Stages, Sizes, Evaluation]],
    x0: Stages,
    scale: Scale,
    skip: Array,
) -> Solved[Stages, Evaluation]:
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


def starting_values(stages: StageSystem, u: Array, lin: Linearisation) -> Stages:
    """Compute the stages to first order in h, from acceleration and λ_c at the start.

    The values do not depend on the step before, so that a step is a function of its
    state alone.
    """
    m, s = stages.num_nonholonomic, stages.method.stages
    push = stages.h * lin.acceleration
    stage_times = jnp.sum(stages.coefficients("a_hat"), axis=1)
    node_times = jnp.sum(stages.node_weights, axis=1)
    # The unknown ν of the symmetric closure vanishes with h, and starts from zero; all
    # other unknowns of a closure are multipliers.
    free = (jnp.arange(s - 1) >= int(stages.symmetric)).astype(u.dtype)
    nothing = jnp.zeros((0,), u.dtype)
    in_stages = u[None] + jnp.outer(stage_times, push)
    velocity, momentum, kept = in_stages, jnp.zeros((s, 0), u.dtype), stages.kept
    if stages.hamiltonian:
        velocity, momentum = (
            _starting_velocities(stages, u, lin, stage_times),
            in_stages,
        )
    return Stages(
        velocity=velocity,
        momentum=momentum,
        node_fibre_coordinate=u[None] + jnp.outer(node_times, push),
        closure=jnp.outer(free, lin.multiplier[:m]),
        holonomic=jnp.outer(jnp.ones((s,), u.dtype), lin.multiplier[m:]),
        end_acceleration=lin.acceleration if stages.symmetric else nothing,
        end_multiplier=lin.multiplier if stages.symmetric else nothing,
        impulse=None if kept is None else jnp.zeros_like(kept.sizes),
    )


def _starting_velocities(stages: StageSystem, u, lin: Linearisation, times) -> Array:
    v = stages.system.velocity(stages.t, stages.q, u, stages.args)
    _, rate = jax.jvp(
        lambda t, xi, u: stages.system.velocity(
            t, stages.manifold.act(stages.q, xi), u, stages.args
        ),
        (stages.t, jnp.zeros_like(u), u),
        (jnp.ones_like(stages.t), v, lin.acceleration),
    )
    return v[None] + jnp.outer(times, stages.h * rate)


def fibre_coordinate_scale(
    stages: StageSystem, x0: Stages, lin: Linearisation
) -> Scale:
    """Estimate the size of the fibre coordinates of a step and their round-off.

    The size is that of the coordinates at the starting values x0, plus that of the
    terms that cancel in them, the forces and reactions over the step. For a system at
    rest these terms are all there is. Round-off of the positions adds to it, in so far
    as velocities feel it: through holonomic constraints, whose round-off is divided by
    h, and through nonholonomic ones, which matters where a coordinate has grown large,
    as the heading of a car after many turns. With invariants the round-off of these is
    added, as far as impulses have it. Last comes the measured round-off of the
    functions of the system.
    """
    h = jnp.abs(stages.h)
    rate = max_norm(lin.acceleration)
    if stages.constrained:
        rate = rate + max_norm(matvec(absolute(lin.reaction), jnp.abs(lin.multiplier)))
    size = h * rate + max_norm(
        x0.node_fibre_coordinate, x0.momentum if stages.hamiltonian else x0.velocity
    )
    round_off = jnp.zeros_like(size)
    m, k = stages.num_nonholonomic, stages.num_holonomic
    t, q, args = stages.t, unframed(stages.q), stages.args

    if k:
        sizes = position_scale(stages.system, t, q, args, lin)
        correction = lin.largest_correction(jnp.pad(sizes, (m, 0)))
        round_off = round_off + correction / h
    if m:
        sizes = jnp.pad(_kinematic_scale(stages, q, x0), (0, k))
        round_off = round_off + lin.largest_correction(sizes)
    if stages.kept is not None:
        round_off = round_off + impulse_weights(stages, x0).noise
    if stages.round_off is not None:
        round_off = jnp.maximum(round_off, stages.round_off.size(h))
    return Scale(size, round_off)


def _kinematic_scale(
    stages: StageSystem, q: PyTree[Array], x0: Stages
) -> Float[Array, " m"]:
    """Estimate how far nonholonomic constraints move if positions move by their size.

    One direction of the moves is enough for an estimate: to take each number by itself
    would cost as many derivatives as there are coordinates.
    """
    system, t, args = stages.system, stages.t, stages.args
    u = x0.momentum[0] if stages.hamiltonian else x0.velocity[0]
    change = jax.jvp(
        lambda q: system.kinematic_constraint(t, q, u, args),
        (q,),
        (uneven_perturbations(q),),
    )[1]
    # Where a constraint has no finite slope this tells nothing of its round-off.
    return jnp.where(jnp.isfinite(change), jnp.abs(change), 0)
