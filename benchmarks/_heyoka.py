"""heyoka as a competitor: Taylor series of high order, compiled by LLVM.

The index-reduced equations are the equations of `_competitors`, rewritten for Taylor
series. There, a product or a quotient costs a sum over all orders, a square costs half
of this, and sums are cheap. Therefore common factors are taken out, and squares are
written as powers. The options are the fastest for such small systems: `fast_math` makes
runs up to 1.7 times faster, without loss of accuracy. `compact_mode` is off, because it
makes runs about twice as long. `force_avx512`, `slp_vectorize` and `high_accuracy`
improve neither time nor accuracy.

An ensemble runs member by member, or in batches whose members are in the lanes of a
vector. heyoka's own function for ensembles, `ensemble_propagate_until`, links a copy of
the integrator for each member or batch, which takes longer than these runs. A second
form with threads is therefore measured too: each thread has one copy of the integrator,
which is created once.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from functools import cache, partial
from typing import Any

import heyoka as hy
import numpy as np


# With the disk cache, compile times would be the times to load programs that an earlier
# process has compiled.
hy.llvm_state.set_diskcache_enabled(False)
VERSION = hy.__version__
# The order of the series follows from the tolerance: it is 4 for the first tolerance,
# and 20 for the last one.
TOLERANCES = (*(10.0**-k for k in range(3, 16)), float(np.finfo(float).eps))


def _particle(state: Sequence[Any]) -> list[Any]:
    x, y, _, *v = state
    multiplier = (v[0] * v[1] - x * y) / (1.0 + y**2)
    return [*v, -x - y * multiplier, -y, multiplier]


def _cvt(state: Sequence[Any]) -> list[Any]:
    x, y, z, *v = state
    sin, cos = hy.sin(y), hy.cos(y)
    square = sin**2
    multiplier = (x * sin + z - cos * (v[0] * v[1])) / (1.0 + square)
    # The parameter ε has its default ½. The identity cos 2y = 1 - 2 sin² y saves the
    # evaluation of a cosine.
    return [*v, sin * multiplier - x, square - sin - 0.5, multiplier - z]


def _chaotic(state: Sequence[Any]) -> list[Any]:
    q, v = state[:7], state[7:]
    s2, s3, s4, s5, s6, s7 = (x**2 for x in q[1:])
    stiffness = (1.0 + s2 + s6, 1.0 + s3 + s5, 1.0 + s4)
    pull = s5 * stiffness[0] + s6 * stiffness[1] + s7 * stiffness[2]
    speed = v[4] ** 2 + v[5] ** 2 + v[6] ** 2
    multiplier = (q[0] + pull - speed) / (1.0 + s5 + s6 + s7)
    free = [-q[1] * (1.0 + s5), -q[2] * (1.0 + s6), -q[3] * (1.0 + s7)]
    bound = [x * (multiplier - k) for x, k in zip(q[4:], stiffness, strict=True)]
    return [*v, multiplier - q[0], *free, *bound]


def _unicycle(state: Sequence[Any]) -> list[Any]:
    x1, x2, heading, u, omega = state
    cos, sin = hy.cos(heading), hy.sin(heading)
    return [u * cos, u * sin, omega, -(x1 * cos + x2 * sin), hy.expression(0.0)]


FIELDS: dict[str, tuple[int, Callable[[Sequence[Any]], list[Any]]]] = {
    "chaotic": (14, _chaotic),
    "particle": (6, _particle),
    "CVT": (6, _cvt),
    "unicycle": (5, _unicycle),
}


def equations(name: str) -> list[tuple[Any, Any]]:
    """Return the named system as pairs of a variable and its derivative."""
    size, field = FIELDS[name]
    variables = hy.make_vars(*(f"y{i:02}" for i in range(size)))
    return list(zip(variables, field(variables), strict=True))


def batch_size() -> int:
    """Return the number of members of a batch: the lanes of a vector of this CPU."""
    return hy.recommended_simd_size()


def layouts(members: int, threads: int) -> list[str]:
    """Return the names of the ways to run an ensemble.

    Each name consists of words: "single" or "batch", "ensemble" for
    `ensemble_propagate_until`, and "threads", which is used only if `threads` > 1.
    """
    if members == 1:
        return ["single"]
    alone = ["single", "batch", "ensemble single", "ensemble batch"]
    if threads == 1:
        return alone
    return [*alone, *(f"threads {x}" for x in alone if x != "single")]


def _into_batches(y: np.ndarray) -> np.ndarray:
    """Reshape (members, n) to (batches, n, lanes), padded with the last member."""
    lanes = batch_size()
    filled = np.concatenate([y, np.repeat(y[-1:], -len(y) % lanes, axis=0)])
    batches = filled.reshape(-1, lanes, y.shape[-1])
    return np.ascontiguousarray(batches.swapaxes(1, 2))


def _from_batches(y: np.ndarray, members: int) -> np.ndarray:
    """Reshape (batches, n, lanes) to (members, n), without the padding."""
    return y.swapaxes(1, 2).reshape(-1, y.shape[1])[:members]


def _restart(integrator: Any, start: np.ndarray) -> None:
    if start.ndim == 1:
        integrator.time = 0.0
    else:
        integrator.set_time(0.0)
    integrator.state[:] = start


def _one_by_one(t: float, integrator: Any, starts: np.ndarray) -> np.ndarray:
    """Integrate from each start, a member or a batch, with one integrator."""
    ends = np.empty_like(starts)
    for start, end in zip(starts, ends, strict=True):
        _restart(integrator, start)
        integrator.propagate_until(t)
        end[:] = integrator.state
    return ends


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


def _on_threads(t: float, integrators: list[Any], starts: np.ndarray) -> np.ndarray:
    """Integrate from all starts, with a thread and a share of them per integrator."""
    shares = np.array_split(starts, len(integrators))
    ends = _pool(len(integrators)).map(partial(_one_by_one, t), integrators, shares)
    return np.concatenate(list(ends))


def _as_ensemble(
    t: float, integrator: Any, starts: np.ndarray, threads: int
) -> np.ndarray:
    """Integrate from all starts by heyoka's own function for ensembles."""
    batched = starts.ndim == 3
    run = hy.ensemble_propagate_until_batch if batched else hy.ensemble_propagate_until

    def prepare(copy: Any, number: int) -> Any:
        _restart(copy, starts[number])
        return copy

    results = run(integrator, t, len(starts), prepare, max_workers=threads)
    return np.stack([result[0].state for result in results])


def heyoka_run(
    name: str, layout: str, y0: np.ndarray, t: float, threads: int = 1
) -> Callable[[float], tuple[Callable[[], np.ndarray], float]]:
    """Create a function from a tolerance to a run and its compile time in seconds.

    The run returns the states of all members at the end, in the shape (members, n) of
    `y0`. It uses one thread unless the layout contains "threads".
    """
    words = layout.split()
    threads = threads if "threads" in words else 1
    starts = _into_batches(y0) if "batch" in words else y0
    kind = hy.taylor_adaptive_batch if "batch" in words else hy.taylor_adaptive

    def prepare(tolerance: float) -> tuple[Callable[[], np.ndarray], float]:
        system = equations(name)
        hy.llvm_state.clear_memcache()
        begin = time.perf_counter()
        integrator = kind(system, starts[0], tol=tolerance, fast_math=True)
        seconds = time.perf_counter() - begin
        if "ensemble" in words:
            run = partial(_as_ensemble, t, integrator, starts, threads)
        elif threads > 1:
            copies = [integrator, *(deepcopy(integrator) for _ in range(threads - 1))]
            run = partial(_on_threads, t, copies, starts)
        else:
            run = partial(_one_by_one, t, integrator, starts)
        if "batch" not in words:
            return run, seconds
        return lambda: _from_batches(run(), len(y0)), seconds

    return prepare
