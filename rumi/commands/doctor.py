"""The command `rumi doctor`: what is installed, how the machine is used, and whether it works, with what to do."""

import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from rumi.exit_codes import DONE, NOT_CONVERGED

_ENOUGH = 1e-5  # metres that versions of an operation, and a table of a sphere, may differ by
_LOADED = 0.5  # of the cores that others use, from which on times are longer
_LARGE = 5e9  # bytes of a cache that are worth a word


_USES = {
    "sim": "tasks in simulation",
    "robot": "arms by their URDF or MJCF",
    "mesh": "objects by their meshes",
    "plot": "figures",
    "vision": "depth images and bubbles",
    "logs": "logs and ROS bags",
    "serve": "robots in other processes, rumi serve",
    "view": "the viewer, rumi view",
    "baselines": "the method gpvr",
    "cluster": "experiments on a SLURM cluster",
    "gym": "environments of gymnasium",
    "gpu": "plans on a GPU, --device cuda",
    "peers": "comparisons with other packages",
    "stress": "rumi stress",
}


@dataclass(frozen=True)
class DoctorOptions:
    """Look rumi's installation over: versions, extras, threads, caches, devices, and a self-test of a few seconds.

    Attributes:
        json: print JSON.
    """

    json: bool = False


class Finding(NamedTuple):
    """What one look found.

    Attributes:
        name: of what was looked at.
        state: "ok", "note" for what may be wanted, "wrong" for what does not work.
        told: what there is.
        remedy: what to do; empty where nothing is.
    """

    name: str
    state: str
    told: str
    remedy: str = ""


def doctor(arguments: Sequence[str]) -> int:
    """`rumi doctor`: 0 where all that is installed works, 1 where something does not."""
    options = tyro.cli(DoctorOptions, prog="rumi doctor", args=arguments)
    found = [finding for look in LOOKS for finding in _looked(look)]
    wrong = any(finding.state == "wrong" for finding in found)
    if options.json:
        told = {"ok": not wrong, "findings": [finding._asdict() for finding in found]}
        sys.stdout.write(json.dumps(told) + "\n")
    else:
        for finding in found:
            sys.stdout.write(f"{finding.state:<6}{finding.name:<12}{finding.told}\n")
            if finding.remedy:
                sys.stdout.write(f"{'':18}-> {finding.remedy}\n")
        bad = ", ".join(finding.name for finding in found if finding.state == "wrong")
        sys.stdout.write(f"{bad}: does not work, see above\n" if wrong else "All that is installed works.\n")
    return NOT_CONVERGED if wrong else DONE


def _looked(look: Callable[[], Iterator[Finding]]) -> list[Finding]:
    """What a look found; that it broke off is a finding too."""
    found = []
    try:
        for finding in look():
            found.append(finding)
    except Exception as error:  # whatever is broken here is what was asked for
        told = f"broke off: {type(error).__name__}: {error}"
        found.append(
            Finding(
                look.__name__.strip("_").replace("_", "-"), "wrong", told, "install rumi again, or report this line"
            )
        )
    return found


def _versions() -> Iterator[Finding]:
    """Versions, the place that the packages are imported from, and the machine."""
    from rumi import __version__
    from rumi.runs.provenance import provenance

    made = provenance()
    versions = {name: version for name, version in made["versions"].items() if version and name != "rumi"}
    told = ", ".join(f"{name} {version}" for name, version in versions.items())
    commit = f" ({made['commit'][:12]})" if made["commit"] else ""
    yield Finding("rumi", "ok", f"{__version__}{commit}, Python {made['python']}, {told}")
    yield Finding("machine", "ok", f"{made['system']}, {made['processor']['model']}, {made['processor']['torch']}")
    root = Path(__file__).resolve().parents[2]
    for name in ("sdf", "sensors", "kmppi"):
        spec = find_spec(name)
        if spec is None or spec.origin is None or Path(spec.origin).resolve().parents[1] != root:
            told = f"is imported from {None if spec is None else spec.origin}, not from {root}"
            remedy = f"another project brings a package {name}: uninstall it, or give rumi an environment of its own"
            yield Finding(name, "wrong", told, remedy)


def _extras() -> Iterator[Finding]:
    """Each extra: which of its packages are there."""
    from sdf.extras import EXTRAS, remedy

    for extra, packages in EXTRAS.items():
        lacking = [name for name in packages.split() if find_spec(name) is None]
        if not lacking:
            yield Finding(f"[{extra}]", "ok", f"{_USES[extra]}: installed")
        else:
            told = f"{_USES[extra]}: not installed ({', '.join(lacking)})"
            yield Finding(f"[{extra}]", "note", told, f"only if you want that: {remedy(extra)}")


def _threads() -> Iterator[Finding]:
    """Cores, what others use of them, and the threads that commands take."""
    from sdf import threads

    cores, running = threads.cores(), threads.running()
    told = f"{cores} cores, others run {running:g} processes; commands use {threads.count()} threads"
    if running > _LOADED * cores:
        yield Finding("threads", "note", told, "the machine is busy: times are longer, and budgets buy less")
    else:
        yield Finding("threads", "ok", told)


def _caches() -> Iterator[Finding]:
    """Folder of the cache: whether it can be written, and how large it is."""
    from rumi.cache import cache_folder
    from rumi.errors import UsageError
    from rumi.runs.folder import make_folder

    folder = cache_folder()
    try:
        make_folder(folder)
    except UsageError as error:
        yield Finding("cache", "wrong", str(error), "set RUMI_CACHE to a folder that can be written")
        return
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    told = f"{folder}, {size / 1e6:.0f} MB"
    if size > _LARGE:
        yield Finding("cache", "note", told, "it can be removed: what is needed is worked out again")
    else:
        yield Finding("cache", "ok", told)


def _devices() -> Iterator[Finding]:
    """CUDA devices that this PyTorch can use."""
    import torch

    if torch.cuda.is_available():
        names = ", ".join(torch.cuda.get_device_name(at) for at in range(torch.cuda.device_count()))
        yield Finding("devices", "ok", f"CPU, {names} (--device cuda, with the extra gpu)")
    else:
        yield Finding("devices", "ok", "CPU; no CUDA device that this PyTorch can use, and none is needed")


def _self_test() -> Iterator[Finding]:
    """A table of a sphere, plain and compiled; a plan's worth of look-ups; a file that is written and read."""
    import torch

    from rumi.runs.folder import write_json
    from sdf import backend, compiled, se3
    from sdf.grid_sdf import GridSDF
    from sdf.posed import posed_distance
    from sdf.primitives import Sphere

    sphere = Sphere(0.05)
    table = GridSDF.from_sdf(sphere, 0.004)
    random = torch.Generator().manual_seed(0)
    points = 0.2 * torch.rand(2000, 3, generator=random) - 0.1
    poses = se3.from_planar(0.02 * torch.randn(50, 3, generator=random))

    def timed(version: str) -> tuple[Any, float]:
        with backend.force(version), torch.no_grad():
            posed_distance(table, poses, points)  # compiles, or loads what was compiled
            begun = time.perf_counter()
            return posed_distance(table, poses, points), time.perf_counter() - begun

    begun = time.perf_counter()
    plain, plain_s = timed("torch")
    centres = se3.apply(se3.inverse(poses), points.expand(len(poses), -1, -1))
    near = (centres.norm(dim=-1) - 0.05).abs() < 0.02
    off = float((plain - (centres.norm(dim=-1) - 0.05))[near].abs().max())
    good = off < 100 * _ENOUGH
    yield Finding("distances", "ok" if good else "wrong", f"100 000 in {1e3 * plain_s:.1f} ms by PyTorch alone",
                  "" if good else f"a table of a sphere is {1e3 * off:.2f} mm off: install PyTorch again")  # fmt: skip
    if compiled.available():
        fast, fast_s = timed("numba")
        same = float((fast - plain).abs().max()) < _ENOUGH
        yield Finding("compiled", "ok" if same else "wrong", f"100 000 in {1e3 * fast_s:.1f} ms by numba",
                      "" if same else "it does not agree with PyTorch: RUMI_BACKEND=torch leaves it out")  # fmt: skip
    else:
        yield Finding("compiled", "wrong", "numba is not there: everything takes several times as long",
                      "pip install numba")  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "written.json"
        write_json(path, {"whole": True})
        if json.loads(path.read_text()) != {"whole": True}:
            yield Finding("files", "wrong", f"what was written to {folder} reads otherwise", "use another disk")
    yield Finding("self-test", "ok", f"took {time.perf_counter() - begun:.1f} s")


LOOKS: tuple[Callable[[], Iterator[Finding]], ...] = (_versions, _extras, _threads, _caches, _devices, _self_test)
"""What is looked at, in this order."""
