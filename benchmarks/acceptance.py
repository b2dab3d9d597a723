"""Search for accepted steps that are not solved, and for refused starts that are good.

`--only steps` runs the systems of the gallery, a bicycle and ten random systems, with
step sizes from h = 0.004 up to failure. `SimplifiedNewton` and `Newton` solve the same
steps from the same states. The command then takes single steps from many states of
systems with steep potentials, and of a body in a chart that the step may leave. An
accepted step is judged by three figures that are computed here:

- the residual of the stage equations at the computed stages, relative to the size of
  its terms;
- the violation of the constraints at the end, relative to the size of their terms;
- the distance between the states that the two solvers find at the end of the step. If
  only one solver accepts the step, the distance is the change of its stages in one more
  iteration of Newton's method.

Accepted steps with a residual above 1e-13, or with a distance of more than 1e-11, are
doubtful and are judged again. Newton's method solves such a step again from other
starts: in each of them one number of the start is moved by one unit in the last place.
The sum of the distances by which these moves change the end is called the floor, and is
at least the unit round-off. A float64 start is not known more accurately than this. A
step is solved if its distance is within 400 floors, because the solvers treat 400 units
of round-off as noise. The other doubtful steps are solved too if their residual is at
most 1e-13. In this case the equations have two solutions if the distance is more than
1e-3; otherwise their Jacobian is nearly singular. If the coordinates are so large that
the distance overflows, the residual decides. All other doubtful steps are wrongly
accepted.

The terms of an equation r(x; q) = 0 have the size |∂r/∂x| |x| + |∂r/∂q| |q|. In |x|
each unknown is replaced by the largest absolute value of its kind: of the velocities,
of the multipliers and so on. A residual below this size times the unit round-off cannot
be required (Oettli and Prager, 1964). An acceleration counts by its effect in a step:
its size |u̇| is at least |u| / h.

`--only starts` counts how often `initial_state(..., project=True)` refuses a state near
the constraints. Each system of the gallery with constraints gets states that are moved
by 0 to 1e-2 in random directions: in q or in v, also for states at rest. There are two
ways to move q: by its entries, as rounding would, and along the group. States moved by
less than 1e-3 must not be refused. A separate test uses unit vectors that are rounded
to ten digits.

`--only near_zero` uses states near zero, for constraints that contain constants. The
true round-off of a constraint at a state is the largest difference between its value in
float64 and in 50 digits, at nine states nearby. `initial_state` gets states that
violate the constraint by 0, 10 and 1000 times this round-off, without projection.
"""

import argparse
import datetime
import json
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

import nhjax
from nhjax import systems
from nhjax._method import AbstractMethod
from nhjax._numerics import max_norm, NOISE_UNITS, nonzero_or_one
from nhjax._step import StepOutcome, StepState
from nhjax._step._equations import (
    stage_residual,
    StageEquations,
    StageUnknowns,
    with_moved_positions,
)
from nhjax._step._step import equations_of_step
from nhjax._system import position_scale, violation_scale
from nhjax.systems._base import AbstractExample

from . import near_rest
from ._examples import of_the_gallery
from ._high_precision import evaluate, to_float
from ._random_systems import random_systems
from ._report import add_keep, markdown_table, number, RESULTS, with_saved, write


SMALLEST, LARGEST, SIZES = 0.004, 4.0, 10
ALLOWED, SAME, FAR = 1e-13, 1e-11, 1e-3
JUDGEMENTS = "at the floor", "two solutions", "nearly singular", "overflow", "wrong"
# The largest numbers of stages: programs with more stages take many minutes to compile.
MOST_STAGES = {"Whipple bicycle": 3}
NUDGE = 2.0**-26


def gallery() -> dict[str, Callable]:
    """Return systems of the gallery by name, each with an initial state."""
    cvt = systems.ContinuouslyVariableTransmission
    named = {"CVT low": cvt.low, "CVT high": cvt.high}
    others = [
        systems.Appell,
        systems.ChaoticSystem,
        systems.ChaplyginSleigh,
        systems.DoublePendulum,
        systems.FreeRigidBody,
        systems.HarmonicOscillator,
        systems.HeavyTop,
        systems.HeavyTopSE3,
        systems.KnifeEdge,
        systems.NonholonomicParticle,
        systems.RodSleigh,
        systems.RollingDisc,
        systems.SphericalPendulum,
        systems.Suslov,
        systems.TurntableBall,
        systems.Unicycle,
        systems.UnicycleInCoordinates,
        systems.VerticalRollingDisc,
    ]
    named |= {example.__name__: example for example in others}
    made = {name: of_the_gallery(example) for name, example in named.items()}
    return made | {"Whipple bicycle": of_the_gallery(systems.WhippleBicycle)}


class Judged(NamedTuple):
    """A step of one solver: its result, and how well it is solved."""

    result: Array
    num_iterations: Array
    residual: Array
    correction: Array
    violation: Array


class Row(NamedTuple):
    """One step by both solvers, and the distance between the two ends."""

    start: nhjax.State
    simplified: Judged
    newton: Judged
    distance: Array


def compared(
    start: nhjax.State,
    stages: StageEquations,
    simplified: StepOutcome,
    newton: StepOutcome,
) -> Row:
    """Judge both solvers on one step."""
    judged = judge(stages, simplified), judge(stages, newton)
    return Row(start, *judged, apart(simplified, newton))


def judge(stages: StageEquations, outcome: StepOutcome) -> Judged:
    """Compute the figures of a step from its computed stages and its end."""
    residual, correction = residual_and_correction(stages, outcome.stages)
    return Judged(
        jnp.asarray(outcome.result._value),
        outcome.num_iterations,
        residual,
        correction,
        relative_violation(stages, outcome.step_state),
    )


def residual_and_correction(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute the relative residual of the stage equations, and a Newton correction.

    The residual is the largest ratio of an equation's residual to the size of its
    terms. The correction is the change of the velocities in one step of Newton's
    method, relative to their size.
    """
    z, unravel = ravel_pytree(x)

    def equations(z, stages):
        return stage_residual(stages, unravel(z))[0]

    r = equations(z, stages)
    jacobian = jax.jacfwd(equations)(z, stages)
    moved = equations(z, with_moved_positions(stages, jnp.asarray(NUDGE)))
    sizes = block_sizes(stages, x)
    terms = jnp.abs(jacobian) @ sizes + jnp.abs(moved - r) / NUDGE
    # Equations are divided by the sizes of their terms, and unknowns by their sizes, so
    # that the linear system neither overflows nor underflows.
    rows, columns = nonzero_or_one(terms), nonzero_or_one(sizes)
    scaled = jacobian * columns[None] / rows[:, None]
    change = unravel(columns * jnp.linalg.solve(scaled, -r / rows))
    correction = max_norm(change.velocity, change.node_fibre_coordinate) / (
        1 + max_norm(x.velocity, x.node_fibre_coordinate)
    )
    return largest_ratio(r, terms), correction


def block_sizes(stages: StageEquations, x: StageUnknowns) -> Float[Array, " k"]:
    """Return, for each unknown, the largest absolute value of its kind."""
    sizes = jax.tree.map(max_norm, x)
    slowest = sizes.node_fibre_coordinate / jnp.abs(stages.h)
    sizes = eqx.tree_at(
        lambda sizes: sizes.end_acceleration,
        sizes,
        jnp.maximum(sizes.end_acceleration, slowest),
    )
    return ravel_pytree(jax.tree.map(jnp.full_like, x, sizes))[0]


def relative_violation(
    stages: StageEquations, step_state: StepState
) -> Float[Array, ""]:
    """Compute the largest ratio of a constraint's violation to the size of its terms.

    The constraints are evaluated at the end of the step.
    """
    system, t, args = stages.system, stages.t + stages.h, stages.args
    q, u = step_state.state.q, system.fibre_coordinate(step_state.state)
    manifold = system.manifold_of(q)

    def on_velocities(q):
        return system.constraint(t, q, u, args)

    _, rates = jax.vmap(
        lambda xi: jax.jvp(
            lambda xi: on_velocities(manifold.act(q, xi)), (jnp.zeros_like(u),), (xi,)
        )
    )(jnp.eye(u.size))
    size = jnp.max(jnp.abs(ravel_pytree(q)[0]))
    terms = violation_scale(system, step_state.lin, t, q, u, args)
    terms = terms + jnp.sum(jnp.abs(rates), axis=0) * size
    positions = system.position_constraint(t, q, args)
    return jnp.maximum(
        largest_ratio(on_velocities(q), terms),
        largest_ratio(positions, position_scale(system, t, q, args)),
    )


def largest_ratio(x: Array, scale: Array) -> Float[Array, ""]:
    """Compute max |x| / scale, where 0 / 0 counts as 0."""
    return jnp.max(jnp.abs(x) / jnp.where(x == 0, 1, scale), initial=0)


@eqx.filter_jit
def run(
    system: nhjax.LagrangianSystem,
    method: AbstractMethod,
    y0: nhjax.State,
    sizes: Float[Array, " k"],
    num_steps: int,
) -> tuple[Row, Array]:
    """Take `num_steps` steps of each size with both solvers.

    Also returns, for each step, whether all steps before it were accepted by at least
    one solver.
    """
    solvers = nhjax.SimplifiedNewton(), nhjax.Newton()

    def of_size(h):
        def advance(carry, k):
            step_state, alive = carry
            arguments = replace(start, t=k * h, step_state=step_state)
            stages = equations_of_step(arguments, method)
            first, second = (
                near_rest.take_step(arguments, method, solver) for solver in solvers
            )
            row = compared(step_state.state, stages, first, second)
            good = first.result == nhjax.RESULTS.successful
            # If `SimplifiedNewton` fails, the run continues with the end of `Newton`.
            other = second.result == nhjax.RESULTS.successful
            step_state = jax.tree.map(
                lambda old, a, b: jnp.where(good, a, jnp.where(other, b, old)),
                step_state,
                first.step_state,
                second.step_state,
            )
            return (step_state, alive & (good | other)), (row, alive)

        start = near_rest.first_arguments(system, method, y0, h)
        steps = jnp.arange(num_steps, dtype=h.dtype)
        carry = start.step_state, jnp.asarray(True)
        _, rows = jax.lax.scan(advance, carry, steps)
        return rows

    return jax.lax.map(of_size, sizes)


@eqx.filter_jit
def single_steps(
    system: nhjax.LagrangianSystem,
    method: AbstractMethod,
    starts: nhjax.State,
    sizes: Float[Array, " k"],
) -> Row:
    """Take one step from each state with both solvers; each state has its own size."""
    solvers = nhjax.SimplifiedNewton(), nhjax.Newton()

    def one(start):
        arguments = near_rest.first_arguments(system, method, *start)
        stages = equations_of_step(arguments, method)
        first, second = (
            near_rest.take_step(arguments, method, solver) for solver in solvers
        )
        return compared(start[0], stages, first, second)

    return jax.lax.map(one, (starts, sizes))


def steep_systems() -> dict[str, tuple[nhjax.LagrangianSystem, Callable]]:
    """Return systems for which iterations are difficult, with random configurations.

    The second entry is a function of (generator, k) that draws k configurations.
    """

    def particle(potential):
        return nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - potential(q))

    def away_from_zero(generator, k):
        return jnp.asarray(generator.uniform(0.4, 2.0, (k, 2)))

    body = nhjax.LagrangianSystem(
        lambda t, q, v, args: (
            0.5 * v @ (jnp.array([1.0, 2.0, 2.5]) * v) - nhjax.SO3().matrix(q)[0, 0]
        ),
        manifold=nhjax.SO3(retraction=nhjax.Exponential()),
    )

    def at_rest(generator, k):
        return jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (k, 1))

    return {
        "wall": (particle(lambda q: jnp.sum(q**-12.0)), away_from_zero),
        "Morse": (
            particle(lambda q: jnp.sum((1 - jnp.exp(-4 * (q - 1))) ** 2)),
            away_from_zero,
        ),
        "Kepler": (particle(lambda q: -1 / jnp.sqrt(q @ q + 1e-4)), away_from_zero),
        "body, exponential": (body, at_rest),
    }


def measure_starts(name: str, stages: int, number: int, seed: int = 0) -> dict:
    """Measure single steps from `number` random states, with h from 1e-3 to 3."""
    system, draw = steep_systems()[name]
    generator = np.random.default_rng(seed)
    q = draw(generator, number)
    n = system.manifold_of(q[0]).dim
    v = jnp.asarray(2 * generator.standard_normal((number, n)))
    sizes = jnp.asarray(10 ** generator.uniform(-3, 0.5, number))
    starts = jax.vmap(lambda q, v: nhjax.initial_state(system, q, v))(q, v)
    method = nhjax.LobattoIIIAB(stages)
    rows = single_steps(system, method, starts, sizes)
    figures = table_row(rows, np.ones(number, bool))
    figures |= judge_doubtful(system, method, rows, np.asarray(sizes))
    return {"system": name, "stages": stages} | figures


def apart(first: StepOutcome, second: StepOutcome) -> Float[Array, ""]:
    """Compute the distance between the ends of two steps, relative to their size."""
    parts = []
    for name in ("q", "p"):
        a, b = (
            ravel_pytree(getattr(x.step_state.state, name))[0] for x in (first, second)
        )
        parts.append(jnp.max(jnp.abs(a - b)) / (1 + jnp.max(jnp.abs(b))))
    return jnp.max(jnp.stack(parts))


FAILURES = {
    "slow": nhjax.RESULTS.nonlinear_max_iterations,
    "diverged": nhjax.RESULTS.nonlinear_divergence,
    "left chart": nhjax.RESULTS.left_chart,
}


def accepted_steps(rows: Row, alive: np.ndarray) -> list[np.ndarray]:
    """Return which steps each solver accepts."""
    code = int(nhjax.RESULTS.successful._value)
    return [
        alive & (np.asarray(judged.result) == code)
        for judged in (rows.simplified, rows.newton)
    ]


def distances(rows: Row, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the distances between ends that both solvers accept.

    If only one solver accepts a step, the distance is its Newton correction.
    """
    alone = np.where(first, rows.simplified.correction, rows.newton.correction)
    return np.where(first & second, rows.distance, alone)


def table_row(rows: Row, alive: np.ndarray) -> dict[str, float | int]:
    """Count the results of the steps, and find the worst figures of accepted steps."""
    figures: dict[str, float | int] = {}
    first, second = accepted_steps(rows, alive)
    for name, judged, good in (
        ("simplified", rows.simplified, first),
        ("newton", rows.newton, second),
    ):
        result = np.asarray(judged.result)
        figures[f"{name} accepted"] = int(np.sum(good))
        for failure, code in FAILURES.items():
            count = np.sum(alive & (result == int(code._value)))
            figures[f"{name} {failure}"] = int(count)
        counted = sum(figures[f"{name} {key}"] for key in ("accepted", *FAILURES))
        figures[f"{name} other"] = int(np.sum(alive) - counted)
        for figure in ("residual", "violation"):
            values = np.asarray(getattr(judged, figure))[good]
            figures[f"{name} {figure}"] = float(np.max(values, initial=0))
    distance = distances(rows, first, second)[first | second]
    figures["distance"] = float(np.max(distance, initial=0))
    # A distance that is NaN counts as a difference.
    figures["apart"] = int(np.sum(~(distance <= SAME)))
    return figures


def judge_doubtful(
    system: nhjax.LagrangianSystem,
    method: AbstractMethod,
    rows: Row,
    sizes: np.ndarray,
    alive: np.ndarray | bool = True,
) -> dict[str, dict[str, float | int]]:
    """Judge the doubtful steps, and return their number, judgements and extremes."""
    first, second = accepted_steps(rows, np.broadcast_to(alive, sizes.shape))
    distance = distances(rows, first, second)
    residuals = [
        np.where(good, judged.residual, 0)
        for judged, good in ((rows.simplified, first), (rows.newton, second))
    ]
    residual = np.maximum(*residuals)
    is_doubtful = (first | second) & ~((distance <= SAME) & (residual <= ALLOWED))
    counts = dict.fromkeys(JUDGEMENTS, 0)
    extremes = {"least h": np.inf, "largest distance": 0.0, "most floors": 0.0}
    for place in map(tuple, np.argwhere(is_doubtful)):
        start = jax.tree.map(lambda x, place=place: x[place], rows.start)
        h = sizes[place]
        moved = float(moved_by_last_digit(system, method, start, jnp.asarray(h)))
        d, floor = float(distance[place]), max(moved, float(np.finfo(float).eps))
        extremes["least h"] = min(extremes["least h"], float(h))
        if d <= NOISE_UNITS * floor:
            judgement = "at the floor"
            extremes["largest distance"] = max(extremes["largest distance"], d)
            extremes["most floors"] = max(extremes["most floors"], d / floor)
        elif not residual[place] <= ALLOWED:
            judgement = "wrong"
        elif np.isnan(d):
            judgement = "overflow"
        else:
            judgement = "two solutions" if d > FAR else "nearly singular"
        counts[judgement] += 1
    return {"doubtful": counts | extremes} if is_doubtful.any() else {}


@eqx.filter_jit
def moved_by_last_digit(
    system: nhjax.LagrangianSystem,
    method: AbstractMethod,
    start: nhjax.State,
    h: Float[Array, ""],
) -> Float[Array, ""]:
    """Compute how far the end of a step moves if its start moves by one last digit.

    Each nonzero number of the start is moved alone by one unit in the last place. The
    resulting distances between ends, relative to the size of the end, are added. The
    numbers are not moved together, because their effects can cancel: if both ends of a
    rod move by the same vector, its direction does not change.
    """
    z, unravel = ravel_pytree(start)
    moves = jnp.asarray(np.eye(len(z) + 1, len(z), -1))
    eps = float(jnp.finfo(z.dtype).eps)

    def end(move):
        arguments = near_rest.first_arguments(
            system, method, unravel(z * (1 + eps * move)), h
        )
        return near_rest.take_step(arguments, method, nhjax.Newton())

    ends = jax.lax.map(end, moves)
    first, others = (
        jax.tree.map(lambda x, k=k: x[k], ends) for k in (0, slice(1, None))
    )
    return jnp.sum(jax.vmap(apart, (0, None))(others, first))


def measure(name: str, stages: int, make: Callable, num_steps: int) -> dict:
    """Measure the steps of one system with one number of stages."""
    system, y0 = make()
    sizes = jnp.asarray(np.geomspace(SMALLEST, LARGEST, SIZES))
    method = nhjax.LobattoIIIAB(stages)
    rows, alive = run(system, method, y0, sizes, num_steps)
    figures = table_row(rows, np.asarray(alive))
    each = np.broadcast_to(np.asarray(sizes)[:, None], alive.shape)
    figures |= judge_doubtful(system, method, rows, each, np.asarray(alive))
    return {"system": name, "stages": stages} | figures


FIGURES = ("accepted", *FAILURES, "other", "residual", "violation")
COLUMNS = {
    f"{name}: {figure}": f"{solver} {figure}"
    for name, solver in (("simplified", "simplified"), ("Newton", "newton"))
    for figure in FIGURES
} | {"distance": "distance", "apart": "apart"}


# Starts -------------------------------------------------------------------------------

OFFSETS = (0.0, *(10.0**k for k in range(-16, -1)))
LARGEST_THAT_MUST_PASS = 1e-4


def constrained() -> Iterator[AbstractExample]:
    """Yield the systems of the gallery with constraints, with default parameters."""
    for make in near_rest.examples().values():
        system = (example := make()).system
        if system.nonholonomic is not None or system.holonomic is not None:
            yield example


def cast(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point arrays of a tree to a precision."""
    return jax.tree.map(
        lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree
    )


def direction(rng: np.random.Generator, like: Any) -> Any:
    """Draw a random direction of length one with the structure of a tree."""
    parts = jax.tree.map(lambda x: rng.normal(size=x.shape), like)
    size = np.sqrt(sum(np.sum(x**2) for x in jax.tree.leaves(parts)))
    return jax.tree.map(lambda x, y: jnp.asarray(x / size, y.dtype), parts, like)


def disturbed(
    system: Any, kind: str, q: Any, v: Any, offset: float, rng: np.random.Generator
) -> tuple[Any, Any]:
    """Move q or v by `offset` in a random direction."""
    if kind == "q":
        step = direction(rng, q)
        return jax.tree.map(lambda x, dx: x + offset * dx, q, step), v
    along = offset * direction(rng, v)
    if kind == "q, along the group":
        return system.manifold_of(q).act(q, along), v
    return q, v + along


def kinds(example: AbstractExample) -> list[str]:
    """List the parts of the state that are disturbed.

    States at rest are used only if the constraints are linear in v.
    """
    flat = example.system.manifold_of(example.q0).is_flat
    along = [] if flat else ["q, along the group"]
    rest = [] if isinstance(example, systems.Appell) else ["v, at rest", "q, at rest"]
    return ["q", *along, "v", *rest]


def refused(start: Callable[..., nhjax.State], *given: Any) -> bool:
    """Return whether a state is refused or is not finite."""
    try:
        y = start(*given)
        return not all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(y))
    except (RuntimeError, ValueError):  # JAX may raise either of them
        return True


def count_near_constraints(
    example: AbstractExample, dtype: Any, directions: int, offsets=OFFSETS
) -> dict[str, list[int]]:
    """Count the refused states for each kind of disturbance and each offset."""
    system, rng = cast(example.system, dtype), np.random.default_rng(0)
    start = jax.jit(lambda q, v: nhjax.initial_state(system, q, v, project=True))
    there = start(*cast((example.q0, example.v0), dtype))
    away = start(*disturbed(system, "q", there.q, there.v, 0.2, rng))
    table = {}
    for kind in kinds(example):
        table[kind] = []
        for offset in offsets:
            given = []
            for i in range(directions):
                base = (there, away)[i % 2]
                v = jnp.zeros_like(base.v) if kind.endswith("rest") else base.v
                what = kind.removesuffix(", at rest")
                given.append(disturbed(system, what, base.q, v, offset, rng))
            table[kind].append(sum(refused(start, q, v) for q, v in given))
    return table


def rounded_unit_vectors(number: int) -> int:
    """Count the unit vectors, rounded to ten digits, that a pendulum refuses."""
    system, rng = systems.SphericalPendulum().system, np.random.default_rng(0)
    start = jax.jit(lambda q, v: nhjax.initial_state(system, q, v, project=True))
    zeros = jnp.zeros(3)
    return sum(
        refused(start, jnp.round(direction(rng, zeros), 10), zeros)
        for _ in range(number)
    )


def measure_near_constraints(directions: int) -> dict[str, Any]:
    """Count refused states of all systems, and refused rounded unit vectors."""
    rows = []
    for example in constrained():
        name = type(example).__name__
        for dtype in (jnp.float64, jnp.float32):
            table = count_near_constraints(example, dtype, directions)
            for kind, counts in table.items():
                about = {"system": name, "dtype": dtype.__name__, "disturbed": kind}
                rows.append(about | {"refused": counts})
                print(rows[-1], flush=True)
        jax.clear_caches()
    return {
        "directions": directions,
        "offsets": OFFSETS,
        "rounded_unit_vectors_refused": rounded_unit_vectors(1000),
        "rows": rows,
    }


UNITS = 0, 10, 1000
POSITION_SIZES = 1e-12, 1e-9, 1e-6, 1e-3


class Case(NamedTuple):
    """A holonomic constraint, and the coordinate that it determines.

    `constraint` is a function of q. It is linear in the coordinate `place`, with the
    given slope.
    """

    constraint: Callable[[Any], Any]
    num_coordinates: int
    place: int
    slope: float


def _wheel(q):
    """Compute the height of a wheel of radius 0.3 m with a small lean and pitch."""
    axle = jnp.sin(q[1]) * jnp.cos(q[2])
    return q[0] + 0.3 - 0.3 * jnp.sqrt(1 - axle**2)


def _beside_a_constant(q):
    """Compute a constraint in which a small number is added to 100, and squared."""
    return ((100 + q[1] / 100) ** 2 - 100**2) * jnp.cos(q[2]) - q[0]


CASES = {
    "height of a frame": Case(
        lambda q: (1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0], 3, 0, -1.0
    ),
    "height of a wheel": Case(_wheel, 3, 0, 1.0),
    "beside a constant": Case(_beside_a_constant, 3, 0, -1.0),
    "length of a rod": Case(
        lambda q: (1 + q[0]) ** 2 + q[1] ** 2 + q[2] ** 2 - 1 - 2 * q[3], 4, 3, -2.0
    ),
}


def exact(case: Case, q: np.ndarray) -> float:
    """Evaluate a constraint in 50 digits, and round the result."""
    return float(to_float(evaluate(case.constraint, jnp.asarray(q))))


def true_round_off(
    case: Case, q: np.ndarray, size: float, rng: np.random.Generator
) -> float:
    """Find the true round-off of a constraint near a state."""
    errors = []
    for _ in range(9):
        near = q + 0.3 * size * rng.uniform(-1, 1, q.size)
        errors.append(
            abs(float(case.constraint(jnp.asarray(near))) - exact(case, near))
        )
    return max(errors)


def count_near_zero(case: Case, number: int) -> list[dict[str, Any]]:
    """Count the refused starts for each size of q and each violation."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: case.constraint(q)[None],
    )
    start = jax.jit(
        lambda q: nhjax.initial_state(system, q, jnp.zeros_like(q), throw=False)
    )
    rng, rows = np.random.default_rng(0), []
    for size in POSITION_SIZES:
        counts = dict.fromkeys(UNITS, 0)
        for _ in range(number):
            q = size * rng.uniform(-1, 1, case.num_coordinates)
            q[case.place] = 0.0
            q[case.place] -= exact(case, q) / case.slope
            unit = true_round_off(case, q, size, rng)
            for units in UNITS:
                moved = q.copy()
                moved[case.place] += units * unit / case.slope * rng.choice([-1, 1])
                counts[units] += refused(start, jnp.asarray(moved))
        rows.append({"size": size, "number": number, "refused": counts})
    return rows


# The command --------------------------------------------------------------------------


def measure_steps(options: argparse.Namespace) -> list[dict]:
    """Measure the steps of the systems and stages that the options ask for."""
    # The programs run for seconds only, but optimising them would take minutes.
    jax.config.update("jax_disable_most_optimizations", True)
    wanted = options.systems or [""]
    makers = {
        name: make
        for name, make in (gallery() | random_systems()).items()
        if any(part in name for part in wanted)
    }
    data = []
    for name, make in makers.items():
        for stages in options.stages:
            if stages > MOST_STAGES.get(name, stages):
                continue
            data.append(measure(name, stages, make, options.num_steps))
            print(data[-1], flush=True)
            jax.clear_caches()
    for name in steep_systems():
        if any(part in name for part in wanted):
            for stages in options.stages:
                data.append(measure_starts(name, stages, options.starts))
                print(data[-1], flush=True)
    jax.config.update("jax_disable_most_optimizations", False)
    return with_saved("acceptance", data) if options.keep else data


PARTS = ("steps", "starts", "near_zero")


def main() -> None:
    """Measure the requested parts; save them with the saved data of the other parts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only",
        nargs="*",
        choices=PARTS,
        default=PARTS,
        help="the parts to measure; without a name, the saved tables are printed again",
    )
    parser.add_argument("--systems", nargs="+", help="of steps: parts of names")
    parser.add_argument("--stages", type=int, nargs="+", default=[2, 3, 4, 5, 6])
    parser.add_argument("--num-steps", type=int, default=200, help="of each size")
    parser.add_argument("--starts", type=int, default=3000, help="of steep systems")
    parser.add_argument("--directions", type=int, default=50, help="of starts")
    add_keep(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # Otherwise JAX logs a line for each refusal.
    logging.getLogger("jax._src.callback").disabled = True
    path = RESULTS / "acceptance.json"
    saved = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    dates = saved.get("dates", {})
    dates |= dict.fromkeys(options.only, datetime.date.today().isoformat())
    data: dict[str, Any] = {
        key: saved.get(key) for key in ("rows", "starts", "near_zero")
    }
    if "steps" in options.only:
        data["rows"] = measure_steps(options)
    if "starts" in options.only:
        data["starts"] = measure_near_constraints(options.directions)
    if "near_zero" in options.only:
        data["near_zero"] = [
            {"constraint": name} | row
            for name, case in CASES.items()
            for row in count_near_zero(case, options.directions)
        ]
    sections = [
        (__doc__ or "").strip(),
        f"## Steps\n\nMeasured on {dates['steps']}. {summary(data['rows'])}",
        table_of_steps(data["rows"]),
        f"### Doubtful steps\n\n{table_of_doubtful(data['rows'])}",
        f"## Starts\n\nMeasured on {dates['starts']}. {of_starts(data['starts'])}",
        f"## Starts near zero\n\nMeasured on {dates['near_zero']}; refused of "
        f"{data['near_zero'][0]['number']}:",
        table_near_zero(data["near_zero"]),
    ]
    title = "Are accepted steps solved, and good starts accepted?"
    write("acceptance", title, "\n\n".join(sections), {"dates": dates} | data)


def table_of_steps(data: list[dict]) -> str:
    """Return the table of all steps."""
    rows = []
    for row in data:
        figures = [row[key] for key in COLUMNS.values()]
        rows.append([row["system"], str(row["stages"]), *map(_cell, figures)])
    return markdown_table(["system", "s", *COLUMNS], rows)


def _cell(x: Any) -> str:
    if x is None:
        return "nan"  # JSON has no NaN.
    return number(x) if isinstance(x, float) else str(x)


def table_of_doubtful(data: list[dict]) -> str:
    """Return text and a table with the judgements of the doubtful steps."""
    found = [row for row in data if row.get("doubtful")]
    total = {key: sum(row["doubtful"][key] for row in found) for key in JUDGEMENTS}
    text = f"{sum(total.values())} steps are doubtful: "
    text += ", ".join(f"{count} {key}" for key, count in total.items()) + "."
    keys = [*JUDGEMENTS, "least h", "largest distance", "most floors"]
    rows = [
        [row["system"], str(row["stages"]), *(_cell(row["doubtful"][k]) for k in keys)]
        for row in found
    ]
    return f"{text}\n\n{markdown_table(['system', 's', *keys], rows)}"


def of_starts(starts: dict[str, Any]) -> str:
    """Return text on the number of refused starts, and a table of these cases."""
    rows = starts["rows"]
    worst = max(
        x
        for row in rows
        for offset, x in zip(OFFSETS, row["refused"], strict=True)
        if offset <= LARGEST_THAT_MUST_PASS
    )
    text = (
        f"{len(rows)} combinations of a system, a precision and a disturbance, with "
        f"{starts['directions']} states for each of {len(OFFSETS)} offsets from 0 to "
        f"{OFFSETS[-1]:.0e}: at most {worst} states of one combination and offset "
        "below 1e-3 are refused. Of 1000 unit vectors rounded to ten digits, "
        f"{starts['rounded_unit_vectors_refused']} are refused."
    )
    cells = [
        [row["system"], row["dtype"], row["disturbed"], *map(str, row["refused"])]
        for row in rows
        if any(row["refused"])
    ]
    if not cells:
        return f"{text} No state was refused at any offset."
    header = ["system", "dtype", "disturbed", *(f"{x:.0e}" for x in OFFSETS)]
    return f"{text} The combinations with refusals:\n\n{markdown_table(header, cells)}"


def table_near_zero(data: list[dict[str, Any]]) -> str:
    """Return the table of the starts near zero."""
    header = ["constraint", "size of q", *(f"{k} units" for k in UNITS)]
    rows = [
        [row["constraint"], f"{row['size']:.0e}", *map(str, row["refused"].values())]
        for row in data
    ]
    return markdown_table(header, rows)


def summary(data: list[dict]) -> str:
    """Summarise the table of steps in words."""
    worst = max(
        row[f"{solver} {figure}"] or 0.0
        for row in data
        for solver in ("simplified", "newton")
        for figure in ("residual", "violation")
    )
    counted = "simplified accepted", "newton accepted", "apart"
    total = {key: sum(row[key] for row in data) for key in counted}
    return (
        f"{total['simplified accepted']} steps accepted by `SimplifiedNewton`, "
        f"{total['newton accepted']} by `Newton`; the largest relative residual or "
        f"violation of any is {number(worst)} (asked: {number(ALLOWED)}). The ends of "
        f"the two solvers differ by more than {number(SAME)} in {total['apart']} steps."
    )


if __name__ == "__main__":
    main()
