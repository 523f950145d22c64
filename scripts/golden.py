"""Digests of short runs of every task: whether a change leaves all beliefs as they were, to the bit.

    python scripts/golden.py check                   # all, minutes; names the first step of each that differs
    python scripts/golden.py check mug-0 peg         # some
    python scripts/golden.py record                  # before a change, on a processor that is not on record

Ends with 0 where all are equal, 1 where something differs, 2 where there is no such run or no record for this processor
and these versions, of which the last bits depend. All is done by one thread, which some of them depend on too.
"""

import hashlib
import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any
from unittest import mock

import torch
import tyro
from llvmlite import binding
from torch import Tensor

from rumi import loop
from rumi.cli import script
from rumi.errors import UsageError
from rumi.records import RunResult, StepRecord
from rumi.registration.contact_terms import LocalizeSettings
from rumi.registration.from_contacts import localize
from rumi.runs.folder import RunRecorder
from rumi.runs.recorded import RunLog
from rumi.runs.replay import replay
from rumi.seeding import generator
from rumi.sim.conditions import image_errors
from rumi.tasks.handle.build import build_handle
from rumi.tasks.handle.settings import SENSORS, HandleSettings, SensorName
from rumi.tasks.peg import agent as peg_agent
from rumi.tasks.peg.agent import build_peg
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset, to_dict
from rumi.tasks.touch_box.build import Robot, build_touch_box
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import TouchSettings
from sdf import processor as kernels
from sdf.mesh.mesh import TriangleMesh

DIGESTS = Path(__file__).resolve().parent.parent / "tests" / "golden" / "digests.json"
_DIGITS = 16  # of a SHA-256
_WORDS = ("pose", "why_not", "wrong_by", "lost")  # of a result, also where there are none

Record = dict[str, Any]
"""`steps`, a pair of digests each, of the action and of the belief after it; `result`, numbers by name."""


@dataclass
class Trace:
    """What a run leaves: the digests of its steps.

    Attributes:
        folder: for what the run writes or works out.
        steps: digests of each action and of the belief after it; no action at first.
    """

    folder: Path
    steps: list[list[str | None]] = field(default_factory=list)

    def add(self, belief: Iterable[Tensor], action: Tensor | None) -> None:
        """Take in a step."""
        self.steps.append([None if action is None else digest([action]), digest(belief)])

    def __call__(self, step: StepRecord) -> None:
        """Take in a step of a run that finds an object's pose."""
        belief = step.belief
        self.add((belief.world_T_attached, belief.attached_T_object, belief.log_weights), step.control)


def digest(tensors: Iterable[Tensor]) -> str:
    """First digits of the SHA-256 of tensors' dtypes and bytes: the same only for the same bits."""
    total = hashlib.sha256()
    for values in tensors:
        array = values.detach().cpu().contiguous().numpy()
        total.update(f"{array.dtype.str}{array.nbytes}".encode())
        total.update(array.tobytes())
    return total.hexdigest()[:_DIGITS]


# ---- the runs, each by its own task's entry point


def of_result(result: RunResult) -> Record:
    """The numbers of a result."""
    numbers = {name: value for name, value in result.as_dict().items() if name not in _WORDS}
    return {name: value for name, value in numbers.items() if value is None or isinstance(value, int | float)}


def of_rummaging(trace: Trace, settings: Settings, steps: int) -> Record:
    """A task with a gripper that moves about an object."""
    with build(settings, cache_dir=trace.folder) as parts:
        return of_result(loop.run_to_end(*parts, seed=settings.seed, steps=steps, on_step=trace))


def of_replay(trace: Trace, settings: Settings, steps: int) -> Record:
    """A run's folder, replayed; the live run's beliefs have to be the same."""
    live, path = Trace(trace.folder), trace.folder / "run"
    with build(settings, cache_dir=trace.folder) as parts, RunRecorder(path, to_dict(settings)) as log:

        def on_step(step: StepRecord) -> None:
            log(step)
            live(step)

        log.finish(loop.run_to_end(*parts, seed=settings.seed, steps=steps, on_step=on_step))
    entry, opened = TASKS[settings.task], RunLog(path)
    again = entry.from_dict(opened.settings)
    agent = entry.agent(again, cache_dir=trace.folder)
    done = replay(opened.taken(), agent, seed=again.seed, on_step=trace)
    same = difference({"steps": live.steps}, {"steps": trace.steps}) is None and all(done.same)
    return of_result(done.result) | {"same": same}


def of_touching(trace: Trace, robot: Robot, method: str, actions: int) -> Record:
    """A box that is found by touch alone."""
    settings = replace(TouchSettings(method=method), actions=actions)
    with build_touch_box(TouchTask(), settings, robot, cache_dir=trace.folder) as parts:
        run = loop.run_to_end(*parts, seed=0)
    for step in run.records:
        trace.add(step.belief, None if step.touched is None else step.touched.path)
    grasp = run.end.grasp
    found = {"grasp": grasp.pose.tolist(), "probability": grasp.probability, "lifted": run.lifted}
    return found | {"truth": run.end.truth.tolist()}


def of_peg(trace: Trace, settings: PegSettings) -> Record:
    """A peg that is put into a block which was found by touch."""
    beliefs = []

    def aim_of(belief: Any, settings: PegSettings) -> Any:  # noqa: ANN401  (passed on)
        beliefs.append((belief.states, belief.log_weights))  # before another draw of it confirms that it is sure
        return real(belief, settings)

    real = peg_agent.aim_of
    with mock.patch.object(peg_agent, "aim_of", aim_of):
        run = loop.run_to_end(*build_peg(settings), seed=0)
    paths = [torch.cat([one.path for one in run.searched]), *(one.path for one in run.felt)]
    for belief, path in zip(beliefs, paths, strict=True):
        trace.add(belief, path)
    told = run.as_dict()
    names = ("in_hole", "off_mm", "hole_error_mm", "middle_error_mm", "probability", "actions", "touches", "total_s")
    assert run.inserted is not None
    return {name: told[name] for name in names} | {"inserted_at": run.inserted.at.tolist()}


def of_fused(trace: Trace, sensors: tuple[SensorName, ...], steps: int) -> Record:
    """A mug that is found by several sensors, and lifted."""
    settings = HandleSettings(sensors=sensors, steps=steps)
    with build_handle(settings, cache_dir=trace.folder) as parts:
        found = loop.run_to_end(*parts, seed=0, on_step=trace)
    grasp = {} if found.grasp is None else {"grasp": list(found.grasp)}
    names = {field.name for field in fields(RunResult)}
    own = {name: value for name, value in of_result(found).items() if name in names}
    return own | grasp | {"lifted": found.lifted, "total_s": found.total_s}


def of_localizing(trace: Trace) -> Record:
    """A mesh, found from points on it."""
    corners = torch.tensor([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.02, 0.1, 0.0], [0.03, 0.02, 0.07]]).double()
    mesh = TriangleMesh(corners, torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    draws = generator(0)
    weights = torch.rand(30, 3, generator=draws, dtype=torch.float64)
    faces = torch.randint(len(mesh.faces), (30,), generator=draws)
    points = (mesh.vertices[mesh.faces[faces]] * (weights / weights.sum(-1, keepdim=True))[..., None]).sum(1)
    points = points + 0.001 * torch.randn(30, 3, generator=draws, dtype=torch.float64)
    found = localize(mesh, points, settings=LocalizeSettings(starts=200), generator=generator(1))
    trace.add((found.world_T_object, found.weights), None)
    return {"modes": len(found), "noise_m": found.noise_m, "distance_m": found.distance_m.tolist()}


def rummaging(steps: int, task: str = "mug-0", start: str = "default", **changes: Any) -> Callable[[Trace], Record]:  # noqa: ANN401
    """A run of a task with some settings changed."""
    return lambda trace: of_rummaging(trace, preset(start, task=task, **changes), steps)


def moved(motion: Any) -> Callable[[Trace], Record]:  # noqa: ANN401  (a name of the settings)
    """A run in which the object's motion is known in some way."""
    return rummaging(8, seed=3, filter=replace(preset().filter, motion=motion))


# seeds by which the gripper touches early, and the first belief is changed by more than free space
RUNS: dict[str, Callable[[Trace], Record]] = {
    "mug-0": rummaging(8, seed=3),
    "mug-0-fast": rummaging(10, start="fast", seed=1),
    "mug-0-info-only": rummaging(9, method="info-only", seed=2),
    "mug-0-slide": rummaging(6, method="slide"),
    "mug-0-gpvr": rummaging(3, method="gpvr"),
    "mug-0-degraded": rummaging(7, seed=3, simulator=replace(preset().simulator, sensors=image_errors("both"))),
    "mug-0-corrected": moved("corrected"),
    "mug-0-pushed": moved("pushed"),
    "mug-0-estimated": moved("estimated"),
    "box-0": rummaging(7, "box-0", seed=2),
    "drill-0": rummaging(6, "drill-0", seed=2),
    "shelf-mug": rummaging(6, "shelf-mug", seed=1),
    "shelf-box": rummaging(8, "shelf-box", seed=1),
    "mug-lab": rummaging(9, "mug", seed=1060, conditions="lab"),
    "drill-lab": rummaging(5, "drill", seed=1012, conditions="lab"),
    "box-lab": rummaging(7, "box", seed=1010, conditions="lab"),
    "touch-planar-sequence": lambda trace: of_touching(trace, "planar", "sequence", 4),
    "touch-planar-entropy": lambda trace: of_touching(trace, "planar", "entropy", 3),
    "touch-gripper-sequence": lambda trace: of_touching(trace, "gripper", "sequence", 4),
    "touch-gripper-entropy": lambda trace: of_touching(trace, "gripper", "entropy", 3),
    "peg": lambda trace: of_peg(trace, PegSettings()),
    "peg-20s": lambda trace: of_peg(trace, PegSettings(action_budget_s=20.0)),
    "peg-entropy": lambda trace: of_peg(trace, PegSettings(stop="entropy")),
    "fused": lambda trace: of_fused(trace, SENSORS, 4),
    "fused-wrench": lambda trace: of_fused(trace, ("wrench",), 4),
    "localize": of_localizing,
    "replay": lambda trace: of_replay(trace, preset("fast", task="mug-0", seed=1), 8),
}


# ---- what they are compared with


def processor() -> str:
    """All that the last bits depend on beside the code: instructions that are used, and versions."""
    own = kernels.processor()
    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "numba", "mujoco-core"))
    return f"{own.torch}, numba for {own.numba} {own.features}, on {binding.get_host_cpu_name()}, {packages}"


def difference(recorded: Record, found: Record) -> str | None:
    """Where a run first differs from its record, in words; None where it does not."""
    was, now = recorded["steps"], found["steps"]
    for step, (old, new) in enumerate(zip(was, now, strict=False)):
        for what, one, other in zip(("action", "belief"), old, new, strict=True):
            if one != other:
                return f"the {what} of step {step}"
    if len(was) != len(now):
        return f"the number of steps: {len(was)} on record, {len(now)} now"
    old, new = recorded.get("result", {}), found.get("result", {})
    for name in (*old, *(name for name in new if name not in old)):
        if old.get(name) != new.get(name) or (name in old) != (name in new):
            return f"the result's {name}: {old.get(name)} on record, {new.get(name)} now"
    return None


def carried_out(name: str, folder: Path) -> Record:
    """A run's record."""
    trace = Trace(folder)
    result = RUNS[name](trace)
    found: Record = json.loads(json.dumps({"steps": trace.steps, "result": result}, allow_nan=False))
    return found


@dataclass(frozen=True)
class Check:
    """Carry out runs and compare them with their records.

    Attributes:
        names: of the runs; all of them without any.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()


@dataclass(frozen=True)
class Renew:
    """Carry out runs and put them on record for this processor.

    Attributes:
        names: of the runs; all of them without any.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()


def main(options: Check | Renew) -> int:
    """Carry out the runs, and compare them or write them down; the exit code."""
    names, here = options.names or tuple(RUNS), processor()
    for name in names:
        if name not in RUNS:
            raise UsageError(f"There is no golden run {name!r}; there are {', '.join(RUNS)}")
    own = on_record().get(here, {})
    if isinstance(options, Check) and (lacking := [name for name in names if name not in own]):
        of = here if not own else f"{', '.join(lacking)} with {here}"
        raise UsageError(f"There are no digests of {of}: first record them from a commit that is trusted")
    torch.set_num_threads(1)
    print(here, flush=True)
    different, failed, begun = 0, 0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            start = time.perf_counter()
            try:
                found = carried_out(name, Path(folder))
                where = difference(own[name], found) if name in own else None
                told = "new" if name not in own else "equal" if where is None else f"DIFFERS in {where}"
                own[name] = found
            except Exception:
                traceback.print_exc()
                where, told, failed = "all", "FAILED", failed + 1
            different += where is not None
            print(f"{name:<24} {time.perf_counter() - start:6.1f} s  {told}", flush=True)
    print(f"{different} of {len(names)} runs differ or failed, in {time.perf_counter() - begun:.0f} s")
    if isinstance(options, Check):
        return 1 if different else 0
    write({**on_record(), here: own})
    return 1 if failed else 0


def on_record() -> dict[str, dict[str, Record]]:
    """The digests on record, by processor and run."""
    known: dict[str, dict[str, Record]] = json.loads(DIGESTS.read_text()) if DIGESTS.exists() else {}
    return known


def write(known: dict[str, dict[str, Record]]) -> None:
    """Write the digests, a run a line."""
    parts = []
    for key in sorted(known):
        runs = ",\n".join(f"  {json.dumps(name)}: {json.dumps(known[key][name])}" for name in sorted(known[key]))
        parts.append(f"{json.dumps(key)}: {{\n{runs}\n}}")
    aside = DIGESTS.with_suffix(".part")
    aside.write_text("{\n" + ",\n".join(parts) + "\n}\n")
    aside.replace(DIGESTS)


def command() -> None:
    """Check or record."""
    asked = tyro.cli(
        Annotated[Check, tyro.conf.subcommand("check")] | Annotated[Renew, tyro.conf.subcommand("record")],
        description=__doc__,
    )
    sys.exit(main(asked))


if __name__ == "__main__":
    if os.environ.get("OMP_NUM_THREADS") != "1":  # read as libraries are loaded
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, "OMP_NUM_THREADS": "1"})
    script(command)
