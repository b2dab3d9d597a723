"""The tasks of two JAX processes that run ensembles together.

The processes print their results to standard output.
"""

import errno
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax._ensemble import _sinks


CHUNKS, CHUNK = 200, 4


class Digits(nhjax.AbstractReduction):
    """Reads the members as the digits of a number, so that their order matters."""

    def init(self, value):
        """Create no digits, and the weight of the next digit."""
        return jnp.zeros((), int), jnp.ones((), int)

    def update(self, state, values, counts):
        """Append the digits of a chunk."""

        def add(state, x):
            digit, counts = x
            added = self.merge(state, (digit, jnp.array(10)))
            return jax.tree.map(
                lambda a, b: jnp.where(counts, a, b), added, state
            ), None

        return jax.lax.scan(add, state, (values.astype(int), counts))[0]

    def merge(self, one, other):
        """Append digits."""
        return one[0] * other[1] + other[0], one[1] * other[1]

    def finish(self, state):
        """Return the number."""
        return int(state[0])


class Total(nhjax.AbstractReduction):
    """A sum whose dtype changes when the first members are added."""

    def init(self, value):
        """Create an integer of 8 bits."""
        return jnp.zeros((), jnp.int8)

    def update(self, state, values, counts):
        """Add the members of a chunk."""
        return self.merge(state, jnp.sum(jnp.where(counts, values[0][:, 1], 0.0)))

    def merge(self, one, other):
        """Add sums."""
        return one.astype(float) + other

    def finish(self, state):
        """Return the sum."""
        return state


REDUCTIONS = {
    "mean": nhjax.Mean(),
    "total": Total(),
    "variance": nhjax.Variance(),
}


def judged(x):
    """Return powers quickly; fail for NaN."""
    good, bad = nhjax.RESULTS.successful, nhjax.RESULTS.nonfinite_state
    return jnp.exp(x * jnp.arange(3.0)), nhjax.RESULTS.where(jnp.isnan(x), bad, good)


MEMBERS = np.linspace(0.5, 1.5, 9)
MEMBERS[[3, 8]] = np.nan


def statistics(folder: Path | None = None, **options: Any) -> nhjax.EnsembleOutcome:
    """Compute statistics of members, some of which fail, in five chunks."""
    return nhjax.ensemble(
        judged, MEMBERS, chunk_size=2, reduce=REDUCTIONS, out=folder, **options
    )


def digits(**options: Any) -> int:
    """Compute the number 1234567."""
    return nhjax.ensemble(
        lambda i: i + 1,
        lambda i: i,
        num_members=7,
        chunk_size=2,
        reduce=Digits(),
        **options,
    ).statistics


def power(x):
    """Return powers quickly, along an axis of their own."""
    return {"powers": x ** jnp.arange(3.0), "is_large": x > 1.0}


def stored(folder: Path, **options: Any) -> nhjax.EnsembleOutcome:
    """Write many chunks to a store."""
    members = np.linspace(0.5, 1.5, CHUNKS * CHUNK - 1)
    chosen: dict[str, Any] = {"chunk_size": CHUNK, "out": folder} | options
    return nhjax.ensemble(power, members, **chosen)


def bits(tree: Any) -> str:
    """Return the bytes of the arrays of a tree as text."""
    return "".join(np.asarray(x).tobytes().hex() for x in jax.tree.leaves(tree))


def summary(folder: Path) -> dict[str, Any]:
    """Return the results that do not depend on the number of processes."""
    kept = statistics(folder / "kept")
    # With this size, no block of the exchange ends where a process's share ends.
    with mock.patch.object(_sinks, "_BLOCK", 80):
        values = nhjax.ensemble(judged, MEMBERS, chunk_size=2).values
    assert kept.failures() == statistics().failures()
    return {
        "failures": kept.failures(),
        "fixed": bits(statistics(fixed_order=True).statistics),
        "kept": bits(kept.statistics),
        "again": bits(statistics(folder / "kept").statistics),
        "digits": digits(),
        "rounds": digits(fixed_order=True),
        "values": bits(values),
    }


def together(index: int, folder: Path) -> None:
    """Compute statistics, then write a store, during which a process is killed."""
    print(repr(summary(folder)))
    print([np.asarray(x).tolist() for x in jax.tree.leaves(statistics().statistics)])
    sys.stdout.flush()
    try:
        stored(folder / "killed")
    except RuntimeError as error:
        print(str(error).splitlines()[0], flush=True)
        # JAX would wait for the killed process at a normal exit.
        os._exit(3)


def again(index: int, folder: Path) -> None:
    """Make different calls, fail in one process, and resume stores."""

    def refused(*args, call=stored, **options):
        try:
            call(*args, **options)
        except (ValueError, RuntimeError, OSError) as error:
            print(type(error).__name__, error)

    refused(folder / "new", chunk_size=4 + index)
    refused(call=digits, fixed_order=index == 1)
    refused(lambda i: i + index, num_members=3, call=partial(nhjax.ensemble, power))
    refused(folder / f"new-{index}")
    meter = Failing() if index == 1 else nhjax.NoProgressMeter()
    refused(folder / "bad", progress_meter=meter)
    for name in ("bad", "killed"):
        stored(folder / name)
    print(bits(statistics(folder / "begun").statistics))


class Failing(nhjax.AbstractProgressMeter):
    """Raises the error of a full disk."""

    def update(self, done: int, total: int) -> None:
        """Raise."""
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
