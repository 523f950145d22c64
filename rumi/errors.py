"""The errors that are rumi's own."""


class UsageError(ValueError):
    """What was asked for cannot be: the message says what came, what was expected and what to do.

    The command line shows the message alone and ends with exit code 2.
    """


class DegenerateBeliefError(RuntimeError):
    """No particle has any weight left, so that the belief says nothing."""
