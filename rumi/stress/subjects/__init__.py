"""The sweeps by subject; importing a module enters its sweeps."""

from importlib import import_module

SUBJECTS = ("se3", "beliefs", "distances", "fields", "planning", "entropy", "likelihoods")


def load() -> None:
    """Enter the sweeps of all subjects."""
    for name in SUBJECTS:
        import_module(f"rumi.stress.subjects.{name}")
