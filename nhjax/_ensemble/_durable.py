"""Files that are whole or not there, whatever interrupts their writing."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write(path: Path, content: bytes) -> None:
    """Write a file beside its place, onto the disk, and put it into its place then.

    The name of what is unfinished follows from `path`, so that what an interrupted run
    has left is written over by the next one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.unfinished")
    with open(unfinished, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(unfinished, path)
    settle(path.parent)


def append(path: Path, line: bytes) -> None:
    """Append to a file, onto the disk."""
    with open(path, "ab") as file:
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def settle(folder: Path) -> None:
    """Bring the names in a folder onto the disk, where the system can do so."""
    if os.name != "posix":
        return
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


@contextmanager
def telling(what: str) -> Iterator[None]:
    """Say with errors of the system what could not be done."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno is None:
            raise type(error)(f"{what}: {reason}") from error
        text = f"{what}: {reason}"
        raise OSError(error.errno, text, error.filename) from error
