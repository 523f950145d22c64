"""The exit codes of `rumi` and of the scripts."""

DONE = 0
"""What was asked for was done; of a run: it succeeded by its own rule."""
NOT_CONVERGED = 1
"""It ran and did not succeed: a belief that did not become sure, a measurement beyond its bound."""
BAD_INPUT = 2
"""What was asked for cannot be: an unknown name, a value out of range, a file that is missing or damaged."""
INTERRUPTED = 130
"""Ended by Ctrl-C."""
