"""The exit codes of `rumi` and of the scripts: one rule for all tasks."""

DONE = 0
"""The command did what was asked for. A run succeeded by its own rule: the belief became sure, and where the task ends
with a last action (a grasp, a peg put into a hole) that succeeded too."""
NOT_CONVERGED = 1
"""It ran and did not succeed: a belief did not become sure, an object was not lifted, a value is beyond its bound."""
BAD_INPUT = 2
"""What was asked for cannot be: an unknown name, a value out of range, a file that is missing or damaged."""
INTERRUPTED = 130
"""Ended by Ctrl-C."""
