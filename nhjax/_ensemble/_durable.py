"""Files that are whole or not there, whatever interrupts their writing."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write(path: Path, content: bytes) -> None:
    """Write a file atomically: under another name, to the disk, and rename it then.

    The name of what is unfinished follows from `path`, so that what an interrupted run
    has left is written over by the next one.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(_unfinished(path), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(_unfinished(path), path)
    sync_folder(path.parent)


def ensure(path: Path, content: bytes) -> None:
    """Write a file unless it has this content, and let nothing unfinished be left."""
    if path.read_bytes() == content:
        _unfinished(path).unlink(missing_ok=True)
    else:
        write(path, content)


def _unfinished(path: Path) -> Path:
    return path.with_name(f".{path.name}.unfinished")


def append(path: Path, line: bytes) -> None:
    """Append to a file, onto the disk."""
    with open(path, "ab") as file:
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk, where the system can do so."""
    if os.name != "posix":
        return
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


@contextmanager
def explaining(what: str) -> Iterator[None]:
    """Begin the message of an `OSError` with `what`, which says what has failed."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno is None:
            raise type(error)(f"{what}: {reason}") from error
        text = f"{what}: {reason}"
        raise OSError(error.errno, text, error.filename) from error
