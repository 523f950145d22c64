"""The study of deadlines in small: its problems, its lines, its tables and figures."""

from pathlib import Path

import pytest
import torch

from scripts.bench import deadline_simulation, deadlines
from scripts.bench.deadline_report import draw, tables, values_by_budget
from scripts.bench.deadline_simulation import BUDGETS_S, measure_simulated, simulated
from scripts.bench.touch_choice import Poke, TouchChoice
from scripts.store import Store

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "deadlines.py"


@pytest.fixture(autouse=True)
def few_problems(monkeypatch):
    monkeypatch.setattr(deadline_simulation, "_PROBLEMS", 3)
    monkeypatch.setattr(deadline_simulation, "_CANDIDATES", 50)


def test_exact_times_are_never_late_and_more_time_finds_more():
    found = simulated("exact", 0.9, 1)
    assert sum(found["late"].values()) == 0
    gains = [found["gain"][str(budget)] for budget in BUDGETS_S]
    # time that is doubled may find more than the next budget, but not on the whole
    assert gains[-1] == max(gains)
    assert gains[0] < sum(gains) / len(gains) < gains[-1]


@pytest.fixture
def choice() -> TouchChoice:
    return TouchChoice.drawn(1000, particles=60)


def test_pokes_meet_rectangles_where_they_enter_them(choice):
    for poke in (candidate.action for candidate in choice.of_particle(3)):
        share, normal, hit = choice._meets(poke)
        steps = torch.linspace(0, 1, 2001)
        path = poke.start + steps[:, None] * (poke.end - poke.start)
        for index in range(0, 60, 7):
            x, y, yaw = choice.states[index]
            cos, sin = yaw.cos(), yaw.sin()
            own = (path - torch.stack((x, y))) @ torch.tensor([[cos, -sin], [sin, cos]])
            inside = ((own[:, 0].abs() <= 0.1) & (own[:, 1].abs() <= 0.05)).nonzero()[:, 0]
            # one that begins inside does not enter
            if len(inside) > 1 and inside[0] > 0:
                assert bool(hit[index])
                assert float(steps[inside[0]]) == pytest.approx(float(share[index]), abs=1e-3)
                assert float(normal[index] @ (poke.end - poke.start)) < 0
            elif len(inside) == 0:
                assert not bool(hit[index])


def test_a_poke_that_misses_everything_tells_nothing(choice):
    away = Poke(torch.tensor([2.0, 2.0]), torch.tensor([2.0, 2.1]))
    assert choice.gain(away) == pytest.approx(0.0, abs=1e-6)
    gains = [choice.gain(candidate.action) for candidate in choice.of_particle(0)]
    assert min(gains) >= 0.0
    assert max(gains) > 0.3


@pytest.fixture
def small(tmp_path, monkeypatch) -> Store:
    monkeypatch.setattr(deadlines, "PIECE", 3)
    monkeypatch.setattr(deadlines, "REAL_BUDGETS_S", (0.05,))
    monkeypatch.setattr(deadlines, "TOUCH_BUDGETS_S", (0.05,))
    return Store(tmp_path / "deadlines.jsonl")


def test_a_study_in_small(small, tmp_path):
    assert list(deadlines.measure_real(small, clock="cpu", pieces=1, planners=("touch",))) == [True]
    again = Store(small.path)
    assert list(deadlines.measure_real(again, clock="cpu", pieces=1, planners=("touch",))) == [False]
    list(measure_simulated(small, decisions=30))
    list(deadlines.measure_value(small, seeds=range(1000, 1001), planners=("touch",)))
    text = tables(small)
    assert "| exact |  | 30 | 0 (0.00 %) | none | 0.00 |" in text
    assert f"| cpu | {torch.get_num_threads()} | touch | touch | 50 ms | 3 |" in text
    values = values_by_budget(small)[("touch", "touch")]
    assert list(values) == [0.05]
    assert len(values[0.05]) == 20
    paths = draw(small, tmp_path, clock="cpu")
    assert [path.name for path in paths] == ["deadlines.png", "deadline_histogram.png"]
    assert all(path.stat().st_size > 5000 for path in paths)


@pytest.mark.slow
def test_planners_on_the_situations_of_a_run(small):
    planners = ("slide", "rumi")
    assert all(deadlines.measure_real(small, clock="cpu", pieces=1, planners=planners))
    assert all(deadlines.measure_value(small, seeds=range(1000, 1001), planners=planners))
    lines = small.of("real")
    assert [(line["planner"], len(line["took_s"])) for line in lines] == [("slide", 3), ("rumi", 3)]
    values = values_by_budget(small)[("mug-1", "rumi")]
    assert list(values) == [0.05, None]
    assert len(values[None]) == len(values[0.05]) > 0
