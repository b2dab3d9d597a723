"""The journal of a store: a line in JSON for each chunk that is done."""

import json
import os
from pathlib import Path
from typing import Any

from . import _durable as durable


class Journal:
    """The lines of the journal by the numbers of their chunks, and a lock on its file.

    The lock keeps other processes from writing to the store; it ends with the process.
    """

    def __init__(self, path: Path):
        self.path = path
        self.lines: dict[int, dict[str, Any]] = {}
        self._lock: int | None = None

    def open(self) -> None:
        """Take the lock and read the lines; the rest of an unfinished one goes."""
        self._take_lock()
        content = self.path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            os.truncate(self.path, len(whole))
        for number, text in enumerate(whole.splitlines()):
            try:
                line = json.loads(text)
                self.lines[line["chunk"]] = line
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"Line {number + 1} of {str(self.path)!r} is damaged. Delete it, "
                    "and the members of its chunk are run again."
                ) from error

    def append(self, line: dict[str, Any]) -> None:
        """Add the line of a chunk whose files are on the disk."""
        text = json.dumps(line, separators=(",", ":")) + "\n"
        durable.append(self.path, text.encode())
        self.lines[line["chunk"]] = line

    def close(self) -> None:
        """Give the lock back."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _take_lock(self) -> None:
        try:
            import fcntl
        except ImportError:
            # There is none on this system.
            return
        self._lock = os.open(self.path, os.O_RDWR)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RuntimeError(
                f"The store of {str(self.path)!r} is being written by another process."
            ) from error
