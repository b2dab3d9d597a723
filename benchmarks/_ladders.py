"""The runs of work-precision diagrams: a ladder of runs for each solver.

A ladder is the list of runs of one method with step sizes or tolerances from coarse to
fine. A rung is one of these step sizes or tolerances.
"""

import importlib.util
import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

import nhjax

from ._competitors import (
    diffrax_run,
    diffrax_state,
    extrapolated,
    from_diffrax,
    HostField,
    ida_run,
    Problem,
    problems,
    scipy_run,
)
from ._contest import Run


CHECKED = 101  # the number of members of a larger ensemble that have a reference
# For each number of stages: numbers of steps for t = 20. The errors range from visible
# in a plot to round-off.
LADDERS = {
    2: (100, 400, 1600),
    3: (50, 100, 200, 400, 800),
    4: (40, 70, 120, 200, 400),
    5: (32, 50, 80, 120, 200),
    6: (28, 40, 56, 80, 120),
    7: (25, 34, 45, 60, 80),
    8: (20, 24, 28, 32, 36, 45, 60),
}
TOLERANCES = {
    "Tsit5": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13),
    "Dopri8": (1e-4, 1e-6, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13, 1e-14),
    "Kvaerno5": (1e-5, 1e-7, 1e-9),
    "DOP853": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-13),
    "Radau": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
    "IDA": (1e-5, 1e-7, 1e-9, 1e-11),
}
# Tolerances of nhjax's `SimplifiedNewton`; with 0, stages are solved to round-off.
NEWTON_TOLERANCES = (0.0, 1e-6, 1e-7, 1e-9, 1e-10, 1e-12)
STEPS = (0.4, 0.2, 0.1, 0.05, 0.025)


class Case:
    """A system, a time and a number of members, with the reference for its runs."""

    def __init__(self, name: str, t: float, members: int):
        self.name, self.t, self.members = name, t, members
        self.problem: Problem = problems()[name]
        q, v = self.problem.members(members)
        self.q, self.v = np.asarray(q), np.asarray(v)
        self.checked = slice(None, None, max(1, (members - 1) // (CHECKED - 1)))
        self.energy = jax.vmap(lambda q, v: self.problem.example.energy(0.0, q, v))
        self.start_energy = np.asarray(self.energy(q, v))
        self.reference = self._reference()

    def _reference(self) -> np.ndarray | None:
        """Return (q, v) of the checked members at the end, or None if it is unknown."""
        # In the chaotic system, perturbations grow by a factor of up to 10⁵ until
        # t = 50, and reach the size of the motion itself by t = 200. Therefore long
        # trajectories have no reference.
        if self.name == "chaotic" and self.t > 60:
            return None
        q, v = self.q[self.checked], self.v[self.checked]
        exact = self.problem.exact(q, v, self.t)
        if exact is not None:
            return exact
        y0 = self.problem.to_state(q, v)
        end = extrapolated(self.problem, y0, self.t, 0.2)
        return np.concatenate(self.problem.from_state(end), -1)

    def judge(self, run: Run, q: np.ndarray, v: np.ndarray) -> None:
        """Compute the errors of a run from (q, v) of all members at the end."""
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            return
        if self.reference is not None:
            ends = np.concatenate([q, v], -1)[self.checked]
            errors = np.max(np.abs(ends - self.reference), axis=-1)
            run.error = float(np.max(errors))
            run.median_error = float(np.median(errors))
        drift = np.asarray(self.energy(q, v)) - self.start_energy
        run.energy_error = float(np.max(np.abs(drift / self.start_energy)))
        run.violation = float(np.max(jax.vmap(self._violation)(q, v)))

    def _violation(self, q, v):
        def phi(v):
            return self.problem.example.constraint(0.0, q, v, None)

        return jnp.abs(phi(v)) / (jnp.sum(jnp.abs(jax.grad(phi)(v))) * jnp.max(abs(v)))


def thinned(ladder: tuple, limit: int) -> list:
    """Return at most `limit` rungs of a ladder, including the first and the last."""
    if len(ladder) <= limit:
        return list(ladder)
    return [ladder[round(i)] for i in np.linspace(0, len(ladder) - 1, limit)]


def compiled(function: Callable, args: tuple) -> tuple[Callable[..., Any], float]:
    """Return a compiled program, and the seconds of its first call."""
    # The program is not compiled ahead of time, because each call would then have ten
    # times the overhead of a call through `jax.jit`.
    program = jax.jit(function)
    start = time.perf_counter()
    jax.block_until_ready(program(*args))
    return program, time.perf_counter() - start


def nhjax_runs(case: Case, stages: tuple[int, ...], limit: int) -> Iterator[Run]:
    """Yield the ladders of nhjax, for each number of stages s.

    Each step size is run with stages solved to round-off, and with several larger
    tolerances. Runs with a step that cannot be solved are omitted.
    """
    system = case.problem.example.system
    y0 = jax.vmap(lambda q, v: nhjax.initial_state(system, q, v))(case.q, case.v)
    if case.members == 1:
        y0 = jax.tree.map(lambda x: x[0], y0)
    for s in stages:
        for steps in thinned(LADDERS[s], limit):
            num_steps = max(1, round(steps * case.t / 20))

            def one(y0, tolerance, s=s, num_steps=num_steps):
                sol = nhjax.integrate(
                    system,
                    nhjax.LobattoIIIAB(s),
                    y0,
                    dt=case.t / num_steps,
                    num_steps=num_steps,
                    stage_solver=nhjax.SimplifiedNewton(tolerance=tolerance),
                    throw=False,
                )
                stats = sol.stats["num_iterations"], sol.stats["num_steps"]
                return sol.ys.q[-1], sol.ys.v[-1], *stats

            function = one if case.members == 1 else jax.vmap(one, in_axes=(0, None))
            layouts = {"": function}
            if case.members > 1 and jax.device_count() > 1:
                layouts[" devices"] = spread(function)
            programs = {
                layout: compiled(function, (y0, 0.0))
                for layout, function in layouts.items()
            }
            for tolerance, layout in product(NEWTON_TOLERANCES, layouts):
                program, seconds = programs[layout]
                call = partial(_blocked, program, y0, tolerance)
                q, v, iterations, done = (np.asarray(x) for x in call())
                if np.any(done < num_steps):
                    continue
                name = f"nhjax{layout} s={s}"
                name += f", {tolerance:.0e}" if tolerance else ""
                run = Run(name, case.t / num_steps, call, seconds)
                n = case.q.shape[-1]
                case.judge(run, q.reshape(-1, n), v.reshape(-1, n))
                run.iterations = float(np.mean(iterations)) / num_steps
                yield run


def spread(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that spreads the members of an ensemble over all devices.

    It takes the ensemble and a tolerance, like `function`.
    """
    mesh = Mesh(np.asarray(jax.devices()), ("members",))
    members, everywhere = PartitionSpec("members"), PartitionSpec()
    shared = jax.shard_map(
        function,
        mesh=mesh,
        in_specs=(members, everywhere),
        out_specs=members,
        check_vma=False,
    )

    def run(y0, tolerance):
        count = jax.tree.leaves(y0)[0].shape[0]
        more = -count % jax.device_count()
        filled = jax.tree.map(
            lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], more, axis=0)]), y0
        )
        out = shared(filled, jnp.asarray(tolerance))
        return jax.tree.map(lambda x: x[:count], out)

    return run


def diffrax_runs(case: Case, limit: int) -> Iterator[Run]:
    """Yield the ladders of diffrax: adaptive steps, and for Dopri8 also fixed steps."""
    methods = [("Tsit5", False), ("Dopri8", False), ("Dopri8", True)]
    layouts = ["array"] if case.members == 1 else ["vmap", "stacked"]
    # Kvaerno5 runs only in short cases, because its Newton iterations make it a hundred
    # times slower than the explicit methods.
    if case.members == 1 and case.t <= 20:
        methods.append(("Kvaerno5", False))
    y0 = case.problem.to_state(case.q, case.v)
    for layout in layouts:
        state = diffrax_state(layout, y0)
        for solver, fixed in methods:
            rungs = STEPS if fixed else TOLERANCES[solver]
            function = diffrax_run(case.problem, solver, layout, fixed, case.t)
            program, seconds = compiled(function, (state, rungs[0]))
            name = f"diffrax {solver}" + (" fixed" if fixed else "")
            name += "" if layout == "array" else f" {layout}"
            for rung in thinned(rungs, limit):
                call = partial(_blocked, program, state, rung)
                end = call()[0]
                run = Run(name, rung, call, seconds)
                ends = from_diffrax(layout, end)
                case.judge(run, *case.problem.from_state(ends))
                yield run


def cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def heyoka_runs(case: Case, limit: int, longest: float) -> Iterator[Run]:
    """Yield the ladders of heyoka for each layout; none if heyoka is not installed.

    A ladder of `ensemble_propagate_until` ends at the first run that takes longer than
    `longest` seconds.
    """
    if importlib.util.find_spec("heyoka") is None:
        return
    from . import _heyoka

    y0 = case.problem.to_state(case.q, case.v)
    threads = min(2, cores())
    for layout in _heyoka.layouts(case.members, threads):
        prepare = _heyoka.heyoka_run(case.name, layout, y0, case.t, threads)
        # Times are interpolated as powers of the error. The times of heyoka are not
        # powers: with few rungs, interpolated times would be too short.
        number = 3 if "ensemble" in layout else max(limit, 6)
        for tolerance in thinned(_heyoka.TOLERANCES, number):
            call, seconds = prepare(tolerance)
            start = time.perf_counter()
            end = call()
            if "ensemble" in layout and time.perf_counter() - start > longest:
                break
            if not np.all(np.isfinite(end)):
                continue
            name = "heyoka" if case.members == 1 else f"heyoka {layout}"
            run = Run(name, tolerance, call, seconds)
            case.judge(run, *case.problem.from_state(end))
            yield run


def heyoka_note() -> str:
    """Write the version of heyoka, its batch size and the number of threads."""
    if importlib.util.find_spec("heyoka") is None:
        return "heyoka is not installed."
    from . import _heyoka

    lanes, threads = _heyoka.batch_size(), min(2, cores())
    return f"heyoka {_heyoka.VERSION}: batches of {lanes}, at most {threads} threads."


def _blocked(program: Callable, *args: Any) -> Any:
    return jax.block_until_ready(program(*args))


def host_runs(
    case: Case, field: HostField, form: str, limit: int, longest: float
) -> Iterator[Run]:
    """Yield the ladders of SciPy and IDA, for one trajectory.

    A ladder ends at the first run that takes longer than `longest` seconds.
    """
    q, v = case.q[0], case.v[0]
    y0 = case.problem.to_state(q, v)
    solvers: dict[str, tuple[Callable[[float], Any], tuple]] = {
        f"SciPy {name}": (scipy_run(field, form, name, y0, case.t), TOLERANCES[name])
        for name in ("DOP853", "Radau")
    }
    for index in (1, 2):
        solver = ida_run(case.problem, q, v, case.t, index)
        solvers[f"IDA index {index}"] = solver, TOLERANCES["IDA"]
    for name, (solver, rungs) in solvers.items():
        for rung in thinned(rungs, limit):
            call = partial(solver, rung)
            start = time.perf_counter()
            end = call()
            if time.perf_counter() - start > longest:
                break
            if end is None:
                continue
            run = Run(name, rung, call)
            if isinstance(end, tuple):
                case.judge(run, *(x[None] for x in end))
            else:
                case.judge(run, *case.problem.from_state(end[None]))
            yield run
