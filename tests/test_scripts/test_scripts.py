"""The scripts, as a newcomer would run them; the README shows the first."""

import importlib.util
import runpy
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import pytest
import torch

import rumi
from rumi import build, cli, exit_codes, preset, run
from rumi.errors import UsageError
from sdf import se3
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics

ROOT = Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.sim


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (UsageError("no such seeds"), exit_codes.BAD_INPUT, "rumi: no such seeds\n"),
        (KeyboardInterrupt(), exit_codes.INTERRUPTED, "rumi: interrupted\n"),
        (SystemExit("no data"), exit_codes.BAD_INPUT, "rumi: no data\n"),
        (SystemExit(1), 1, ""),
        (SystemExit(), exit_codes.DONE, ""),
        (None, exit_codes.DONE, ""),
    ],
)
def test_a_script_ends_as_the_command_does(error, code, message, capsys):
    def work():
        if error is not None:
            raise error
        return [1, 2]

    with pytest.raises(SystemExit) as end:
        cli.script(work)
    assert end.value.code == code
    assert capsys.readouterr().err == message


@pytest.fixture
def usual_handler():
    """Python's own handler of Ctrl-C, which is missing where a shell has the tests run in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield signal.default_int_handler
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ImportError("cannot load module more than once"), exit_codes.INTERRUPTED, "rumi: interrupted\n"),
        (RecursionError("too deep"), exit_codes.INTERRUPTED, "rumi: interrupted\n"),
        (ValueError("half of an array"), exit_codes.INTERRUPTED, "rumi: interrupted\n"),
        (OSError("no space left"), exit_codes.BAD_INPUT, "rumi: no space left\n"),
        (UsageError("no such seeds"), exit_codes.BAD_INPUT, "rumi: no such seeds\n"),
        (None, exit_codes.DONE, ""),
    ],
)
def test_an_error_that_ctrl_c_within_an_import_becomes_is_an_interrupt(error, code, message, capsys, usual_handler):
    def work():
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
            pytest.fail("Ctrl-C raised nothing")
        if error is not None:
            raise error

    with pytest.raises(SystemExit) as end:
        cli.script(work)
    assert end.value.code == code
    assert capsys.readouterr().err.startswith(message)
    assert signal.getsignal(signal.SIGINT) is usual_handler


def test_an_error_without_ctrl_c_is_no_interrupt():
    def work():
        raise RecursionError("too deep")

    with pytest.raises(RecursionError, match="too deep"):
        cli.script(work)


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda number, frame: None])
def test_a_handler_of_the_callers_own_stays(handler):
    before = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(SystemExit) as end:
            cli.script(lambda: signal.raise_signal(signal.SIGINT))
        assert end.value.code == exit_codes.DONE and signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_command_may_be_carried_out_in_another_thread():
    with ThreadPoolExecutor(1) as pool:
        end = pool.submit(cli.script, lambda: None).exception()
    assert isinstance(end, SystemExit) and end.code == exit_codes.DONE


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("fused_table", ["run", "--seeds", "x"], "rumi: Expected seeds such as 0-9"),
        ("gpvr_cap", ["--tasks", "nosuch"], "rumi: There is no task 'nosuch'"),
        ("predicted_realised", ["folder", "missing"], "rumi: There is no run folder missing"),
        ("touch_ablations", ["show", "--variants", "no nonsense"], "rumi: There is no variant 'no nonsense'"),
        ("first_view", ["--seeds", "0"], "rumi: Expected --seeds of 1 or more, got 0"),
    ],
)
def test_what_a_script_cannot_do_is_said_in_a_line(name, arguments, message, monkeypatch, capsys):
    path = ROOT / "scripts" / f"{name}.py"
    monkeypatch.syspath_prepend(str(path.parent))
    monkeypatch.setattr(sys, "argv", [str(path), *arguments])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(path), run_name="__main__")
    assert end.value.code == exit_codes.BAD_INPUT
    assert capsys.readouterr().err.startswith(message)


@pytest.mark.parametrize("path", sorted((ROOT / "scripts").glob("[a-z]*.py")))
def test_every_script_ends_so(path):
    code, main, ends = path.read_text().partition('if __name__ == "__main__":\n')
    without_rumi = "\nimport rumi" not in code and "\nfrom rumi" not in code  # for another process
    assert not main or "    script(" in ends or without_rumi


@pytest.mark.parametrize("path", sorted((ROOT / "scripts").rglob("*.py")), ids=str)
def test_no_script_keeps_a_run_that_ctrl_c_cut_off(path):
    """What `rumi.loop.run` gives may be cut off; `run_to_end` raises."""
    code = path.read_text()
    assert "loop.run(" not in code and "from rumi.loop import run\n" not in code


def test_the_lines_of_the_readme_run(monkeypatch, capsys):
    code = (ROOT / "README.md").read_text().split("```python\n")[1].split("```")[0]
    assert len(code.splitlines()) <= 8
    monkeypatch.setattr(rumi, "preset", lambda *names, **values: preset("fast", **values, steps=1))
    exec(code, {})
    assert any(line in ("steps", "sure") for line in capsys.readouterr().out.splitlines())


def sensed(surface_w, free_w, tool_xyyaw, touched, object_motion):
    """What a robot of one's own would make of its points, all seen at the one instant that is reported."""
    points = concatenate([Observation.of(surface_w, Semantics.SURFACE), Observation.of(free_w, Semantics.FREE)])
    return rumi.Reading(
        observation=points,
        instant=torch.zeros(len(points), dtype=torch.long),
        tool_pose=se3.from_planar(tool_xyyaw, 0.045)[None],
        in_contact=torch.tensor([touched]),
        object_motion=object_motion,
        configuration=tool_xyyaw,
        clipped=torch.zeros(()),
    )


class Robot:
    """Tells of the end of each action only, by bare readings, and does not know the truth."""

    def __init__(self, task):
        self.task = task

    def reset(self, seed):
        return self.report(self.task.reset(seed).reading)

    def step(self, control):
        return self.report(self.task.step(control).reading)

    def finish(self, action):
        return None

    def close(self):
        self.task.close()

    def report(self, reading):
        last = reading.instant == len(reading.tool_pose) - 1
        surface, free = (
            reading.observation.points[last & reading.observation.of_class(kind)]
            for kind in (Semantics.SURFACE, Semantics.FREE)
        )
        motion = reading.object_motion[-1:]
        return sensed(surface, free, reading.configuration, bool(reading.in_contact[-1]), motion)


def test_a_robot_may_bring_bare_readings(cache):
    task, rummager = build(preset("fast"), cache_dir=cache)
    result = run(Robot(task), rummager, seed=0, steps=2)
    assert (result.steps, result.right, result.position_error_mm) == (2, None, None)
    assert result.expected_nll > 0


@pytest.mark.slow
@pytest.mark.parametrize("task", ["mug-0", "mug-1", "mug-2"])  # of them the discrepancy's, of the shelf's trajectories
def test_the_first_belief_covers_what_the_view_leaves_open(task, tmp_path):
    script = load(ROOT / "scripts" / "first_view.py")
    figure = tmp_path / "view.png"
    (found,) = script.main(script.Options((task,), seeds=3, figure=figure))
    assert 40 < found.plausible_deg < 180
    assert found.gap_deg <= 15
    assert found.outside <= 0.01
    assert figure.stat().st_size > 1000


def test_predicted_against_realised(cache, monkeypatch):
    """Two short runs, and their tables."""
    from scripts import predicted_realised as module

    monkeypatch.setenv("RUMI_CACHE", str(cache))
    small = ("steps=2", "planner.mppi.samples=40", "initialise.starts=60", "initialise.polished=20")
    lines = [
        {"column": column, "task": "mug-0", "seed": 1000, "changes": [], "code": ""}
        | module.measure(column, "mug-0", 1000, small)
        for column in ("rumi/default", "slide/default")
    ]
    shown = module.show(lines, {})
    rows = [line.split(" | ") for line in shown.splitlines() if line.startswith("| mug rumi")]
    assert rows[0][1:3] == ["1", "2"]
    assert len(rows) == 1 + 4 + 7
    # sliding predicts nothing by itself, but can be asked about
    assert len([line for line in shown.splitlines() if line.startswith("| mug slide")]) == 4 + 7


@pytest.mark.slow
def test_the_cap_on_gpvrs_points(capsys, cache, monkeypatch):
    """The row of all points has no error, and a cap that allows them all is the same."""
    pytest.importorskip("gpytorch")
    monkeypatch.setenv("RUMI_CACHE", str(cache))
    module = load(ROOT / "scripts" / "gpvr_cap.py")
    module.main(module.Options(tasks=("mug-0",), actions=(0,), caps=(60, 5000)))
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[2:]]
    assert [row[0] for row in rows] == ["60", "5000", "none"]
    assert rows[1][1:7] == rows[2][1:7]
    assert float(rows[0][3]) > float(rows[2][3]) == 0.0
