"""Adaptive steps: error against steps and time, for motions with fast and slow phases.

Five motions have phases of very different speed: a rattleback that reverses its spin,
Euler's disc down to an inclination of 1e-3, an orbit with close passes and a
constraint, a whip of ten pendulums, and a bicycle that falls. Three other motions are
smooth, so that constant steps suit them. Each motion is run with constant steps, with
the PID controller, and with the reversible controller. If the equations are on a vector
space, two other solvers run them too: diffrax with its PID controller on the
index-reduced equations, and IDA of SUNDIALS on the equations with multipliers.

The error is the largest error of (q, v) at the end, relative to the size of the state.
The reference is a run with s = 6 and the tolerance 1e-12. The number of steps includes
rejected steps. Times are the least of three calls. All programs are compiled by
`jax.jit`, except the loop of IDA, which calls compiled residuals and Jacobians. For the
comparison at equal error, the steps of a ladder (the runs of one method with different
steps or tolerances) are interpolated in logarithms.

There are five more parts. `limits` computes the least number of steps with the same
error. `long` follows the energy of the orbit over t = 1e5 with
constant, PID and reversible steps, and draws docs/step_sizes.png. `rattleback` follows
the energy of a rattleback over 1000 s. `stages` measures
which number of stages reaches a given error fastest. `tolerance` compares errors
with tolerances for machines of the gallery, and draws docs/tolerances.png.
"""

import argparse
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from sksundae.ida import IDA

import nhjax
from nhjax import systems

from . import rolling
from ._report import end_of, least_time, markdown_table, number, RESULTS, write


LAST_BETA = 1e-3
PARTS = "cases", "limits", "long", "rattleback", "stages", "tolerance"
DOCS = Path(__file__).parent.parent / "docs"
SAVED = RESULTS / "adaptive_steps.json"


class Case(NamedTuple):
    """A motion: its system, its start, its end, and the steps that are tried.

    - `constant`: the numbers of constant steps.
    - `eps`: values of ε for the reversible controller.
    - `density`: the step density of the reversible controller, or None for its
        automatic density.
    - `is_smooth`: whether constant steps suit the motion.
    """

    system: Any
    start: nhjax.State
    t1: float
    constant: tuple[int, ...]
    eps: tuple[float, ...] = ()
    density: Callable[..., Any] | None = None
    is_smooth: bool = False
    stages: int = 4


def doubled(first: int, number: int) -> tuple[int, ...]:
    """Return `number` numbers of steps, each twice the number before it."""
    return tuple(first * 2**k for k in range(number))


def rattleback() -> Case:
    """Create a rattleback whose spin reverses."""
    stone = systems.Rattleback.spinning(5.0, (0.5, 0.5))
    eps = (1.2, 0.8, 0.4, 0.2, 0.1)
    return Case(stone.system, stone.initial_state(), 10.0, doubled(2000, 6), eps)


def eulers_disc() -> Case:
    """Create Euler's disc on air, down to an inclination of 1e-3."""
    machine = rolling.disc_on_its_side(rolling.viscous_rim)
    half, sine = 0.5 * rolling.FIRST_BETA, math.sin(rolling.FIRST_BETA)
    rate = rolling.precession_rate(rolling.FIRST_BETA)
    height = rolling.EULER_RADIUS * sine
    q0 = jnp.array([math.cos(half), math.sin(half), 0, 0, 0, 0, height])
    v0 = jnp.zeros(6).at[4].set(rate * sine)
    y0 = nhjax.initial_state(machine.system, q0, v0)

    def is_flat(t: Any, y: nhjax.State, args: Any) -> Array:
        return 4 * (y.q[1] ** 2 + y.q[2] ** 2) - LAST_BETA**2

    end = nhjax.integrate(
        machine.system,
        nhjax.LobattoIIIAB(4),
        y0,
        t1=100.0,
        stepsize_controller=nhjax.PIDController(1e-8, 1e-10),
        max_steps=10**6,
        event=nhjax.Event(is_flat),
    )
    return Case(machine.system, y0, float(end.t1), doubled(2**13, 6))


def orbit() -> Case:
    """Create ten orbits with close passes, and a constraint."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v + 1 / jnp.hypot(q[0], q[1]),
        nonholonomic=lambda t, q, v, args: v[2] - 0.3 * q[1] * v[0],
    )
    eccentricity = 0.95
    q0 = jnp.array([1 + eccentricity, 0.0, 0.0])
    speed = math.sqrt((1 - eccentricity) / (1 + eccentricity))
    y0 = nhjax.initial_state(system, q0, jnp.array([0.0, speed, 0.0]))
    return Case(
        system,
        y0,
        10 * 2 * math.pi,
        doubled(2**12, 6),
        (0.2, 0.1, 0.05, 0.025),
        lambda t, q, v, args: (q[0] ** 2 + q[1] ** 2) ** -0.75,
    )


def whip() -> Case:
    """Create a chain of ten pendulums that falls from the horizontal and whips."""
    angles = tuple([0.5 * math.pi] * 10)
    lengths, masses = (0.1,) * 10, tuple(0.1 * 0.8**k for k in range(10))
    chain = systems.PendulumChain.swinging(
        angles=angles, lengths=lengths, masses=masses, gravity=9.81
    )
    eps = (1.2, 0.8, 0.4, 0.2)
    return Case(chain.system, chain.initial_state(), 0.6, doubled(24, 6), eps)


def falling_bicycle() -> Case:
    """Create a bicycle that starts almost upright; the run ends at 1.3 rad of lean."""
    bicycle = systems.WhippleBicycle.running(speed=0.5, lean_rate=1e-4)
    system, y0 = bicycle.system, bicycle.initial_state()
    end = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(4),
        y0,
        t1=20.0,
        stepsize_controller=nhjax.PIDController(1e-8, 1e-10),
        event=nhjax.Event(lambda t, y, args: jnp.abs(y.q[3]) - 1.3),
    )
    return Case(system, y0, float(end.t1), doubled(64, 6), (1.2, 0.8, 0.4, 0.2))


def smooth(name: str, t1: float, first: int) -> Case:
    """Create a motion of the gallery without fast phases."""
    example = getattr(systems, name)()
    numbers = doubled(first, 6)
    return Case(example.system, example.initial_state(), t1, numbers, is_smooth=True)


CASES: dict[str, Callable[[], Case]] = {
    "rattleback that reverses": rattleback,
    "Euler's disc": eulers_disc,
    "orbit with close passes": orbit,
    "whip of ten pendulums": whip,
    "bicycle that falls": falling_bicycle,
    "particle": lambda: smooth("NonholonomicParticle", 20.0, 25),
    "chaotic": lambda: smooth("ChaoticSystem", 20.0, 25),
    "CVT": lambda: smooth("ContinuouslyVariableTransmission", 20.0, 25),
}
IDA_NAME = "IDA, evaluations"
OTHERS = "diffrax Dopri8", IDA_NAME
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)


class Row(NamedTuple):
    """A run: its case, its method, its setting, and what was measured."""

    case: str
    method: str
    setting: float
    error: float
    steps: int
    rejected: int
    seconds: float


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Call once to compile, and then three times; return the result and least time."""
    return jax.block_until_ready(call()), least_time(call, 3)


def reference(case: Case) -> np.ndarray:
    """Return the end of an accurate run."""
    sol = nhjax.integrate(
        case.system,
        nhjax.LobattoIIIAB(6),
        case.start,
        t1=case.t1,
        stepsize_controller=nhjax.PIDController(1e-12, 1e-13),
        max_steps=10**6,
    )
    return end_of(sol)


def compiled_run(case: Case, stages: int) -> Callable[[dict[str, Any]], nhjax.Solution]:
    """Return a compiled function from the options of a run to its solution.

    The function is compiled once for all values of arrays in the options.
    """

    @eqx.filter_jit
    def run(start: nhjax.State, options: dict[str, Any]) -> nhjax.Solution:
        return nhjax.integrate(
            case.system,
            nhjax.LobattoIIIAB(stages),
            start,
            throw=False,
            stage_solver=nhjax.SimplifiedNewton(fallback=False),
            **options,
        )

    return lambda options: run(case.start, options)


def pid_controller(rtol: float, atol: float) -> nhjax.PIDController:
    """Create a controller whose tolerances are arrays."""
    return nhjax.PIDController(jnp.asarray(rtol), jnp.asarray(atol))


def to_end(case: Case, controller: Any) -> dict[str, Any]:
    """Return the options of a run to the end of a motion."""
    return {"t1": case.t1, "stepsize_controller": controller, "max_steps": 10**6}


def measure(name: str, case: Case) -> Iterator[Row]:
    """Run a case with all steps of all ladders."""
    exact, run = reference(case), compiled_run(case, case.stages)

    def row(kind: str, setting: float, **options: Any) -> Row:
        sol, seconds = timed(lambda: run(options))
        rejected = int(sol.stats.get("num_rejected_steps", 0))
        steps = int(sol.stats["num_steps"]) + rejected
        error = np.max(np.abs(end_of(sol) - exact)) / np.max(np.abs(exact))
        print(name, kind, setting, error, steps, rejected, seconds, flush=True)
        return Row(name, kind, setting, float(error), steps, rejected, seconds)

    for count in case.constant:
        size = jnp.asarray(case.t1 / count)
        yield row("constant", count, dt=size, num_steps=jnp.asarray(count))
    for rtol in TOLERANCES:
        yield row("PID", rtol, **to_end(case, pid_controller(rtol, 1e-2 * rtol)))
    for eps in case.eps:
        controller = nhjax.ReversibleController(jnp.asarray(eps), case.density)
        yield row("reversible", eps, **to_end(case, controller))
    if case.system.manifold is None:
        yield from of_diffrax(name, case, exact)
        yield from of_ida(name, case, exact)


def of_diffrax(name: str, case: Case, exact: np.ndarray) -> Iterator[Row]:
    """Run a case by diffrax, on the accelerations that nhjax computes."""
    n = case.start.v.shape[0]

    def field(t: Any, y: Array, args: Any) -> Array:
        q, v = y[:n], y[n:]
        state = nhjax.State(q, v, v, jnp.zeros_like(case.start.multiplier))
        return jnp.concatenate([v, nhjax.motion(case.system, t, state).acceleration])

    y0 = jnp.concatenate([case.start.q, case.start.v])
    for rtol in TOLERANCES:

        @jax.jit
        def solve(y0: Array, rtol: Any = rtol) -> Any:
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Dopri8(),
                0.0,
                case.t1,
                None,
                y0,
                stepsize_controller=diffrax.PIDController(rtol, 1e-2 * rtol),
                max_steps=10**6,
                adjoint=diffrax.ForwardMode(),
                throw=False,
            )

        sol, seconds = timed(lambda solve=solve: solve(y0))
        error = np.max(np.abs(np.asarray(sol.ys[-1]) - exact)) / np.max(np.abs(exact))
        steps, rejected = sol.stats["num_steps"], sol.stats["num_rejected_steps"]
        yield Row(
            name,
            "diffrax Dopri8",
            rtol,
            float(error),
            int(steps),
            int(rejected),
            seconds,
        )


def of_ida(name: str, case: Case, exact: np.ndarray) -> Iterator[Row]:
    """Run a case by IDA, on q, v and the multipliers of the constraints' rates."""
    system, start = case.system, case.start
    n, m = start.v.shape[0], start.multiplier.shape[0]

    def constraint_rates(t: Any, q: Array, v: Array) -> Array:
        rates = [jnp.zeros(0)]
        if system.holonomic is not None:
            rates.append(
                jax.jvp(
                    lambda t, q: system.holonomic(t, q, None),
                    (t, q),
                    (jnp.ones_like(t), v),
                )[1]
            )
        if system.nonholonomic is not None:
            rates.append(jnp.atleast_1d(system.nonholonomic(t, q, v, None)))
        return jnp.concatenate(rates)

    def residual(t: Any, y: Array, rate: Array) -> Array:
        (q, v, multiplier), v_rate = jnp.split(y, (n, 2 * n)), rate[n : 2 * n]
        t, along = jnp.asarray(t), (jnp.ones(()), v, v_rate)
        momentum = jax.grad(lambda t, q, v: system.lagrangian(t, q, v, None), argnums=2)
        slope = jax.grad(lambda q: system.lagrangian(t, q, v, None))(q)
        force = 0.0 if system.force is None else system.force(t, q, v, None)
        momentum_rate = jax.jvp(momentum, (t, q, v), along)[1]
        reaction = jax.vjp(lambda v: constraint_rates(t, q, v), v)[1](multiplier)[0]
        return jnp.concatenate(
            [
                rate[:n] - v,
                momentum_rate - slope - force - reaction,
                jax.jvp(constraint_rates, (t, q, v), along)[1],
            ]
        )

    compiled = jax.jit(residual)
    both = jax.jit(jax.jacfwd(residual, argnums=(1, 2)))

    def fill(t: float, y: Array, rate: Array, out: np.ndarray) -> None:
        out[:] = compiled(t, y, rate)

    def fill_jacobian(
        t: float, y: Array, rate: Array, out: Any, factor: float, jacobian: np.ndarray
    ) -> None:
        by_y, by_rate = both(t, y, rate)
        jacobian[:] = np.asarray(by_y) + factor * np.asarray(by_rate)

    # The residual is linear in the accelerations and the multipliers.
    y0, rate0 = np.zeros((2, 2 * n + m))
    y0[:n], y0[n : 2 * n], rate0[:n] = start.q, start.v, start.v
    by_y, by_rate = both(0.0, y0, rate0)
    matrix = np.hstack([by_rate[n:, n : 2 * n], by_y[n:, 2 * n :]])
    unknowns = np.linalg.lstsq(matrix, -np.asarray(compiled(0.0, y0, rate0))[n:])[0]
    rate0[n : 2 * n], y0[2 * n :] = unknowns[:n], unknowns[n:]

    ends = np.array([0.0, case.t1])
    for rtol in TOLERANCES:
        solver = IDA(
            fill,
            jacfn=fill_jacobian,
            algebraic_idx=np.arange(2 * n, 2 * n + m) if m else None,
            rtol=rtol,
            atol=1e-2 * rtol,
            max_num_steps=10**6,
        )
        out, seconds = timed(lambda s=solver: s.solve(ends, y0, rate0))
        end = out.y[-1, : 2 * n] if out.success else np.full(2 * n, np.nan)
        error = float(np.max(np.abs(end - exact)) / np.max(np.abs(exact)))
        print(name, "IDA", rtol, error, out.nfev, seconds, flush=True)
        # This column has evaluations of the residual, because IDA does not report its
        # steps here.
        yield Row(name, IDA_NAME, rtol, error, int(out.nfev), 0, seconds)


def at_error(rows: list[Row], error: float, what: str) -> float:
    """Interpolate the steps or seconds of a ladder at an error; NaN outside of it."""
    points = sorted((x.error, getattr(x, what)) for x in rows if np.isfinite(x.error))
    errors, values = np.log(np.array(points).T) if points else (np.zeros(0),) * 2
    if len(points) < 2 or not errors[0] <= np.log(error) <= errors[-1]:
        return math.nan
    return float(np.exp(np.interp(np.log(error), errors, values)))


ERRORS = (1e-4, 1e-6, 1e-8)


def comparison(rows: list[Row]) -> list[list[str]]:
    """Return a table of steps and times at equal error, as ratios to constant steps."""
    table = []
    for case in dict.fromkeys(row.case for row in rows):
        for error in ERRORS:
            line = [case, number(error)]
            of = {
                kind: [x for x in rows if x.case == case and x.method == kind]
                for kind in ("constant", "PID", "reversible", *OTHERS)
            }
            base = {
                what: at_error(of["constant"], error, what)
                for what in ("steps", "seconds")
            }
            line += [f"{base['steps']:.0f}", f"{1e3 * base['seconds']:.2f}"]
            for kind in ("PID", "reversible"):
                for what in ("steps", "seconds"):
                    ratio = at_error(of[kind], error, what) / base[what]
                    line.append("-" if math.isnan(ratio) else f"{ratio:.2f}")
            for kind in OTHERS:
                ratio = at_error(of[kind], error, "seconds") / base["seconds"]
                line.append("-" if math.isnan(ratio) else f"{ratio:.2f}")
            table.append(line)
    return table


HEADER = [
    "motion",
    "error",
    "constant: steps",
    "ms",
    "PID: steps, ratio",
    "time, ratio",
    "reversible: steps, ratio",
    "time, ratio",
    "diffrax: time, ratio",
    "IDA: time, ratio",
]


# --- The least number of steps --------------------------------------------------------

# The numbers of constant steps that have errors of about 1e-4, or 1e-7 for the bicycle
# and 1e-6 for smooth motions.
LIMIT_STEPS = {
    "rattleback that reverses": 6000,
    "Euler's disc": 16384,
    "orbit with close passes": 16384,
    "whip of ten pendulums": 48,
    "bicycle that falls": 192,
    "particle": 71,
    "chaotic": 80,
    "CVT": 124,
}


class Limits(NamedTuple):
    """The steps that ideal sizes would need, relative to constant steps.

    - `cancellation`: |Σ w_n| / Σ |w_n| for the errors w_n of the steps, transported to
        the end of the run.
    - `adding`: the least ratio of steps if errors add up with both kinds of steps.
    - `cancelling`: the least ratio if only the errors of constant steps cancel.
    """

    cancellation: float
    adding: float
    cancelling: float


def limits(case: Case, count: int) -> Limits:
    """Compute what the best sizes could save, from the errors of constant steps.

    The error of a step at t_n is d(t_n) h^k with k = 2 s - 1, and |w_n| is its size at
    the end of the run. With sizes h(t) the errors add up to ∫ d h^(k-1) dt, and the
    number of steps is ∫ dt / h. For a given sum, the number is least with h
    proportional to d^(-1/k). The ratio of this number to the number of constant steps
    is ((mean |w|^(1/k))^k / mean |w|)^(1/(k-1)).
    """
    method, fine = nhjax.LobattoIIIAB(case.stages), nhjax.LobattoIIIAB(6)
    h = case.t1 / count
    sol = nhjax.integrate(
        case.system,
        method,
        case.start,
        dt=h,
        num_steps=count,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )
    _, unflatten = ravel_pytree(case.start)
    starts = jax.vmap(lambda y: ravel_pytree(y)[0])(sol.ys)[:-1]

    def end(method: nhjax.LobattoIIIAB, x: Array, t: Array) -> Array:
        state = nhjax.step(case.system, method, t, h, unflatten(x), throw=False)
        return ravel_pytree(state)[0]

    @jax.jit
    def error_and_jacobian(given: tuple[Array, Array]) -> tuple[Array, Array]:
        x, t = given
        jacobian = jax.jacfwd(lambda x: end(method, x, t))(x)
        return end(method, x, t) - end(fine, x, t), jacobian

    found = jax.lax.map(error_and_jacobian, (starts, sol.ts[:-1]), batch_size=64)
    errors, jacobians = map(np.asarray, found)
    places = unflatten(jnp.arange(starts.shape[1], dtype=starts.dtype))
    kept = np.asarray(ravel_pytree((places.q, places.v))[0]).astype(int)
    transport, transported = np.eye(starts.shape[1])[kept], []
    for error, jacobian in zip(errors[::-1], jacobians[::-1], strict=True):
        transported.append(transport @ error)
        transport = transport @ jacobian
    sizes = np.max(np.abs(transported), axis=1)
    k = method.order + 1
    adding = (np.mean(sizes ** (1 / k)) ** k / np.mean(sizes)) ** (1 / (k - 1))
    cancellation = float(np.max(np.abs(np.sum(transported, axis=0))) / np.sum(sizes))
    return Limits(cancellation, adding, adding / cancellation ** (1 / (k - 1)))


def measure_limits() -> tuple[str, dict[str, Any]]:
    """Compute the limits of all motions."""
    table, rows = [], []
    for name, count in LIMIT_STEPS.items():
        found = limits(CASES[name](), count)
        print(name, found, flush=True)
        rows.append({"case": name, "steps": count, **found._asdict()})
        table.append([name, str(count), *(f"{x:.2g}" for x in found)])
    text = (
        "## The least number of steps\n\n"
        "From the errors of constant steps, transported to the end: the size of their "
        "sum over the sum of their sizes, and the least number of steps with the same "
        "error at the end, relative to the number of constant steps.\n\n"
    )
    header = [
        "motion",
        "constant steps",
        "sum of errors / sum of sizes",
        "least steps if errors add up, ratio",
        "least steps if only errors of constant steps cancel, ratio",
    ]
    return text + markdown_table(header, table), {"limits": rows}


# --- The energy over a long time ------------------------------------------------------

LONG, ROWS = 1e5, 2000
ECCENTRICITY = 0.8


def ball_in_central_field() -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a homogeneous ball that rolls on a plane around an attracting point.

    The centre of the ball moves like a particle of 7/5 of its mass in the same field
    (Routh), so that its path is an ellipse. The ball starts where it is farthest from
    the attracting point.
    """
    manifold = nhjax.ProductGroup(nhjax.Euclidean(2), nhjax.SO3())

    def lagrangian(t: Any, q: Any, v: Array, args: Any) -> Array:
        return 0.5 * v[:2] @ v[:2] + 0.2 * v[2:] @ v[2:] + 1 / jnp.hypot(*q[0])

    def constraint(t: Any, q: Any, v: Array, args: Any) -> Array:
        spin = nhjax.SO3().matrix(q[1]) @ v[2:]
        return jnp.stack([v[0] - spin[1], v[1] + spin[0]])

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=constraint, manifold=manifold
    )
    speed = math.sqrt((1 - ECCENTRICITY) / (1 + ECCENTRICITY) / 1.4)
    q0 = (jnp.array([1 + ECCENTRICITY, 0.0]), jnp.array([1.0, 0.0, 0.0, 0.0]))
    v0 = jnp.array([0.0, speed, -speed, 0.0, 0.0])
    return system, nhjax.initial_state(system, q0, v0)


def energies() -> dict[str, tuple[np.ndarray, np.ndarray, int]]:
    """Return times, relative energy errors and numbers of steps of long runs."""
    system, y0 = ball_in_central_field()

    def density(t: Any, q: Any, v: Array, args: Any) -> Array:
        return (q[0] @ q[0]) ** -0.75

    controllers = {
        "PID, rtol = 1e-5": nhjax.PIDController(1e-5, 1e-5),
        "reversible, ε = 0.15": nhjax.ReversibleController(0.15, density),
    }
    found, count = {}, 0

    def run(stride: int, **options: Any) -> nhjax.Solution:
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            saveat=nhjax.SaveAt(
                steps=stride, fn=lambda t, y, args: system.energy(t, y)
            ),
            throw=False,
            stage_solver=nhjax.SimplifiedNewton(fallback=False),
            **options,
        )

    start = float(system.energy(0.0, y0))
    for name, controller in controllers.items():
        options = {"stepsize_controller": controller, "max_steps": 10**8}
        first = run(1, t1=LONG / 100, **options)
        count = int(first.stats["num_steps"]) * 100
        sol = run(max(1, count // ROWS), t1=LONG, **options)
        errors = np.abs(np.asarray(sol.ys) / start - 1)
        found[name] = np.asarray(sol.ts), errors, int(sol.stats["num_steps"])
    sol = run(max(1, count // ROWS), dt=LONG / count, num_steps=count)
    errors = np.abs(np.asarray(sol.ys) / start - 1)
    found["constant"] = np.asarray(sol.ts), errors, int(sol.stats["num_steps"])
    return found


def measure_long() -> tuple[str, dict[str, Any]]:
    """Measure and draw the energy over a long time."""
    figure, ax = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
    table = []
    for name, (ts, errors, count) in energies().items():
        ax.semilogy(ts, np.maximum(errors, 1e-16), ".", markersize=2, label=name)
        fifths = np.array_split(errors, 5)
        table.append([name, str(count), *(number(np.max(x)) for x in fifths)])
    ax.set(xlabel="t", ylabel="|E / E₀ - 1|", ylim=(1e-9, 10))
    ax.legend(
        loc="center right", bbox_to_anchor=(1.0, 0.6), markerscale=4, fontsize="small"
    )
    figure.savefig(DOCS / "step_sizes.png", dpi=150)
    header = ["steps", "number", *(f"fifth {k}" for k in range(1, 6))]
    text = (
        "## The energy over a long time\n\n"
        "A homogeneous ball rolls around an attracting point, on an ellipse of "
        f"eccentricity {ECCENTRICITY}, over t = {LONG:g}, s = 3: the largest relative "
        f"energy error in each fifth of the run, at about {ROWS} steps of it. Constant "
        "steps are as many as those of the reversible controller.\n\n"
    )
    return text + markdown_table(header, table), {"long": table}


STONE_TIME = 1000.0
STONE_STEPS = (10**6, 7 * 10**5, 5 * 10**5)
STONE_EPS = (0.2, 0.3, 0.4)
PITCHING_EPS = (0.003, 0.0035, 0.004, 0.0045, 0.005)


def pitching(t: Any, q: Array, v: Array, args: Any) -> Array:
    """Return a step density for the rattleback, in units of 1/s to the power 0.8.

    Nearly all energy errors arise while the stone pitches fast about the second axis of
    the body. The density is a power of the amplitude of this oscillation. It does not
    follow the faster oscillation about the first axis, which is hardly excited.
    """
    sine = 2 * (q[1] * q[3] - q[0] * q[2])
    return (0.8**2 + v[4] ** 2 + (60 * sine) ** 2) ** 0.4


def measure_rattleback() -> tuple[str, dict[str, Any]]:
    """Measure the energy of a rattleback that reverses many times."""
    stone = systems.Rattleback.spinning(5.0, (0.5, 0.5))
    system, y0 = stone.system, stone.initial_state()
    start, kinetic = float(system.energy(0.0, y0)), float(0.5 * y0.p @ y0.v)
    save = nhjax.SaveAt(steps=500, fn=lambda t, y, args: system.energy(t, y))
    table = []

    def measure_run(name: str, **options: Any) -> None:
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            saveat=save,
            throw=False,
            stage_solver=nhjax.SimplifiedNewton(fallback=False),
            **options,
        )
        steps = int(sol.stats["num_steps"])
        energies = np.asarray(sol.ys)[: steps // 500]
        error = np.max(np.abs(energies - start)) / kinetic
        if not bool(sol.result == nhjax.RESULTS.successful):
            error = math.nan
        table.append([name, str(steps), number(error)])
        print(table[-1], flush=True)

    for count in STONE_STEPS:
        measure_run("constant", dt=STONE_TIME / count, num_steps=count)
    densities = ("", None, STONE_EPS), ("pitching, ", pitching, PITCHING_EPS)
    for name, density, ladder in densities:
        for eps in ladder:
            measure_run(
                f"reversible, {name}ε = {eps:g}",
                t1=STONE_TIME,
                stepsize_controller=nhjax.ReversibleController(eps, density),
                max_steps=2 * 10**6,
            )
    text = (
        f"## A rattleback over {STONE_TIME:g} s\n\n"
        "The largest error of the energy after each 500 steps, relative to the kinetic "
        "energy at the start, s = 3. The density of the reversible controller is "
        "automatic, or follows the pitching of the stone.\n\n"
    )
    header = ["steps", "number", "energy error"]
    return text + markdown_table(header, table), {"rattleback": table}


# --- The number of stages -------------------------------------------------------------

STAGE_CASES = ("particle", "chaotic", "CVT", "orbit with close passes")
STAGE_ERRORS = tuple(10.0**-k for k in range(2, 13))
SHOWN = (1e-4, 1e-6, 1e-8, 1e-10)


def measure_stages() -> tuple[str, dict[str, Any]]:
    """Measure the fastest number of stages for each error, with the PID controller."""
    table, factors = [], []
    for name in STAGE_CASES:
        case = CASES[name]()
        exact, of = reference(case), {}
        for stages in range(2, 9):
            run = compiled_run(case, stages)
            of[stages] = [
                stage_row(name, case, exact, stages, k, run) for k in range(2, 13)
            ]
            shown = [x for x in of[stages] if x.setting in SHOWN]
            ratios = [f"{x.error / x.setting:.2g}" for x in shown]
            factors.append([name, str(stages), *ratios])
        line = [name]
        for error in STAGE_ERRORS:
            times = {s: at_error(rows, error, "seconds") for s, rows in of.items()}
            known = {s: x for s, x in times.items() if np.isfinite(x)}
            line.append(str(min(known, key=lambda s: known[s])) if known else "-")
        table.append(line)
    text = "## The number of stages\n\nThe fastest number for an error at the end:\n\n"
    text += markdown_table(["motion", *(number(x) for x in STAGE_ERRORS)], table)
    text += "\n\nThe error at the end over the tolerance:\n\n"
    text += markdown_table(["motion", "s", *(f"{x:g}" for x in SHOWN)], factors)
    return text, {"stages": table, "factors": factors}


def stage_row(
    name: str,
    case: Case,
    exact: np.ndarray,
    stages: int,
    digits: int,
    run: Callable[[dict[str, Any]], nhjax.Solution],
) -> Row:
    """Run a case with a number of stages and the tolerance 10^-digits."""
    rtol = 10.0**-digits
    options = to_end(case, pid_controller(rtol, rtol))
    sol, seconds = timed(lambda: run(options))
    error = np.max(np.abs(end_of(sol) - exact)) / np.max(np.abs(exact))
    steps, rejected = sol.stats["num_steps"], sol.stats["num_rejected_steps"]
    given = float(error), int(steps), int(rejected), seconds
    return Row(name, str(stages), rtol, *given)


# --- Tolerance and error --------------------------------------------------------------

# Machines of the gallery, and the time of about five periods of their fastest motion.
MACHINES = {
    "NonholonomicParticle": 20.0,
    "ChaoticSystem": 20.0,
    "ContinuouslyVariableTransmission": 20.0,
    "KnifeEdge": 5.0,
    "Unicycle": 20.0,
    "RollingDisc": 5.0,
    "RodSleigh": 5.0,
    "FourBar": 2.0,
    "DoublePendulum": 5.0,
    "HeavyTop": 2.0,
    "ChaplyginSphere": 5.0,
    "BallInBowl": 5.0,
}


def measure_tolerances() -> tuple[str, dict[str, Any]]:
    """Measure and draw the error at the end against the tolerance."""
    figure, ax = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    table, ratios = [], []
    for k, (name, t1) in enumerate(MACHINES.items()):
        case = smooth(name, t1, 1)
        exact, line = reference(case), []
        for digits in (4, 6, 8, 10):
            stages = nhjax.LobattoIIIAB.for_tolerance(10.0**-digits).stages
            run = compiled_run(case, stages)
            row = stage_row(name, case, exact, stages, digits, run)
            line.append(row.error / row.setting)
            print(row, flush=True)
        marker = "o-" if k < 10 else "s-"  # The colours repeat after ten lines.
        ax.loglog(SHOWN, np.array(line) * SHOWN, marker, label=name)
        ratios += line
        table.append([name, *(f"{x:.2g}" for x in line)])
    ends = np.array(SHOWN)
    ax.loglog(ends, ends, "k--", linewidth=1)
    ax.fill_between(ends, 0.1 * ends, 10 * ends, color="0.9", zorder=0)
    ax.set(xlabel="rtol", ylabel="error at the end")
    ax.legend(fontsize="x-small", ncols=2)
    figure.savefig(DOCS / "tolerances.png", dpi=150)
    inside = np.mean([0.1 <= x <= 10 for x in ratios])
    text = (
        "## Tolerance and error\n\n"
        "The error at the end over `rtol`, with `LobattoIIIAB.for_tolerance(rtol)`. "
        f"{100 * inside:.0f} percent of the factors lie between 0.1 and 10, and the "
        f"median is {np.median(ratios):.2g}.\n\n"
    )
    header = ["machine", *(f"{x:g}" for x in SHOWN)]
    return text + markdown_table(header, table), {"tolerances": table}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--only", nargs="*", help="words of the names of cases; keep the other rows"
    )
    parser.add_argument("--parts", nargs="*", default=PARTS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    saved = json.loads(SAVED.read_text()) if SAVED.exists() else {}
    data: dict[str, Any] = {"texts": {}} | saved
    measured = {
        "cases": lambda: measure_cases(options.only, saved.get("rows", [])),
        "limits": measure_limits,
        "long": measure_long,
        "rattleback": measure_rattleback,
        "stages": measure_stages,
        "tolerance": measure_tolerances,
    }
    for part in options.parts:
        data["texts"][part], more = measured[part]()
        data |= more
    texts = [data["texts"][part] for part in PARTS if part in data["texts"]]
    write("adaptive_steps", "Steps that adapt", "\n\n".join(texts), data)


def measure_cases(
    only: list[str] | None, saved: list[dict[str, Any]]
) -> tuple[str, dict[str, Any]]:
    """Measure the cases whose names contain one of the words, or all of them.

    The saved rows of the other cases are kept.
    """
    rows: list[Row] = []
    for name, make in CASES.items():
        if only and not any(word in name for word in only):
            kept = (x for x in saved if x["case"] == name)
            rows += [Row(**x)._replace(error=x["error"] or math.nan) for x in kept]
        else:
            rows += measure(name, make())
    text = markdown_table(HEADER, comparison(rows))
    details = [
        [
            x.case,
            x.method,
            f"{x.setting:g}",
            number(x.error),
            str(x.steps),
            str(x.rejected),
            f"{1000.0 * x.seconds:.2f}",
        ]
        for x in rows
    ]
    header = ["motion", "method", "setting", "error", "attempts", "rejected", "ms"]
    text = "## Error against steps and time\n\n" + text
    text += "\n\nAll runs:\n\n" + markdown_table(header, details)
    return text, {"rows": [x._asdict() for x in rows]}


if __name__ == "__main__":
    main()
