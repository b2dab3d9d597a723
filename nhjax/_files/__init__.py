"""States, solutions and checkpoints, written to files and read again."""

from ._files import load as load, save as save
