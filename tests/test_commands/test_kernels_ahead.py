"""What a first plan needs is compiled by another process, which nobody waits for in vain."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rumi.commands import kernels_ahead as ahead
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset, to_dict
from sdf import threads


@pytest.fixture(scope="module")
def agent(cache: Path) -> Any:
    return build(preset("fast", task="mug-0"), cache_dir=cache).agent


def started(monkeypatch: pytest.MonkeyPatch, code: str) -> list[Any]:
    """Processes that are started in place of the one that compiles."""
    made, popen = list[Any](), ahead.subprocess.Popen
    monkeypatch.setattr(ahead, "_kept", lambda agent: False)
    monkeypatch.setattr(threads, "cores", lambda: 2)

    def start(_: Any, **rest: Any) -> Any:
        made.append(popen([sys.executable, "-c", code], **rest))
        return made[-1]

    monkeypatch.setattr(ahead, "subprocess", SimpleNamespace(Popen=start, PIPE=-1, DEVNULL=-3))
    return made


def test_the_run_waits_for_it_after_the_first_view(agent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = started(monkeypatch, "import sys; sys.stdin.read(); sys.exit(3)")
    with ahead.kernels_ahead(agent, {"task": "mug-0"}) as wait:
        wait(None)
        assert made[0].returncode == 3  # that it failed is nobody's trouble


def test_that_it_ends_before_it_is_told_what_to_compile_harms_no_run(
    agent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(monkeypatch, "")
    with ahead.kernels_ahead(agent, {"task": "x" * 10**6}) as wait:  # more than a pipe holds
        wait(None)


def test_it_ends_with_the_run(agent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = started(monkeypatch, "import time; time.sleep(600)")
    with ahead.kernels_ahead(agent, {"task": "mug-0"}):
        assert made[0].poll() is None
    assert made[0].returncode not in (None, 0)


def test_none_is_started_where_there_is_nothing_to_compile(agent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = started(monkeypatch, "")
    with ahead.kernels_ahead(object(), {}) as wait:
        wait(None)
    monkeypatch.setattr(ahead, "_kept", lambda agent: True)
    with ahead.kernels_ahead(agent, {}) as wait:
        wait(None)
    monkeypatch.setattr(ahead, "_kept", lambda agent: False)
    monkeypatch.setattr(threads, "cores", lambda: 1)
    with ahead.kernels_ahead(agent, {}) as wait:
        wait(None)
    assert not made


def test_it_plans_with_a_belief_of_its_own() -> None:
    ahead.compile_for(to_dict(preset("fast", task="mug-0")))
