"""The results of studies: their interface, their timing, and the files they write."""

import abc
import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np

from .._integrate import AbstractProgressMeter, NoProgressMeter, TqdmProgressMeter
from ._report import colour_blind_safe


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
        """Return every parameter of the computation, initial data included."""

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
    # The callbacks of progress meters may end after the program.
    jax.effects_barrier()
    return value, Timing(compiled - start, time.perf_counter() - compiled)


def meter(
    progress: bool, description: str, unit: str = "step"
) -> AbstractProgressMeter:
    """Create a progress bar on the standard error stream, or none."""
    return TqdmProgressMeter(description, unit) if progress else NoProgressMeter()


def system_parameters(example: Any) -> dict[str, Any]:
    """Return the parameters of an example of the gallery without the initial data."""
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
    """Return the versions, the precision and the device that affect the numbers."""
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
