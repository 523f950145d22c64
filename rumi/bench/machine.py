"""On what something was timed."""

import os
import time
from typing import Any

import torch

from rumi.bench.timing import fitting_clock
from rumi.runs.provenance import provenance, version_of
from sdf.threads import cores

PACKAGES = ("numba", "pytorch-volumetric", "chsel", "pytorch-mppi", "open3d", "ribs")
BUSY = 0.5
"""Processes that others keep running above which times are not to be trusted."""


def environment(device: torch.device) -> dict[str, Any]:
    """Processor, what its kernels are chosen by, cores, load, device, versions, threads and commit, ready for JSON."""
    made_with = provenance()
    own = dict(made_with["processor"])
    versions = {name: version for name, version in made_with["versions"].items() if version is not None}
    versions |= {name: found for name in PACKAGES if (found := version_of(name)) is not None}
    return {
        "processor": own.pop("model"),
        "kernels": own,
        "cores": cores(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "system": made_with["system"],
        "python": made_with["python"],
        "versions": versions,
        "threads": made_with["threads"],
        "clock": "processor"
        if device.type == "cpu" and fitting_clock(made_with["threads"]) is time.process_time
        else "wall",
        "commit": made_with["commit"],
    }
