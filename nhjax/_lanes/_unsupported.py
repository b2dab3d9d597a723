"""The exception of programs that are not compiled here, which says why."""


class Unsupported(Exception):
    """Raised for a program that has to run in another way; the message says why."""
