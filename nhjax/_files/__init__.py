"""States, solutions and checkpoints, written to files and read again."""

from ._files import (
    installed_version as installed_version,
    load as load,
    save as save,
)
