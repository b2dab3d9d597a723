import os
import reprlib
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from .._integrate import AbstractProgressMeter, NoProgressMeter, TqdmProgressMeter
from .._system import check_flag
from ._processes import PeriodicExchange, Processes
from ._program import is_reduction, Job, Layout, Members, value_structure
from ._sinks import (
    AbstractSink,
    EnsembleOutcome,
    failures_in_chunk,
    MemorySink,
    ReductionSink,
)
from ._store import CheckpointedReductionSink, ZarrSink


# The default size of a chunk is `_MEMBERS` members for each device, enough to use all
# cores. If the values of these members would take more than `_BYTES` bytes, the chunk
# has fewer members.
_MEMBERS, _BYTES = 1024, 2**26
# Suffixes of file formats. `out` names a folder, and must not end in one of them.
_FILES = (".nc", ".nc4", ".h5", ".hdf5", ".csv", ".npy", ".npz", ".mat", ".pkl")
# The shortest time between two updates of a progress meter.
_SECONDS = 0.1


def ensemble(
    run: Callable[[Any], PyTree[Any]],
    members: Any,
    *,
    num_members: int | None = None,
    out: str | os.PathLike[str] | None = None,
    reduce: Any = None,
    chunk_size: int | None = None,
    devices: Sequence[Any] | None = None,
    fixed_order: bool = False,
    progress_meter: AbstractProgressMeter | None = None,
    resume: bool = True,
    units: Mapping[str, str] | None = None,
) -> EnsembleOutcome:
    """Run a function for every member of an ensemble, in chunks of members.

    This function computes `jax.vmap(run)(members)`, even for more members than fit into
    memory at a time. The same compiled programs run all chunks, and spread the members
    of a chunk over all devices. The last chunk is padded with members that are ignored.

    If `run` returns an `nhjax.Solution` or `nhjax.RESULTS`, alone or as part of a tree,
    the outcome lists the members whose runs failed, and the statistics of `reduce` do
    not include them. In `run`, call `nhjax.integrate` with `throw=False`; otherwise the
    first failure ends the whole ensemble.

    After `jax.distributed.initialize`, all processes must make the same call. Each
    process runs its share of the chunks on its own devices, and returns the whole
    outcome.

    **Arguments:**

    - `run`: a function of one member that returns a tree of arrays.
    - `members`: a tree of arrays with the members as leading axis, or a function from
        the index of a member to the member. JAX traces this function, and each
        chunk creates only its own members, which saves memory.
    - `num_members`: the number of members, if `members` is a function.
    - `out`: a folder for a Zarr store, to which the values that `run` returns are
        written, chunk by chunk. `xarray.open_zarr` opens the store. If a run is
        interrupted, the same call resumes it. With `reduce`, the folder holds the
        states of the reductions instead of values. See `docs/ensembles.md`.
    - `reduce`: an `nhjax.Mean`, `nhjax.Variance`, `nhjax.Minimum`, `nhjax.Maximum`,
        `nhjax.Histogram`, your own `nhjax.AbstractReduction`, or a tree of these such
        as a dictionary. With `reduce`, values are not kept, and memory does not grow
        with the number of members.
    - `chunk_size`: the number of members that run at a time, rounded up to a multiple
        of the number of devices; by default 1024 for each device, or fewer if the
        values of a member are large.
    - `devices`: the JAX devices to use, `jax.local_devices()` by default.
    - `fixed_order`: compute statistics in an order that does not depend on the number
        of devices and processes. Two runs with the same `chunk_size` then have bitwise
        equal statistics if their members have bitwise equal values. This order takes
        more time, because each device reduces all members of a chunk, and processes
        wait for each other after each chunk.
    - `progress_meter`: shows the number of finished members; by default a bar on the
        standard error stream if that is a terminal.
    - `resume`: whether to resume the run of an existing store; if False, an existing
        store raises a `FileExistsError`.
    - `units`: units of the arrays in the store, by the names of the arrays.

    **Returns:** an `nhjax.EnsembleOutcome` with `values` or `statistics`, or with
    neither if values were written to `out`.

    **Raises:** `nhjax.ShapeError` for arrays with leading axes of different lengths;
    `TypeError` if `run` returns anything except arrays; `ValueError` for invalid
    numbers, for a store that is damaged or belongs to other arguments, and if processes
    call `ensemble` with different arguments; `RuntimeError` for a store that another
    run is writing, and if another process has failed or has ended; `OSError` if the
    store cannot be written; `ImportError` with `out` if zarr is missing
    (`pip install "nhjax[ensemble]"`); `nhjax.IntegrationError` with `reduce` if all
    members failed.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(lambda x: x**2, jnp.arange(5.0), chunk_size=2)
        >>> outcome.values.tolist()
        [0.0, 1.0, 4.0, 9.0, 16.0]
    """
    processes = Processes()
    with processes.sharing_errors():
        if not callable(run):
            got = f"{reprlib.repr(run)} of type {type(run).__name__}"
            raise TypeError(f"`run` must be a function of one member, got {got}.")
        if reduce is not None:
            _check_reductions(reduce)
        _check_folder(out)
        resume = check_flag("resume", resume)
        fixed_order = check_flag("fixed_order", fixed_order)
        progress_meter = _check_progress_meter(progress_meter, processes)
        chosen = _check_devices(devices)
        layout = Layout(chosen, fixed_order and len(chosen) > 1)
        source = Members(members, num_members)
        structure = value_structure(run, source.make, source.inputs(0, 1))
        size = _chunk_size(chunk_size, source.count, structure, len(layout.devices))
        job = Job(run, source, size, layout, structure, processes)
        sink = _sink(job, reduce, out, units, resume, fixed_order)
        try:
            _run_chunks(job, sink, progress_meter)
            outcome = sink.outcome()
        finally:
            sink.close()
    return outcome


def _sink(
    job: Job,
    reductions: Any,
    out: str | os.PathLike[str] | None,
    units: Mapping[str, str] | None,
    resume: bool,
    fixed_order: bool,
) -> AbstractSink:
    if reductions is None:
        if out is not None:
            return ZarrSink(job, out, {} if units is None else units, resume)
        if units is not None:
            raise ValueError("`units` are for a store: name its folder by `out`.")
        return MemorySink(job)
    if units is not None:
        raise ValueError(
            "`units` are for the values in a store, but with `reduce` no values are "
            "kept: leave `units` out."
        )
    if out is not None:
        return CheckpointedReductionSink(job, reductions, out, resume)
    sink = ReductionSink(job, reductions, in_rounds=fixed_order)
    sink.check_same_call()
    return sink


def _run_chunks(
    job: Job, sink: AbstractSink, progress_meter: AbstractProgressMeter
) -> None:
    todo, total = list(sink.remaining_chunks()), job.members.count
    if job.processes.count > 1:
        total = sum(map(job.num_members, todo))
    done = total - sum(map(job.num_members, todo))
    shown = time.monotonic()
    exchange = PeriodicExchange(job.processes, len(todo), not sink.in_rounds)
    if todo and done:
        progress_meter.update(done, total)

    def finish(chunk, result):
        nonlocal done, shown
        sink.collect(chunk, result.content, failures_in_chunk(job, chunk, result))
        done += job.num_members(chunk)
        if done == total or time.monotonic() - shown > _SECONDS:
            shown = time.monotonic()
            progress_meter.update(done, total)
        exchange.chunk_done()

    running = None
    try:
        for chunk in todo:
            # The next chunk runs while the results of the previous one are collected.
            following = chunk, sink.start(chunk)
            if running is not None:
                finish(*running)
            running = following
        if running is not None:
            finish(*running)
        exchange.finish()
    except jax.errors.JaxRuntimeError as error:
        if "throw=False" in str(error):
            error.add_note(
                "In `nhjax.ensemble`, a run with `throw=False` that returns its "
                "solution fails alone: it is listed, and the other members go on."
            )
        raise
    finally:
        progress_meter.close()


def _check_reductions(reductions: Any) -> None:
    leaves = jax.tree.leaves(reductions, is_leaf=is_reduction)
    for leaf in leaves:
        if not is_reduction(leaf):
            raise TypeError(
                f"`reduce` holds {leaf!r}, but it must be a reduction, such as "
                "`nhjax.Mean()`, or several in a tuple, a dictionary or another tree."
            )
    if not leaves:
        raise TypeError(f"`reduce` holds no reduction: {reductions!r}.")


def _check_folder(out: Any) -> None:
    if out is None:
        return
    if not isinstance(out, str | os.PathLike):
        raise TypeError(
            f"`out` must be the name of a folder, got {reprlib.repr(out)} of type "
            f"{type(out).__name__}."
        )
    suffix = os.path.splitext(out)[1].lower()
    if suffix in _FILES:
        raise ValueError(
            f"`out` is {os.fspath(out)!r}, but it names a folder, in which programs "
            f"that read {suffix} find no file: use a name without suffix or with "
            ".zarr, which `xarray.open_zarr` opens."
        )


def _check_progress_meter(given: Any, processes: Processes) -> AbstractProgressMeter:
    if given is None:
        is_shown = processes.index == 0 and sys.stderr.isatty()
        return TqdmProgressMeter(unit="member") if is_shown else NoProgressMeter()
    if not isinstance(given, AbstractProgressMeter):
        raise TypeError(
            "`progress_meter` must be a progress meter such as "
            f"`nhjax.TqdmProgressMeter()`, got {given!r}."
        )
    return given


def _check_devices(devices: Sequence[Any] | None) -> tuple[Any, ...]:
    if devices is None:
        return tuple(jax.local_devices())
    if isinstance(devices, str) or not isinstance(devices, Iterable):
        raise TypeError(
            "`devices` must be a sequence of devices, such as `jax.local_devices()[:2]`"
            f", got {devices!r}."
        )
    chosen = tuple(devices)
    if not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(
            f"`devices` must be one or more different devices, got {chosen}."
        )
    known = jax.local_devices()
    for device in chosen:
        if device not in known and device not in jax.local_devices(
            backend=getattr(device, "platform", None)
        ):
            raise ValueError(
                f"`devices` has {device!r}, which is not a device of this process."
            )
    return chosen


def _chunk_size(size: int | None, count: int, structure: Any, num_devices: int) -> int:
    if size is None:
        leaves = jax.tree.leaves(structure)
        each = sum(x.size * np.dtype(x.dtype).itemsize for x in leaves)
        size = num_devices * max(1, min(_MEMBERS, _BYTES // max(1, each)))
    elif isinstance(size, bool) or not isinstance(size, int | np.integer):
        raise TypeError(f"`chunk_size` must be an int, got {size!r}.")
    elif size < 1:
        raise ValueError(f"`chunk_size` must be at least 1, got {size}.")
    size = min(int(size), count)
    return -(-size // num_devices) * num_devices
