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
from ._collected import Collected
from ._failed import failed_rows
from ._kept import Kept
from ._members import Members
from ._outcome import EnsembleOutcome
from ._processes import Pace, Processes
from ._program import Layout, value_structure
from ._reduced import check_reductions, Reduced
from ._sinks import AbstractSink, Work
from ._store import Stored


# Chunks of this many members for each device keep all lanes busy, if their results are
# not larger than so many bytes.
_MEMBERS, _BYTES = 1024, 2**26
# Names of files of other programs, which `out` does not make.
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
    """Run a function for every member of an ensemble, chunk after chunk.

    It computes `jax.vmap(run)(members)` for more members than fit into one array. One
    program is compiled for all chunks, with the members of a chunk spread over all
    devices; the last chunk is filled up with members that do not count.

    Where `run` returns an `nhjax.Solution` or `nhjax.RESULTS`, alone or as a part of a
    tree, members whose runs failed are listed in the outcome and left out of
    statistics. For that `nhjax.integrate` must be called with `throw=False`; otherwise
    the first failure ends the whole ensemble.

    After `jax.distributed.initialize` all processes make the same call: each runs its
    share of the chunks on its own devices, and every one returns the whole outcome.

    **Arguments:**

    - `run`: a function of one member that returns a tree of arrays.
    - `members`: a tree of arrays with the members as leading axis, or a function that
        JAX can trace from the index of a member to the member, which takes no memory.
    - `num_members`: how many members there are, if `members` is a function.
    - `out`: a folder for a store of Zarr that the values are written to, chunk after
        chunk, and `xarray.open_zarr` opens. The same call goes on with a store that an
        interrupted one has left. With `reduce` the states of the reductions are kept
        there instead. `docs/ensembles.md` says more.
    - `reduce`: an `nhjax.Mean`, `nhjax.Variance`, `nhjax.Minimum`, `nhjax.Maximum`,
        `nhjax.Histogram`, an `nhjax.AbstractReduction` of one's own, or a tree of them
        such as a dictionary. Then values are not kept, and memory does not grow with
        the number of members.
    - `chunk_size`: how many members run at a time, rounded up to a multiple of the
        number of devices; by default 1024 for each device, or fewer if they return
        much.
    - `devices`: those of JAX to run on, `jax.local_devices()` by default.
    - `fixed_order`: collect statistics in an order that does not depend on the number
        of devices and processes, so that they are the same to the last bit if the
        members are. Each device then looks at all members of a chunk, and processes
        meet after each.
    - `progress_meter`: told of members that are done; by default a bar on the standard
        error stream if that is a terminal.
    - `resume`: whether to go on with a store that exists, rather than to refuse it.
    - `units`: units of arrays in the store, by their names there.

    **Returns:** an `nhjax.EnsembleOutcome` with `values` or `statistics`, or with
    neither if values were written to `out`.

    **Raises:** `nhjax.ShapeError` for arrays that differ in their leading axis;
    `TypeError` if `run` returns anything but arrays; `ValueError` for numbers that make
    no sense, for a store that is damaged or that of other arguments, and for processes
    that call with different ones; `RuntimeError` for a store that another run is
    writing, and if another process has failed or is gone; `OSError` if the store cannot
    be written; `ImportError` with `out` and without zarr
    (`pip install "nhjax[ensemble]"`); `nhjax.IntegrationError` if all members failed
    and there is something to reduce.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> outcome = nhjax.ensemble(lambda x: x**2, jnp.arange(5.0), chunk_size=2)
        >>> outcome.values.tolist()
        [0.0, 1.0, 4.0, 9.0, 16.0]
    """
    processes = Processes()
    with processes.together():
        if not callable(run):
            got = f"{reprlib.repr(run)} of type {type(run).__name__}"
            raise TypeError(f"`run` must be a function of one member, got {got}.")
        if reduce is not None:
            check_reductions(reduce)
        _check_folder(out)
        resume = check_flag("resume", resume)
        fixed_order = check_flag("fixed_order", fixed_order)
        progress_meter = _meter(progress_meter, processes)
        chosen = _devices(devices)
        layout = Layout(chosen, fixed_order and len(chosen) > 1)
        source = Members(members, num_members)
        structure = value_structure(run, source.make, source.inputs(0, 1))
        size = _chunk_size(chunk_size, source.count, structure, len(layout.devices))
        work = Work(run, source, size, layout, structure, processes)
        if reduce is None:
            sink = _for_values(work, out, units, resume)
        else:
            sink = _for_statistics(work, reduce, out, units, resume, fixed_order)
        try:
            _run_chunks(work, sink, progress_meter)
            outcome = sink.outcome()
        finally:
            sink.close()
    return outcome


def _check_folder(out: Any) -> None:
    """Raise for what is no name, or the name of a file of another program."""
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
            f"that read {suffix} find nothing: use a name without suffix or with "
            ".zarr, which `xarray.open_zarr` opens."
        )


def _meter(given: Any, processes: Processes) -> AbstractProgressMeter:
    if given is None:
        is_shown = processes.index == 0 and sys.stderr.isatty()
        return TqdmProgressMeter(unit="member") if is_shown else NoProgressMeter()
    if not isinstance(given, AbstractProgressMeter):
        raise TypeError(
            "`progress_meter` must be a progress meter such as "
            f"`nhjax.TqdmProgressMeter()`, got {given!r}."
        )
    return given


def _for_values(
    work: Work,
    out: str | os.PathLike[str] | None,
    units: Mapping[str, str] | None,
    resume: bool,
) -> AbstractSink:
    if out is not None:
        return Stored(work, out, {} if units is None else units, resume)
    if units is not None:
        raise ValueError("`units` are those of a store: give its folder as `out`.")
    return Collected(work)


def _for_statistics(
    work: Work,
    reductions: Any,
    out: str | os.PathLike[str] | None,
    units: Mapping[str, str] | None,
    resume: bool,
    fixed_order: bool,
) -> AbstractSink:
    if units is not None:
        raise ValueError("`units` are those of values, which `reduce` does not keep.")
    if out is not None:
        return Kept(work, reductions, out, resume)
    sink = Reduced(work, reductions, in_rounds=fixed_order)
    sink.agree()
    return sink


def _run_chunks(
    work: Work, sink: AbstractSink, progress_meter: AbstractProgressMeter
) -> None:
    todo, total = list(sink.todo()), work.members.count
    if work.processes.count > 1:
        total = sum(map(work.filled, todo))
    done = total - sum(map(work.filled, todo))
    shown = time.monotonic()
    pace = Pace(work.processes, len(todo), is_needed=not sink.in_rounds)
    if todo and done:
        progress_meter.update(done, total)

    def finish(chunk, result):
        nonlocal done, shown
        codes, steps = np.asarray(result.codes), np.asarray(result.steps)
        count = work.filled(chunk)
        failed = failed_rows(work.start(chunk), codes[:count], steps[:count])
        sink.take(chunk, result.content, failed)
        done += count
        if done == total or time.monotonic() - shown > _SECONDS:
            shown = time.monotonic()
            progress_meter.update(done, total)
        pace.chunk_done()

    running = None
    try:
        for chunk in todo:
            # The next chunk runs while the one before it is put away.
            following = chunk, sink.start(chunk)
            if running is not None:
                finish(*running)
            running = following
        if running is not None:
            finish(*running)
        pace.finish()
    except jax.errors.JaxRuntimeError as error:
        if "throw=False" in str(error):
            error.add_note(
                "In `nhjax.ensemble` a run with `throw=False` that returns its "
                "solution fails alone: it is listed, and the others go on."
            )
        raise
    finally:
        progress_meter.close()


def _devices(devices: Sequence[Any] | None) -> tuple[Any, ...]:
    if devices is None:
        return tuple(jax.local_devices())
    if isinstance(devices, str) or not isinstance(devices, Iterable):
        raise TypeError(
            "`devices` must be a sequence of devices, such as `jax.local_devices()[:2]`"
            f", got {devices!r}."
        )
    chosen = tuple(devices)
    if not chosen or len(set(chosen)) < len(chosen):
        raise ValueError(f"`devices` must be different devices, got {chosen}.")
    known = jax.local_devices()
    for device in chosen:
        if device not in known and device not in jax.local_devices(
            backend=getattr(device, "platform", None)
        ):
            raise ValueError(
                f"`devices` has {device!r}, which is no device of this process."
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
