"""What a first action needs is compiled by other processes, which nobody waits for in vain."""

import os
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rumi import loop
from rumi.commands import kernels_ahead as ahead
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset, to_dict
from sdf import compiled, threads

ABOUT = {"task": "mug-0"}
FIRST, SECOND = SimpleNamespace(step=0), SimpleNamespace(step=1)


@pytest.fixture(scope="module")
def parts(cache: Path) -> Any:
    return build(preset("fast", task="mug-0"), cache_dir=cache)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The processes, in the order in which they are started, where there is something to compile."""
    made, start = list[Any](), ahead._started
    monkeypatch.setattr(ahead, "_kept", lambda agent: False)
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def noted(*arguments: Any) -> Any:
        made.append(start(*arguments))
        return made[-1]

    monkeypatch.setattr(ahead, "_started", noted)
    return made


def fail(*_: Any) -> None:
    print("on a stream that nobody sees")
    sys.exit(3)


def sleep(*_: Any) -> None:
    time.sleep(600)


@pytest.mark.skipif(not ahead.COPIES, reason="processes are copied on Linux alone")
def test_the_run_waits_for_copies_after_the_first_view_alone(
    parts: Any, started: list[Any], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ahead, "judge_and_plan", fail)
    monkeypatch.setattr(ahead, "take_in", fail)
    with ahead.kernels_ahead(parts.task, parts.agent, ABOUT) as wait:
        wait(SECOND)
        assert len(started) == 1
        wait(FIRST)
        assert [one.exitcode for one in started] == [3, 3]  # that they failed is nobody's trouble
    assert capfd.readouterr().out == ""


def test_where_there_are_no_copies_one_process_builds_the_run(
    parts: Any, started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "COPIES", False)
    with ahead.kernels_ahead(parts.task, parts.agent, {"task": "none such"}) as wait:
        wait(FIRST)
    assert [one.exitcode for one in started] == [1]


@pytest.mark.skipif(not ahead.COPIES, reason="processes are copied on Linux alone")
def test_they_end_with_the_run(parts: Any, started: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "judge_and_plan", sleep)
    with ahead.kernels_ahead(parts.task, parts.agent, ABOUT):
        assert started[0].is_alive()
    assert started[0].exitcode not in (None, 0)


def test_none_is_started_where_there_is_nothing_to_compile(
    parts: Any, started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with ahead.kernels_ahead(parts.task, object(), {}) as wait:
        wait(FIRST)
    monkeypatch.setattr(ahead, "_kept", lambda agent: True)
    with ahead.kernels_ahead(parts.task, parts.agent, {}) as wait:
        wait(FIRST)
    monkeypatch.setattr(ahead, "_kept", lambda agent: False)
    monkeypatch.setattr(threads, "cores", lambda: 1)
    with ahead.kernels_ahead(parts.task, parts.agent, {}) as wait:
        wait(FIRST)
    assert not started


def test_a_copy_works_in_one_thread_and_leaves_the_run_as_it_was(
    parts: Any, started: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def note(*_: Any) -> None:
        (tmp_path / "found").write_text(f"{os.getppid()} {threads.count()} {torch.get_num_threads()}")

    monkeypatch.setattr(ahead, "judge_and_plan", note)
    if not ahead.COPIES:
        pytest.skip("processes are copied on Linux alone")
    with threads.using(2), ahead.kernels_ahead(parts.task, parts.agent, ABOUT):
        started[0].join()
        assert threads.count() == 2
    assert (tmp_path / "found").read_text() == f"{os.getpid()} 1 1"


def test_they_call_all_kernels_that_a_first_action_calls(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called, call = set[str](), compiled.Kernel.__call__

    def noted(kernel: Any, *arguments: Any) -> None:
        called.add(kernel._label)
        call(kernel, *arguments)

    monkeypatch.setattr(compiled.Kernel, "__call__", noted)
    settings = preset("fast", task="mug-0")
    ahead.build_and_plan(to_dict(settings))
    with build(settings, cache_dir=cache) as parts, build(settings, cache_dir=cache) as copy:
        copy.task.reset(0)
        by_helpers = set[str]()

        def on_step(record: Any) -> None:
            if record.step == 0:
                ahead.take_in(copy.task, copy.agent, record)
                by_helpers.update(called)
                called.clear()

        loop.run(*parts, seed=0, steps=1, on_step=on_step)
    assert called
    assert called <= by_helpers
