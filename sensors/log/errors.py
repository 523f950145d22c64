"""Errors of a log."""


class LogError(ValueError):
    """A log cannot be read or written: the message says what came, what was expected and what to do."""
