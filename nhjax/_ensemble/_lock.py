"""Locks of files, which end with the process that holds them."""

import errno
import os
import warnings
from pathlib import Path


# What systems answer that have no locks on a file system.
_NONE = errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS


class Lock:
    """A lock on a file. Where a file system has none, a warning says so."""

    def __init__(self):
        self._opened: int | None = None

    def take(self, path: Path, what: str) -> None:
        """Lock a file, which is made if it is not there.

        **Raises:** `RuntimeError` if another process has locked it, or if the system
        has no locks; `what` says of which folder it is.
        """
        self._opened = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            import fcntl

            fcntl.flock(self._opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError as error:
            self.release()
            raise RuntimeError(
                f"{what} cannot be locked, so that two processes might write it at "
                "once: this system has no module `fcntl`. Leave out `out=`, or run "
                "where there is one, such as on Linux or macOS."
            ) from error
        except BlockingIOError as error:
            self.release()
            raise RuntimeError(
                f"{what} is being written by another process."
            ) from error
        except OSError as error:
            if error.errno not in _NONE:
                self.release()
                raise
            warnings.warn(
                f"{what} lies on a file system without locks: let no other process "
                "write it.",
                stacklevel=2,
            )

    def write(self, text: bytes) -> None:
        """Let a text be the content of the locked file, on the disk."""
        assert self._opened is not None
        if not text and not os.fstat(self._opened).st_size:
            return
        os.ftruncate(self._opened, 0)
        os.lseek(self._opened, 0, os.SEEK_SET)
        os.write(self._opened, text)
        os.fsync(self._opened)

    def release(self) -> None:
        """Let others lock the file; nothing is done if it is not locked."""
        if self._opened is not None:
            os.close(self._opened)
            self._opened = None
