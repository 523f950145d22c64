"""The sweeps by subject; importing a module enters its sweeps."""

from importlib import import_module

import torch

SUBJECTS = (
    "se3",
    "beliefs",
    "distances",
    "fields",
    "planning",
    "entropy",
    "likelihoods",
    "touching",
    "pushes",
    "trajectories",
)


def load() -> None:
    """Enter the sweeps of all subjects; where there is a CUDA device, those that can be on it too."""
    for name in SUBJECTS:
        import_module(f"tests.stress.subjects.{name}")
    if torch.cuda.is_available():
        from tests.stress.on_device import on_device, sweeps_there
        from tests.stress.sweep import SWEEPS

        made = [on_device(sweep, torch.device("cuda")) for sweep in sweeps_there() if not sweep.name.endswith("-cuda")]
        SWEEPS.update({sweep.name: sweep for sweep in made})
