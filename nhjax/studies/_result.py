"""The results of studies: their interface, timing, tables, figures and files."""

import abc
import contextlib
import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np

from .._integrate import AbstractProgressMeter, NoProgressMeter, TqdmProgressMeter
from ..diagnostics import convergence_order


if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True)
class Timing:
    """The wall-clock seconds to compile and to run one program."""

    compile_seconds: float
    run_seconds: float


class AbstractStudyResult(abc.ABC):
    """The outcome of a study: numbers, a table and figures."""

    name: ClassVar[str]

    @abc.abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Return every parameter of the computation, including initial data."""

    @abc.abstractmethod
    def summary(self) -> dict[str, Any]:
        """Return a summary of the results, with timings."""

    @abc.abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return the data behind the figures, by name."""

    @abc.abstractmethod
    def table(self) -> str:
        """Format the main results as a table of text."""

    @abc.abstractmethod
    def verdict(self) -> str:
        """State the main result in one line."""

    @abc.abstractmethod
    def figures(self) -> "dict[str, Figure]":
        """Draw the figures; return them by file name without suffix."""


def write(result: AbstractStudyResult, directory: str | Path) -> dict[str, Any]:
    """Write the figures (PNG), the data (NPZ) and the record (JSON) of a study.

    **Arguments:**

    - `result`: the result of a study.
    - `directory`: the folder; it is created if it does not exist.

    **Returns:** the record, as in the JSON file.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    data = directory / f"{result.name}.npz"
    np.savez_compressed(data, **result.arrays())  # pyright: ignore[reportArgumentType]
    pictures = []
    with colour_blind_safe():
        for name, figure in result.figures().items():
            picture = directory / f"{name}.png"
            figure.savefig(picture, dpi=150)
            pictures.append(str(picture))
    path = directory / f"{result.name}.json"
    record = {
        "study": result.name,
        "parameters": result.parameters(),
        "results": result.summary(),
        "environment": environment(),
        "files": {"record": str(path), "data": str(data), "figures": pictures},
    }
    record = _plain(record)
    path.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n")
    return record


def compile_and_run(function: Callable[..., Any], *args: Any) -> tuple[Any, Timing]:
    """Compile and run `function(*args)` as one program; return its value and timing."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    compiled = time.perf_counter()
    value = jax.block_until_ready(program(*args))
    # The callbacks of progress meters may end later than the program.
    jax.effects_barrier()
    return value, Timing(compiled - start, time.perf_counter() - compiled)


def meter(
    progress: bool, description: str, unit: str = "step"
) -> AbstractProgressMeter:
    """Create a progress bar on the standard error stream, or a meter without output."""
    return TqdmProgressMeter(description, unit) if progress else NoProgressMeter()


def system_parameters(example: Any) -> dict[str, Any]:
    """Return the parameters of an example of the gallery, without its initial data."""
    values = {
        field.name: getattr(example, field.name)
        for field in dataclasses.fields(example)
        if field.name not in ("q0", "v0")
    }
    return {
        name: type(x).__name__ if isinstance(x, eqx.Module) else np.asarray(x).tolist()
        for name, x in values.items()
    }


def initial_data(example: Any) -> dict[str, Any]:
    """Return the initial data of an example of the gallery."""
    return {
        "q0": jax.tree.map(np.asarray, example.q0),
        "v0": np.asarray(example.v0),
        "multiplier": "continuous, from the hidden constraint",
    }


def environment() -> dict[str, Any]:
    """Return the versions, the precision and the device that affect the results."""
    device = jax.devices()[0]
    packages = ("nhjax", "jax", "jaxlib", "equinox", "numpy", "matplotlib")
    return {
        "versions": {name: importlib.metadata.version(name) for name in packages},
        "python": platform.python_version(),
        "precision": str(np.dtype(jax.numpy.result_type(float))),
        "device": {"platform": device.platform, "kind": device.device_kind},
        "cpu_count": os.cpu_count(),
    }


def _plain(x: Any) -> Any:
    """Convert `x` to JSON values, with null for numbers that are not finite."""
    if isinstance(x, Mapping):
        return {str(key): _plain(value) for key, value in x.items()}
    if isinstance(x, list | tuple | np.ndarray):
        return [_plain(value) for value in x]
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        return _plain(dataclasses.asdict(x))
    if isinstance(x, np.generic):
        x = x.item()
    return None if isinstance(x, float) and not math.isfinite(x) else x


if TYPE_CHECKING:
    from matplotlib.axes import Axes


# The colours of Okabe and Ito, which colour-blind readers can distinguish; most of them
# also differ in a grey print.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
# The number of bins of an envelope. With so few bins the envelope has smooth edges.
BINS = 200


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table as text, with right-aligned columns under a header and a ruler."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    ruler = ["-" * width for width in widths]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in (header, ruler, *rows)
    )


def format_slope(x: float) -> str:
    """Format a slope with two decimals, or as a dash if it is not finite."""
    return f"{x:.2f}" if np.isfinite(x) else "-"


def largest_by_fifths(error: np.ndarray) -> list[float]:
    """Compute max |error| over each fifth of a run."""
    return [float(np.max(part)) for part in np.array_split(np.abs(error), 5)]


def slopes(
    step_sizes: Sequence[float] | np.ndarray, errors: np.ndarray, floor: float = 0.0
) -> np.ndarray:
    """Compute observed orders in the shape of `errors`, with NaN for undefined orders.

    The first row is NaN, because there is no larger step size to compare with. Orders
    that are computed from errors at or below `floor` are NaN too, because these errors
    are round-off.
    """
    above = errors > floor
    order = np.full(errors.shape, np.nan)
    if len(errors) > 1:
        order[1:] = convergence_order(
            np.asarray(step_sizes), np.where(above, errors, 1.0)
        )
        order[1:][~(above[1:] & above[:-1])] = np.nan
    return order


def envelope(
    times: np.ndarray, values: np.ndarray, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the minimum and maximum of `values` in each of `bins` time intervals.

    The results are the middles of the intervals, the minima and the maxima. Values that
    are not finite are ignored; the minimum and maximum of an interval without finite
    values are NaN.
    """
    starts = np.linspace(0, len(times), bins + 1).astype(int)[:-1]
    finite = np.isfinite(values)
    low = np.minimum.reduceat(np.where(finite, values, np.inf), starts)
    high = np.maximum.reduceat(np.where(finite, values, -np.inf), starts)
    ends = np.append(starts[1:], len(times)) - 1
    seen = low <= high
    return (
        0.5 * (times[starts] + times[ends]),
        np.where(seen, low, np.nan),
        np.where(seen, high, np.nan),
    )


def draw_envelope(
    ax: "Axes", times: np.ndarray, values: np.ndarray, *, color: str, label: str
) -> None:
    """Draw a curve, or its envelope if the curve has many more points than bins."""
    if len(times) <= 10 * BINS:
        ax.plot(times, values, linewidth=0.8, color=color, label=label)
        return
    middles, low, high = envelope(times, values)
    ax.fill_between(middles, low, high, color=color, alpha=0.25, linewidth=0)
    for edge, name in ((low, None), (high, label)):
        ax.plot(middles, edge, linewidth=0.8, color=color, label=name)


@contextlib.contextmanager
def colour_blind_safe() -> Iterator[None]:
    """Use colours that everyone can distinguish, for the figures drawn in the block."""
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context({"axes.prop_cycle": cycler(color=COLOURS)}):
        yield
