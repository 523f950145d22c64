"""What a piece of work is kept under, and what its settings are."""

import pytest

from rumi.errors import UsageError
from rumi.tasks.rummage.settings import preset, to_dict
from scripts.reproduce.command import part
from scripts.reproduce.experiments import EXPERIMENTS, HORIZON_BEFORE, HORIZONS, PARTICLES_BEFORE, Selection, work_of
from scripts.reproduce.jobs import Job, overridden


def job(**changes):
    return Job(**{"kind": "run", "task": "mug-0", "method": "rumi", "preset": "default", "seed": 3} | changes)


def test_settings_are_the_presets_with_what_is_overridden():
    settings = job(overrides=("planner.rollouts=3", "stop.rule=never", "steps=4")).settings
    assert (settings.task, settings.method, settings.seed) == ("mug-0", "rumi", 3)
    assert (settings.planner.rollouts, settings.stop.rule, settings.steps) == (3, "never", 4)
    dashed, spelled = (job(overrides=(f"planner.reachability{sign}scale=1.5",)) for sign in "-_")
    assert dashed.settings.planner.reachability_scale == 1.5
    assert dashed.id == spelled.id
    assert job(preset="paper").settings == preset("paper", task="mug-0", seed=3)


@pytest.mark.parametrize(
    "override", ["planner.rolouts=3", "planner=3", "planner.rollouts", "planner.rollouts.x=1", "nothing=1", "=2"]
)
def test_what_is_no_setting_is_refused(override):
    with pytest.raises(UsageError, match="Expected a setting and its value"):
        overridden(to_dict(preset()), (override,))


def test_a_value_of_the_wrong_kind_is_refused():
    with pytest.raises(UsageError, match=r"planner\.rollouts"):
        _ = job(overrides=("planner.rollouts=many",)).id


def test_the_name_is_of_all_that_decides_the_result():
    base = job()
    others = [
        job(task="mug-1"),
        job(method="info-only"),
        job(preset="paper"),
        job(seed=4),
        job(overrides=("planner.rollouts=3",)),
        Job("toy", "toy", "KMPPI", "", 3),
    ]
    assert len({base.id, *(other.id for other in others)}) == 1 + len(others)
    assert job().id == base.id
    two = ("planner.rollouts=3", "steps=4")
    assert job(overrides=two).id == job(overrides=two[::-1]).id


def test_a_mesh_counts_by_what_is_in_it(tmp_path):
    here, there = tmp_path / "a.obj", tmp_path / "b.obj"
    for path in (here, there):
        path.write_text("v 0 0 0\n")
    first, second = (job(overrides=(f"object.mesh={path}",)).id for path in (here, there))
    assert first == second != job().id
    there.write_text("v 0 0 1\n")
    assert job(overrides=(f"object.mesh={there}",)).id != first


def test_the_name_is_of_the_code(monkeypatch):
    before = job().id
    monkeypatch.setattr("scripts.reproduce.jobs.code_of", lambda kind: "another")
    assert job().id != before


@pytest.mark.parametrize("count", [1, 2, 3, 7, 50])
def test_shards_share_the_work_out(count):
    jobs = work_of(("fig8",), Selection(seeds=tuple(range(7))))
    parts = [part(jobs, f"{k}/{count}") for k in range(1, count + 1)]
    assert sorted((j.seed, j.method) for p in parts for j in p) == sorted((j.seed, j.method) for j in jobs)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert part(jobs, None) == jobs


def test_experiments_share_their_runs():
    selection = Selection(tasks=("mug-0",), methods=("rumi",), presets=("default",), seeds=(0, 1))
    names = [name for name in EXPERIMENTS if name != "displacement"]
    jobs = work_of(names, selection)
    assert len(jobs) == len(set(jobs))
    plain = [j for j in jobs if j.kind == "run" and not j.overrides]
    assert [j.seed for j in plain] == [0, 1]
    base = preset("default")
    assert (base.initialise.particles, base.planner.mppi.horizon) == (PARTICLES_BEFORE, HORIZON_BEFORE)
    assert preset("paper").initialise.particles == PARTICLES_BEFORE
    horizons = {j.settings.planner.mppi.horizon: j.settings.planner.mppi.knots for j in work_of(["horizon"], selection)}
    assert horizons == {h: (h + 1) // 2 for h in HORIZONS}
