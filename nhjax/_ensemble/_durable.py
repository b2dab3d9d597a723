"""Files that survive a crash: atomic writes, locks, and a journal of finished chunks.

A file is either complete or absent, even if writing it is interrupted. A lock ends with
the process that holds it.
"""

import errno
import json
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


# The error numbers of a file system without locks.
_NO_LOCKS = errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS
JOURNAL = "chunks.jsonl"
_PARTS = "chunks-*.jsonl"

Line = dict[str, Any]


def write(path: Path, content: bytes) -> None:
    """Write a file atomically: write and sync a temporary file, then rename it.

    The temporary name is derived from `path`, so that the next run overwrites the
    leftover of an interrupted run.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(_temporary(path), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(_temporary(path), path)
    sync_folder(path.parent)


def write_if_different(path: Path, content: bytes) -> None:
    """Write a file if its content differs; otherwise delete its temporary file."""
    if path.read_bytes() == content:
        _temporary(path).unlink(missing_ok=True)
    else:
        write(path, content)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.unfinished")


def append(path: Path, line: bytes) -> None:
    """Append to a file and sync it to the disk."""
    with open(path, "ab") as file:
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Sync the entries of a folder to the disk, if the system supports it."""
    if os.name != "posix":
        return
    opened = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


@contextmanager
def explaining(what: str) -> Iterator[None]:
    """Put `what`, the name of a failed action, before the message of an `OSError`."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno is None:
            raise type(error)(f"{what}: {reason}") from error
        text = f"{what}: {reason}"
        raise OSError(error.errno, text, error.filename) from error


class Lock:
    """An exclusive lock on a file. A file system without locks causes a warning."""

    def __init__(self):
        self._opened: int | None = None

    def acquire(self, path: Path, what: str) -> None:
        """Lock a file, and create it if it does not exist.

        `what` names the folder of the file in messages.

        **Raises:** `RuntimeError` if another process has locked the file, or if the
        operating system has no such locks.
        """
        self._opened = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            import fcntl

            fcntl.flock(self._opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError as error:
            self.release()
            raise RuntimeError(
                f"{what} cannot be locked, so that two processes might write to it at "
                "the same time: this system has no module `fcntl`. Leave out `out=`, "
                "or use a system that has it, such as Linux or macOS."
            ) from error
        except BlockingIOError as error:
            self.release()
            raise RuntimeError(
                f"{what} is being written by another process."
            ) from error
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                self.release()
                raise
            warnings.warn(
                f"{what} lies on a file system without locks: make sure that no other "
                "process writes to it.",
                stacklevel=2,
            )

    def write(self, text: bytes) -> None:
        """Replace the content of the locked file, and sync it to the disk."""
        assert self._opened is not None
        if not text and not os.fstat(self._opened).st_size:
            return
        os.ftruncate(self._opened, 0)
        os.lseek(self._opened, 0, os.SEEK_SET)
        os.write(self._opened, text)
        os.fsync(self._opened)

    def release(self) -> None:
        """Release the lock, if it is held."""
        if self._opened is not None:
            os.close(self._opened)
            self._opened = None


class Journal:
    """The journal of an ensemble's store: a line of JSON for each finished chunk.

    Process 0 appends to the journal. Every other process appends to a file of its own,
    a part, which it locks while it runs. A run begins and ends with a single journal:
    process 0 first appends the parts that an interrupted run has left, and at the end
    writes the lines of all processes in the order of chunks. `lines` contains the lines
    that this process has written.
    """

    def __init__(self, folder: Path, index: int):
        self.folder, self.lines = folder, dict[int, Line]()
        name = JOURNAL if index == 0 else _PARTS.replace("*", str(index))
        self.path, self._lock = folder / name, Lock()
        self._where = f"The store {str(folder.parent)!r}"

    def merge_parts(self) -> dict[int, Line]:
        """Move all parts into the journal, and return its lines by chunk."""
        complete, has_fragment = _complete_lines(self.path)
        if has_fragment:
            os.truncate(self.path, len(complete))
        for part in sorted(self.folder.glob(_PARTS)):
            lock = Lock()
            # The lock fails if a process of the interrupted run is still running.
            lock.acquire(part, self._where)
            if lines := _complete_lines(part)[0]:
                append(self.path, lines)
            part.unlink()
            lock.release()
        sync_folder(self.folder)
        return self._read()

    def open_part(self) -> None:
        """Create and lock the part of a process other than process 0."""
        self._lock.acquire(self.path, self._where)
        sync_folder(self.folder)

    def append(self, line: Line) -> None:
        """Append the line of a chunk whose files are on the disk."""
        append(self.path, _as_bytes([line]))
        self.lines[line["chunk"]] = line

    def finish(self, lines: dict[int, Line]) -> None:
        """Write `lines` in the order of chunks, and delete the parts."""
        content = _as_bytes([lines[chunk] for chunk in sorted(lines)])
        write_if_different(self.path, content)
        for part in self.folder.glob(_PARTS):
            part.unlink()

    def close(self) -> None:
        """Unlock the part of this process."""
        self._lock.release()

    def _read(self) -> dict[int, Line]:
        lines = {}
        for number, text in enumerate(self.path.read_bytes().splitlines()):
            try:
                line = json.loads(text)
                lines[line["chunk"]] = line
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"Line {number + 1} of {str(self.path)!r} is damaged. Delete the "
                    "line; the same call then runs the members of its chunk again."
                ) from error
        return lines


def _as_bytes(lines: list[Line]) -> bytes:
    texts = [json.dumps(line, separators=(",", ":")) + "\n" for line in lines]
    return "".join(texts).encode()


def _complete_lines(path: Path) -> tuple[bytes, bool]:
    """Read the complete lines; also return whether an incomplete line follows."""
    content = path.read_bytes()
    complete = content[: content.rfind(b"\n") + 1]
    return complete, len(complete) < len(content)
