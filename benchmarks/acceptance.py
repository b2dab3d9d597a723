"""A search for steps that are accepted though they are not solved.

Every system of the gallery, a bicycle and ten random systems, over steps from h = 0.004
up to failure, by `SimplifiedNewton` and by `Newton` from the same states; then single
steps from many states of systems with steep potentials, and of a body in a chart that
it may leave. A step that a solver accepts is judged by figures that are computed here:
the residual of the stage equations at the stages found, relative to the size of its
terms; the violation of the constraints at the end, relative to the size of theirs; and
the distance of the two solvers' ends. Where one solver alone accepts a step, the
distance is that of its stages from where one more iteration of Newton's method takes
them.

The terms of an equation r(x; q) = 0 have the size |∂r/∂x| |x| + |∂r/∂q| |q|, in which
|x| is the largest of the velocities, of the multipliers and so on: nothing smaller than
the unit round-off times that can be asked of r (Oettli and Prager, 1964). Accelerations
count by what they do in a step: |u̇| is at least |u| / h.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

import nhjax
from nhjax import systems
from nhjax._method import AbstractMethod
from nhjax._numerics import max_norm
from nhjax._step import step, StepOutcome, StepState
from nhjax._step._jacobian import stage_residual
from nhjax._step._stage_system import nudged, StageEquations
from nhjax._step._step import equations_of_step
from nhjax._step._unknowns import StageUnknowns
from nhjax._system import position_scale, violation_scale

from . import near_rest
from ._examples import of_the_gallery
from ._random_systems import random_systems
from ._report import add_keep, markdown_table, number, with_saved, write


SMALLEST, LARGEST, SIZES = 0.004, 4.0, 10
ALLOWED, SAME = 1e-13, 1e-11
# More stages than these take many minutes to compile.
MOST_STAGES = {"Whipple bicycle": 3}
NUDGE = 2.0**-26


def gallery() -> dict[str, Callable]:
    """The systems of the gallery, each with a state to start from."""
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
    """Both solvers on one step, and how far apart their ends are."""

    simplified: Judged
    newton: Judged
    distance: Array


def judge(stages: StageEquations, outcome: StepOutcome) -> Judged:
    """The figures of a step, from the stages and the state that were found."""
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
    """The largest residual of the stage equations over the size of its terms, and how
    far Newton's method would move the velocities, relative to their size.
    """
    z, unravel = ravel_pytree(x)

    def equations(z, stages):
        return stage_residual(stages, unravel(z))[0]

    r = equations(z, stages)
    jacobian = jax.jacfwd(equations)(z, stages)
    moved = equations(z, nudged(stages, jnp.asarray(NUDGE)))
    terms = jnp.abs(jacobian) @ block_sizes(stages, x) + jnp.abs(moved - r) / NUDGE
    change = unravel(jnp.linalg.solve(jacobian, -r))
    correction = max_norm(change.velocity, change.node_fibre_coordinate) / (
        1 + max_norm(x.velocity, x.node_fibre_coordinate)
    )
    return largest_ratio(r, terms), correction


def block_sizes(stages: StageEquations, x: StageUnknowns) -> Float[Array, " k"]:
    """For each unknown the size of the largest of its kind."""
    sizes = jax.tree.map(max_norm, x)
    slowest = sizes.node_fibre_coordinate / jnp.abs(stages.h)
    sizes = eqx.tree_at(
        lambda sizes: sizes.end_acceleration,
        sizes,
        jnp.maximum(sizes.end_acceleration, slowest),
    )
    return ravel_pytree(jax.tree.map(jnp.full_like, x, sizes))[0]


def relative_violation(stages: StageEquations, step_state: StepState) -> Float[Array, ""]:
    """The largest violation of a constraint at the end over the size of its terms."""
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
    """max |x| / scale, in which nothing over nothing is nothing."""
    return jnp.max(jnp.abs(x) / jnp.where(x == 0, 1, scale), initial=0)


@eqx.filter_jit
def run(
    system: nhjax.LagrangianSystem,
    method: AbstractMethod,
    y0: nhjax.State,
    sizes: Float[Array, " k"],
    num_steps: int,
) -> tuple[Row, Array]:
    """`num_steps` steps of each size, and whether the run was alive before each."""
    solvers = nhjax.SimplifiedNewton(), nhjax.Newton()
    go_on = jnp.asarray(False)

    def of_size(h):
        def advance(carry, k):
            step_state, alive = carry
            arguments = replace(start, t=k * h, step_state=step_state)
            stages = equations_of_step(arguments, method)
            first, second = (
                step(arguments, method, solver, go_on) for solver in solvers
            )
            row = Row(judge(stages, first), judge(stages, second), apart(first, second))
            good = first.result == nhjax.RESULTS.successful
            # Where the faster solver fails, the run goes on with the other one.
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
    """A step of its own size from each of the states, by both solvers."""
    go_on = jnp.asarray(False)
    solvers = nhjax.SimplifiedNewton(), nhjax.Newton()

    def one(start):
        arguments = near_rest.first_arguments(system, method, *start)
        stages = equations_of_step(arguments, method)
        first, second = (step(arguments, method, solver, go_on) for solver in solvers)
        return Row(judge(stages, first), judge(stages, second), apart(first, second))

    return jax.lax.map(one, (starts, sizes))


def steep_systems() -> dict[str, tuple[nhjax.LagrangianSystem, Callable]]:
    """Systems that lead iterations astray, each with a draw of configurations."""

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
    """The figures of single steps from many states, h from 1e-3 to 3."""
    system, draw = steep_systems()[name]
    generator = np.random.default_rng(seed)
    q = draw(generator, number)
    n = system.manifold_of(q[0]).dim
    v = jnp.asarray(2 * generator.standard_normal((number, n)))
    sizes = jnp.asarray(10 ** generator.uniform(-3, 0.5, number))
    starts = jax.vmap(lambda q, v: nhjax.initial_state(system, q, v))(q, v)
    rows = single_steps(system, nhjax.LobattoIIIAB(stages), starts, sizes)
    alive = np.ones(number, bool)
    return {"system": name, "stages": stages} | table_row(rows, alive)


def apart(first: StepOutcome, second: StepOutcome) -> Float[Array, ""]:
    """The distance of two ends, relative to their size."""
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


def table_row(rows: Row, alive: np.ndarray) -> dict[str, float | int]:
    """Counts of what became of the steps, and the worst figures of accepted ones."""
    figures: dict[str, float | int] = {}
    accepted = []
    for name, judged in (("simplified", rows.simplified), ("newton", rows.newton)):
        result = np.asarray(judged.result)
        good = alive & (result == int(nhjax.RESULTS.successful._value))
        figures[f"{name} accepted"] = int(np.sum(good))
        for failure, code in FAILURES.items():
            count = np.sum(alive & (result == int(code._value)))
            figures[f"{name} {failure}"] = int(count)
        counted = sum(figures[f"{name} {key}"] for key in ("accepted", *FAILURES))
        figures[f"{name} other"] = int(np.sum(alive) - counted)
        for figure in ("residual", "violation"):
            values = np.asarray(getattr(judged, figure))[good]
            figures[f"{name} {figure}"] = float(np.max(values, initial=0))
        accepted.append(good)
    first, second = accepted
    distance = np.where(
        first & second,
        rows.distance,
        np.where(first, rows.simplified.correction, rows.newton.correction),
    )[first | second]
    figures["distance"] = float(np.max(distance, initial=0))
    # What is not a number is not the same either.
    figures["apart"] = int(np.sum(~(distance <= SAME)))
    return figures


def measure(name: str, stages: int, make: Callable, num_steps: int) -> dict:
    """The figures of one system and one number of stages."""
    system, y0 = make()
    sizes = jnp.asarray(np.geomspace(SMALLEST, LARGEST, SIZES))
    rows, alive = run(system, nhjax.LobattoIIIAB(stages), y0, sizes, num_steps)
    return {"system": name, "stages": stages} | table_row(rows, np.asarray(alive))


FIGURES = ("accepted", *FAILURES, "other", "residual", "violation")
COLUMNS = {
    f"{name}: {figure}": f"{solver} {figure}"
    for name, solver in (("simplified", "simplified"), ("Newton", "newton"))
    for figure in FIGURES
} | {"distance": "distance", "apart": "apart"}


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", help="names, or parts of names")
    parser.add_argument("--stages", type=int, nargs="+", default=[2, 3, 4, 5, 6])
    parser.add_argument("--num-steps", type=int, default=200, help="of each size")
    parser.add_argument("--starts", type=int, default=3000, help="of steep systems")
    add_keep(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # The programs run for seconds and would be optimised for minutes.
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
    save(with_saved("acceptance", data) if options.keep else data)


def save(data: list[dict]) -> None:
    """Print and save the table of all rows."""
    rows = []
    for row in data:
        figures = [row[key] for key in COLUMNS.values()]
        cells = [number(x) if isinstance(x, float) else str(x) for x in figures]
        rows.append([row["system"], str(row["stages"]), *cells])
    header = ["system", "s", *COLUMNS]
    text = "\n\n".join([(__doc__ or "").strip(), summary(data)])
    text += "\n\n" + markdown_table(header, rows)
    write("acceptance", "Are accepted steps solved?", text, {"rows": data})


def summary(data: list[dict]) -> str:
    """What the table comes to."""
    worst = max(
        row[f"{solver} {figure}"]
        for row in data
        for solver in ("simplified", "newton")
        for figure in ("residual", "violation")
    )
    total = {key: sum(row[key] for row in data) for key in COLUMNS.values()}
    return (
        f"{total['simplified accepted']} steps accepted by `SimplifiedNewton`, "
        f"{total['newton accepted']} by `Newton`; the largest relative residual or "
        f"violation of any is {number(worst)} (asked: {number(ALLOWED)}). The ends of "
        f"the two solvers differ by more than {number(SAME)} in {total['apart']} steps."
    )


if __name__ == "__main__":
    main()
