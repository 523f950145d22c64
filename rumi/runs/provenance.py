"""Provenance: what a run is made with, by which its result may differ in the last digits."""

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from sdf.processor import processor


def provenance() -> dict[str, Any]:
    """Processor, versions, threads and the commit that a run is made with; the same for the same installation."""
    versions = {name: version_of(name) for name in ("rumi", "torch", "numpy", "mujoco-core", "pytorch-kinematics")}
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": processor()._asdict(),
        "versions": versions | {"torch": torch.__version__},
        "threads": torch.get_num_threads(),
        "commit": _commit(Path(__file__).resolve().parents[2]),
    }


def version_of(name: str) -> str | None:
    """The version of an installed package; None where it is not."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _commit(root: Path) -> str | None:
    """Commit of a checkout, with `-dirty` where files differ from it; None outside a checkout."""
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=5, env={**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None
