"""Error at the end against time: nhjax, diffrax, heyoka, SciPy and IDA.

The competitors integrate the index-reduced equations, written by hand (see
`_competitors` and `_heyoka`). Only SUNDIALS IDA also integrates the equations with the
constraint. All runs of a case are timed in turn, so that noise affects all of them.
Before a short run is timed, it is called once without timing, to fill the caches. The
time of a run is the median of seven. The tables have ratios of these medians, and in
brackets the ratio of the fastest times, which is more reliable on a busy machine.
Compile times are separate, and the preparation of initial states is not timed. Under
`vmap` a batch of nhjax runs on one core. With `--devices k` it is also measured on k
devices of the CPU (`nhjax devices`). heyoka also runs on two threads (`heyoka threads`)
if this process may use two cores. Under `taskset -c 0` all programs have one core.

For each accuracy the fastest method of a package counts, in any form: diffrax under
`vmap` or with all members in one state, heyoka member by member, in batches or by its
function for ensembles. The last columns compare the fastest form of nhjax with the
fastest method of all other packages.

The error is the largest error of (q, v) at the end over the members. The reference is
the exact solution, or an extrapolation of order 20 in long double. In ensembles of more
than 101 members, about 101 members at equal distances have a reference. The tables also
have |Φ|, relative to the possible size of its terms, and the relative energy error:
their largest values over the members at the end.

A command does not change saved results of cases that it does not measure.
"""

import argparse
import statistics
import time

import jax
import jax.numpy as jnp

from ._competitors import host_field
from ._contest import draw, kept, Measured
from ._ladders import (
    Case,
    compiled,
    cores,
    diffrax_runs,
    heyoka_note,
    heyoka_runs,
    host_runs,
    LADDERS,
    nhjax_runs,
)
from ._report import RESULTS, write


REPEATS = 7
SHORT = 0.02  # Runs of fewer seconds are called once before each timed call.
# For each case of the default command: the system, t, the number of members, the
# numbers of stages, and the largest length of a ladder.
FEW = (4, 6, 8)
CASES = [
    ("chaotic", 20.0, 1, tuple(range(2, 9)), 9),
    ("chaotic", 20.0, 101, tuple(range(2, 9)), 9),
    ("chaotic", 1000.0, 1, (4, 8), 3),
    ("chaotic", 10000.0, 1, (4, 8), 3),
    ("chaotic", 2.0, 10**4, (8,), 2),
    ("particle", 20.0, 1, (2, *FEW), 4),
    ("particle", 20.0, 101, FEW, 3),
    ("particle", 1000.0, 1, (4, 8), 3),
    ("CVT", 20.0, 1, (2, *FEW), 4),
    ("CVT", 20.0, 101, FEW, 3),
    ("CVT", 1000.0, 1, (4, 8), 3),
    ("unicycle", 20.0, 1, (2, *FEW), 4),
    ("unicycle", 20.0, 101, FEW, 3),
    ("unicycle", 1000.0, 1, (4, 8), 3),
]


def measure(
    case: Case, stages: tuple[int, ...], limit: int, options: argparse.Namespace
) -> Measured:
    """Run all methods on a case, and time the runs in turn."""
    runs = [
        *nhjax_runs(case, stages, limit),
        *diffrax_runs(case, limit),
        *heyoka_runs(case, limit, options.longest),
    ]
    note = f"Cores: {cores()}. {heyoka_note()}"
    if case.members == 1 and not options.no_host:
        field = host_field(case.problem)
        times = field.microseconds(case.problem.to_state(case.q[0], case.v[0]))
        form = min(times, key=lambda key: times[key])
        note += " One right-hand side for SciPy: " + ", ".join(
            f"{name} {x:.1f} µs" for name, x in times.items()
        )
        runs += host_runs(case, field, form, limit, options.longest)
    repeats = 2 if options.smoke else REPEATS
    seconds: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, samples in zip(runs, seconds, strict=True):
            assert run.call is not None
            if min(samples, default=0.0) < SHORT:
                run.call()
            start = time.perf_counter()
            run.call()
            samples.append(time.perf_counter() - start)
    for run, samples in zip(runs, seconds, strict=True):
        run.seconds, run.fastest = statistics.median(samples), min(samples)
    return Measured(case.name, case.t, case.members, runs, note)


def main() -> None:
    """Print and save the tables and the figure, case by case."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = list(dict.fromkeys(name for name, *_ in CASES))
    parser.add_argument("--systems", nargs="+", choices=names, default=names)
    parser.add_argument("--times", type=float, nargs="+", help="in place of 20, 1000")
    parser.add_argument("--members", type=int, nargs="+", help="in place of 1, 101")
    parser.add_argument("--stages", type=int, nargs="+", help="of nhjax")
    parser.add_argument(
        "--longest", type=float, default=1.0, help="seconds on the host"
    )
    parser.add_argument("--no-host", action="store_true", help="neither SciPy nor IDA")
    parser.add_argument(
        "--devices", type=int, default=1, help="of the CPU, for ensembles of nhjax"
    )
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.devices > 1:
        jax.config.update("jax_num_cpu_devices", options.devices)
    cases = [case for case in CASES if case[0] in options.systems]
    if options.times or options.members:
        cases = [
            (name, t, members, tuple(LADDERS), 9)
            for name in options.systems
            for t in options.times or [20.0]
            for members in options.members or [1]
        ]
    if options.smoke:
        cases = [("CVT", 2.0, 1, (4,), 2), ("chaotic", 2.0, 3, (4,), 2)]
    # The first compilation of a process also starts the compiler, and is not measured.
    compiled(jnp.sin, (jnp.asarray(0.1),))
    everything = kept(RESULTS / "work_precision.json")
    try:
        for name, t, members, stages, limit in cases:
            case, chosen = Case(name, t, members), tuple(options.stages or stages)
            measured = measure(case, chosen, limit, options)
            print(measured.section(), flush=True)
            everything[measured.title] = measured
    finally:  # An interrupted run also saves the cases that it has measured.
        if everything and not options.smoke:
            save(list(everything.values()))


def save(cases: list[Measured]) -> None:
    """Save the tables and the figure of these cases."""
    text = "\n\n".join(case.section() for case in cases)
    data = {"cases": [case.data() for case in cases]}
    write("work_precision", "Work and precision", text, data)
    draw(cases, RESULTS / "work_precision.png")


if __name__ == "__main__":
    main()
