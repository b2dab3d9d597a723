"""The journal of a store: a line in JSON for each chunk that is done."""

import json
import os
from pathlib import Path
from typing import Any

from . import _durable as durable
from ._lock import Lock


NAME = "chunks.jsonl"
_PARTS = "chunks-*.jsonl"

Line = dict[str, Any]


class Journal:
    """The lines of the journal that this process writes, by the numbers of chunks.

    Process 0 appends to the journal itself, every other one to a part of its own, whose
    lock tells that it still runs. A run begins with one journal, to which process 0 has
    appended the parts that an interrupted run has left, and ends with one, in the order
    of chunks.
    """

    def __init__(self, folder: Path, index: int):
        self.folder, self.lines = folder, dict[int, Line]()
        name = NAME if index == 0 else _PARTS.replace("*", str(index))
        self.path, self._lock = folder / name, Lock()
        self._where = f"The store {str(folder.parent)!r}"

    def collect(self) -> dict[int, Line]:
        """Append the parts that there are to the journal, and return all its lines."""
        _whole_lines(self.path, is_cut=True)
        for part in sorted(self.folder.glob(_PARTS)):
            lock = Lock()
            # A process of an interrupted run may outlive the others for a while.
            lock.take(part, self._where)
            if lines := _whole_lines(part):
                durable.append(self.path, lines)
            part.unlink()
            lock.release()
        durable.sync_folder(self.folder)
        return self._read()

    def open_part(self) -> None:
        """Begin the part of a process that is not the first."""
        self._lock.take(self.path, self._where)
        durable.sync_folder(self.folder)

    def append(self, line: Line) -> None:
        """Add the line of a chunk whose files are on the disk."""
        durable.append(self.path, _written([line]))
        self.lines[line["chunk"]] = line

    def finish(self, lines: dict[int, Line]) -> None:
        """Let the journal have these lines in order, and remove the parts."""
        content = _written([lines[chunk] for chunk in sorted(lines)])
        durable.ensure(self.path, content)
        for part in self.folder.glob(_PARTS):
            part.unlink()

    def close(self) -> None:
        """Let the part be appended to the journal by others."""
        self._lock.release()

    def _read(self) -> dict[int, Line]:
        lines = {}
        for number, text in enumerate(self.path.read_bytes().splitlines()):
            try:
                line = json.loads(text)
                lines[line["chunk"]] = line
            except (ValueError, KeyError, TypeError) as error:
                raise ValueError(
                    f"Line {number + 1} of {str(self.path)!r} is damaged. Delete it, "
                    "and the members of its chunk are run again."
                ) from error
        return lines


def _written(lines: list[Line]) -> bytes:
    texts = [json.dumps(line, separators=(",", ":")) + "\n" for line in lines]
    return "".join(texts).encode()


def _whole_lines(path: Path, is_cut: bool = False) -> bytes:
    """Read the complete lines; `is_cut` removes a last line that was interrupted."""
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if is_cut and len(whole) < len(content):
        os.truncate(path, len(whole))
    return whole
