"""Steps near rest, judged in 50 digits: are any refused or accepted wrongly?

Near rest, velocities are small. The functions of a system also contain constants, such
as a wheel's radius or a weight, whose round-off does not become small. Each system
starts from its default state with v scaled by 1e-8 to 1, and takes steps of four sizes
over three decades with both solvers, compiled. All refused steps are judged, and a
sample of the accepted steps.

A step is judged at the last stages of the solver, whether it accepts them or not. The
stage equations are evaluated there in 50 digits. Newton's correction with these values
is the distance from the solution. The noise is the error that no iteration in float64
can remove. It is Newton's correction for the errors of the float64 values, at the same
stages and at four others that are moved by a few units of the last digit. Distance and
noise are measured in units of velocities, as in the solvers, and the noise is at least
one unit of the last digit of the velocities.

A refused step whose distance is at most `SOLVED` times the noise should have been
accepted. An accepted step whose distance is more than `DOUBTFUL` times the noise is
judged again, with a larger noise. If the position at the start of the step moves by one
unit in the last place, the solution moves too. This movement now counts as noise,
because float64 does not represent the start more accurately. If the distance is still
more than `DOUBTFUL` times the noise, the step should have been refused. If the noise is
more than `DETERMINED` times the velocities, for instance because iterates diverged, a
refusal is never wrong.

    python -m benchmarks.near_rest
"""

import argparse
import json
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
from nhjax._numerics import max_norm
from nhjax._step import first_step_state, ImplicitStep, StepArguments, StepOutcome
from nhjax._step._equations import stage_residual, StageUnknowns
from nhjax._step._jacobian import increment_size
from nhjax._step._step import equations_of_step
from nhjax._system import function_noise
from nhjax.systems._base import AbstractExample

from ._high_precision import evaluate, to_float
from ._report import add_keep, markdown_table, number, with_saved, write


SCALES = 1e-8, 1e-6, 1e-4, 1e-2, 1.0
SIZES = 1e-3, 1e-2, 1e-1, 1.0
SOLVED, DOUBTFUL, DETERMINED = 10, 100, 1e-8
SOLVERS = {"simplified": nhjax.SimplifiedNewton(), "newton": nhjax.Newton()}
NUM_STEPS = 10


class Tried(NamedTuple):
    """A step that was tried: its arguments, its last stages and its result."""

    arguments: StepArguments
    stages: Any
    code: Any
    num_iterations: Any


class Distance(NamedTuple):
    """The distance of stages from the solution, and the noise, in velocity units.

    `is_determined` is false if the noise is not small compared with the velocities.
    Then float64 cannot determine the solution of the step.
    """

    distance: float
    noise: float
    is_determined: bool

    @property
    def ratio(self) -> float:
        """Return the distance in units of the noise."""
        return self.distance / self.noise if self.noise > 0 else np.inf


def first_arguments(system, method, y0, h) -> StepArguments:
    """Create the arguments of the first step of a run, as `integrate` does."""
    zero = jnp.zeros_like(h)
    first = first_step_state(system, method, zero, y0, None)
    given = zero, y0.q, system.fibre_coordinate(y0), y0.multiplier, None, h
    noise = function_noise(system, *given)
    return StepArguments(system, zero, h, first, None, noise=noise)


def take_step(arguments: StepArguments, method, solver, skip=False) -> StepOutcome:
    """Take one step with a solver."""
    step = ImplicitStep(method=method, stage_solver=solver, skip=jnp.asarray(skip))
    return step.solve(arguments)


@eqx.filter_jit
def steps(system, method, solver, y0, h) -> Tried:
    """Take `NUM_STEPS` steps as `integrate` does, and stop at a step that fails."""
    first = first_arguments(system, method, y0, h)

    def advance(carry, k):
        step_state, alive = carry
        arguments = replace(first, t=k * h, step_state=step_state)
        outcome = take_step(arguments, method, solver, ~alive)
        good = alive & (outcome.result == nhjax.RESULTS.successful)
        after = jax.tree.map(
            lambda new, old: jnp.where(good, new, old), outcome.step_state, step_state
        )
        code = jnp.where(alive, outcome.result._value, -1)
        dynamic, _ = eqx.partition(arguments, eqx.is_array)
        tried = Tried(dynamic, outcome.stages, code, outcome.num_iterations)
        return (after, good), tried

    numbers = jnp.arange(NUM_STEPS, dtype=h.dtype)
    start = first.step_state, jnp.asarray(True)
    _, tried = jax.lax.scan(advance, start, numbers)
    return tried


@eqx.filter_jit
def equations(method, arguments: StepArguments, x: StageUnknowns) -> Float[Array, " k"]:
    """Evaluate all stage equations of a step."""
    return stage_residual(equations_of_step(arguments, method), x)[0]


@eqx.filter_jit
def jacobian_of_equations(method, arguments, x: StageUnknowns) -> Float[Array, "k k"]:
    """Differentiate all stage equations."""
    z, unravel = ravel_pytree(x)
    return jax.jacfwd(lambda z: equations(method, arguments, unravel(z)))(z)


@eqx.filter_jit
def size_of_change(
    method, arguments, x: StageUnknowns, dz: Float[Array, " k"]
) -> Array:
    """Measure a change of the unknowns as the solvers do."""
    z, unravel = ravel_pytree(x)
    stages = equations_of_step(arguments, method)
    return increment_size(stages, x, unravel(z + dz), arguments.step_state.lin)


def with_moved_start(arguments: StepArguments, rng: Any) -> StepArguments:
    """Move each number of the position at the start by one unit in the last place."""

    def moved(x):
        direction = rng.choice([-np.inf, np.inf], np.shape(x))
        return jnp.asarray(np.nextafter(np.asarray(x), direction))

    q = jax.tree.map(moved, arguments.step_state.state.q)
    return eqx.tree_at(lambda a: a.step_state.state.q, arguments, q)


@np.errstate(over="ignore", invalid="ignore")
def distance(
    method, arguments: StepArguments, x: StageUnknowns, *, with_start: bool = False
) -> Distance:
    """Compute the distance of stages from the solution of their step, and the noise.

    With `with_start`, the noise includes the rounding of the position at the start.
    """
    z, unravel = ravel_pytree(x)
    z = np.asarray(z)
    if not np.all(np.isfinite(z)):
        return Distance(np.inf, 0.0, False)
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    exact = evaluate(
        lambda dynamic, x: equations(method, eqx.combine(dynamic, static), x),
        dynamic,
        x,
    )
    jacobian = np.asarray(jacobian_of_equations(method, arguments, x))
    try:
        inverse = np.linalg.inv(jacobian)
    except np.linalg.LinAlgError:
        return Distance(np.inf, 0.0, False)

    def size(r):
        dz = jnp.asarray(inverse @ to_float(r))
        return float(size_of_change(method, arguments, x, dz))

    eps = float(np.finfo(z.dtype).eps)
    missed = [np.asarray(equations(method, arguments, x)) - exact]
    rng = np.random.default_rng(0)
    for _ in range(4):
        there = z * (1 + eps * rng.integers(-4, 5, z.size))
        # Subtract the change of the equations that the move itself causes: it is not
        # noise.
        r = equations(method, arguments, unravel(jnp.asarray(there)))
        missed.append(np.asarray(r) - jacobian @ (there - z) - exact)
        if with_start:
            moved = with_moved_start(arguments, rng)
            missed.append(np.asarray(equations(method, moved, x)) - exact)
    last_digit = eps * float(max_norm(x.node_fibre_coordinate, x.velocity))
    noise, step_state = max(last_digit, *map(size, missed)), arguments.step_state
    state, rate = step_state.state, step_state.lin.acceleration
    u = arguments.system.fibre_coordinate(state)
    scale = float(max_norm(u) + jnp.abs(arguments.h) * max_norm(rate))
    if not np.isfinite(noise):
        return Distance(np.inf, 0.0, False)
    return Distance(size(exact), noise, noise <= DETERMINED * scale)


def examples() -> dict[str, Callable]:
    """Return the systems of the gallery, each as a function without arguments."""
    made = {}
    for name in vars(systems):
        kind = getattr(systems, name)
        if isinstance(kind, type) and issubclass(kind, AbstractExample):
            made[name] = kind
    return made


def near_rest(
    name: str, stages: int, make: Callable, most: int
) -> Iterator[dict[str, Any]]:
    """Measure one system with one number of stages; yield a row per solver and scale.

    All refused steps of a row, and at most `most` accepted steps, are judged in 50
    digits.
    """
    example = make()
    system, y0 = example.system, example.initial_state()
    method = nhjax.LobattoIIIAB(stages)
    refusals = {
        int(getattr(nhjax.RESULTS, name)._value)
        for name in ("nonlinear_max_iterations", "nonlinear_divergence")
    }
    # The functions and shapes in the arguments are the same for all steps. They are
    # computed once, because `first_arguments` evaluates the system without compilation,
    # which takes far longer than judging a step.
    first = first_arguments(system, method, y0, jnp.asarray(SIZES[0]))
    static = eqx.filter(first, _is_no_array)
    for solver_name, solver in SOLVERS.items():
        for scale in SCALES:
            y = nhjax.initial_state(system, y0.q, scale * y0.v, project=True)
            row: dict[str, Any] = {"system": name, "stages": stages}
            row |= {"solver": solver_name, "scale": scale}
            row |= {"accepted": 0, "refused": 0, "other": 0, "most iterations": 0}
            kept: dict[str, list] = {"accepted": [], "refused": []}
            for size in SIZES:
                h = jnp.asarray(size)
                tried = steps(system, method, solver, y, h)
                for k, code in enumerate(np.asarray(tried.code)):
                    if code < 0:
                        continue
                    kind = "accepted" if code == 0 else "other"
                    kind = "refused" if int(code) in refusals else kind
                    row[kind] += 1
                    this = jax.tree.map(lambda x, k=k: x[k], tried)
                    if kind == "accepted":
                        count = int(this.num_iterations)
                        row["most iterations"] = max(row["most iterations"], count)
                    if kind in kept:
                        arguments = eqx.combine(this.arguments, static)
                        kept[kind].append((arguments, this.stages))
            row |= _judged(method, kept, most)
            yield row


def _is_no_array(x: Any) -> bool:
    return not eqx.is_array(x)


def _judged(method, kept: dict[str, list], most: int) -> dict[str, Any]:
    """Judge all refused steps, and `most` accepted steps at even distances."""
    found: dict[str, Any] = {}
    for kind, them in kept.items():
        number = most if kind == "accepted" else len(them)
        places = np.unique(np.linspace(0, len(them) - 1, number).round().astype(int))
        sample = [them[k] for k in places] if them else []
        ratios, wrong = [], 0
        for arguments, x in sample:
            d = distance(method, arguments, x)
            if kind == "accepted" or d.is_determined:
                ratios.append(d.ratio)
            if kind == "accepted" and d.ratio > DOUBTFUL:
                again = distance(method, arguments, x, with_start=True)
                wrong += again.ratio > DOUBTFUL
        found[f"{kind} judged"] = len(sample)
        if kind == "accepted":
            found["largest distance accepted"] = max(ratios, default=0.0)
            found["doubtful"] = sum(r > DOUBTFUL for r in ratios)
            found["wrongly accepted"] = wrong
        else:
            found["smallest distance refused"] = min(ratios, default=np.inf)
            found["wrongly refused"] = sum(r <= SOLVED for r in ratios)
    return found


COLUMNS = {
    "s": "stages",
    "solver": "solver",
    "v scaled by": "scale",
    "accepted": "accepted",
    "judged": "accepted judged",
    "largest distance": "largest distance accepted",
    "doubtful": "doubtful",
    "wrongly accepted": "wrongly accepted",
    "refused": "refused",
    "judged ": "refused judged",
    "smallest distance": "smallest distance refused",
    "wrongly refused": "wrongly refused",
    "other": "other",
    "most iterations": "most iterations",
}


def _cell(value: float | int | str | None) -> str:
    """Write a value of a row, or a dash where no refused step has a distance."""
    if value is None or value == np.inf:
        return "-"
    return number(value) if isinstance(value, float) else str(value)


def save(rows: list[dict[str, Any]]) -> None:
    """Print and save the table of all rows."""
    cells = [
        [row["system"]] + [_cell(row[key]) for key in COLUMNS.values()] for row in rows
    ]
    total = {
        key: sum(row[key] for row in rows)
        for key in (
            "accepted",
            "accepted judged",
            "doubtful",
            "wrongly accepted",
            "refused",
            "refused judged",
            "wrongly refused",
        )
    }
    summary = (
        "{accepted} steps were accepted, of which {accepted judged} were judged: "
        "{doubtful} are doubtful, and {wrongly accepted} were accepted wrongly. "
        "{refused} were refused, of which {refused judged} were judged: {wrongly "
        "refused} of them wrongly. Distances are in units of the noise."
    ).format(**total)
    text = "\n\n".join([(__doc__ or "").strip(), summary])
    text += "\n\n" + markdown_table(["system", *COLUMNS], cells)
    title = "Are steps near rest judged rightly?"
    write("near_rest", title, text, {"rows": rows})


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", help="names of systems")
    parser.add_argument("--stages", type=int, nargs="+", default=[2, 3, 4, 5, 6])
    parser.add_argument("--judged", type=int, default=1, help="accepted steps")
    add_keep(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # The programs run only for seconds, but optimising them would take minutes.
    jax.config.update("jax_disable_most_optimizations", True)
    rows: list[dict[str, Any]] = []
    for name, make in examples().items():
        for s in options.stages:
            if options.systems and name not in options.systems:
                continue
            for row in near_rest(name, s, make, options.judged):
                rows.append(row)
                print(json.dumps(row), flush=True)
            jax.clear_caches()
    save(with_saved("near_rest", rows) if options.keep else rows)


if __name__ == "__main__":
    main()
