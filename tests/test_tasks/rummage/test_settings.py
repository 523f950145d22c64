import json
import math
from dataclasses import replace
from functools import partial

import pytest
import torch

import rumi
from rumi.dynamics.along_path import push_along_path
from rumi.errors import UsageError
from rumi.planning.registry import POLICIES
from rumi.runs.json_settings import setting_names
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage import scenes
from rumi.tasks.rummage.build import build_rummager
from rumi.tasks.rummage.settings import PRESETS, Settings, from_dict, preset, to_dict


@pytest.mark.parametrize("name", PRESETS)
def test_settings_survive_json(name):
    settings = preset(name, task="mug-2", seed=5, steps=None)
    assert settings.preset == name
    assert from_dict(json.loads(json.dumps(to_dict(settings), allow_nan=False))) == settings


def test_settings_of_all_kinds_survive_json():
    default = preset()
    mppi = replace(default.planner.mppi, knots=None, noise_variance=(0.5, 0.5, 0.2), control_min=-0.5)
    simulator = replace(default.simulator, free_fraction=0.9)
    changed = preset(
        planner=replace(default.planner, mppi=mppi),
        simulator=simulator,
        stop=replace(default.stop, fit=math.inf),
        method="info-only",
        steps=7,
        plan_budget_s=0.05,
    )
    read = from_dict(json.loads(json.dumps(to_dict(changed), allow_nan=False)))
    assert read == changed
    assert isinstance(read.planner.mppi.noise_variance, tuple)


def test_settings_of_a_preset_are_changed_by_name_as_on_the_command_line():
    flags = {"planner.mppi.samples": 100, "filter.trigger": 3, "mass": 0.2}
    dotted = rumi.preset("fast", task="box-1", seed=3, **flags)
    nested = rumi.preset("fast", task="box-1", seed=3, planner={"mppi": {"samples": 100}}, filter={"trigger": 3.0})
    fast = PRESETS["fast"]()
    mppi = replace(fast.planner.mppi, samples=100)
    expected = replace(
        fast,
        task="box-1",
        seed=3,
        planner=replace(fast.planner, mppi=mppi),
        filter=replace(fast.filter, trigger=3.0),
    )
    assert nested == expected
    assert dotted == replace(expected, object=replace(expected.object, mass_kg=0.2))
    assert rumi.preset(task="peg", most_actions=3, seed=2).settings.most_actions == 3
    assert rumi.preset("paper", task="peg").settings.stop == "contacts"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"planer": 1}, "no setting planer; did you mean planner"),
        ({"planner": 3}, "Expected planner to be a dict of its settings or RummagingSettings, got 3"),
        ({"planner": {"mpi": {}}}, r"no setting planner\.mpi; did you mean planner\.mppi"),
        ({"filter.triger": 3}, r"no setting filter\.triger; did you mean filter\.trigger"),
        ({"samples": 3}, r"no setting samples; did you mean planner\.mppi\.samples"),
        ({"xyzzy": 3}, "no setting xyzzy; there are task, method, preset, seed"),
        ({"seed": "x"}, "Expected seed to be of type int, got 'x'"),
        ({"planner": {"push_model": 3}}, r"Expected planner\.push_model to be of type str, got 3"),
        ({"task": "mug-9"}, "no task 'mug-9'; there are mug-0, .*peg"),
    ],
)
def test_what_is_no_setting_is_named_with_what_is_near(changes, message):
    with pytest.raises(UsageError, match=message):
        rumi.preset(**changes)


def test_what_a_recorded_run_adds_is_no_setting():
    assert from_dict({"schema": 1, "made_with": {}, "task": "mug-1"}) == Settings(task="mug-1")


def test_paper_preset_is_table_iv():
    paper = preset("paper")
    assert (paper.initialise.particles, paper.filter.peakiness, paper.filter.trigger) == (100, 2000.0, 5.0)
    filter_ = paper.filter
    assert (filter_.free_scale, filter_.free_spacing_m, filter_.surface_spacing_m) == (10.0, 0.010, 0.002)
    assert (paper.filter.translation_noise_m, paper.filter.rotation_noise_rad) == (0.010, 0.0)
    descent = paper.filter.descent
    assert (descent.method, descent.iterations, descent.rounds) == ("adam", 50, 10)
    assert (paper.planner.mppi.horizon, paper.planner.mppi.samples, paper.planner.mppi.temperature) == (15, 500, 0.01)
    assert (paper.planner.information_scale, paper.planner.reachability_scale) == (1.0, 200.0)
    planner, mppi, information = paper.planner, paper.planner.mppi, paper.planner.information
    assert (information.mode, information.peakiness, information.free_scale) == ("surrogate", 2.0, 10)
    assert (planner.normalise_information, planner.rollouts) == (False, 5)
    assert (mppi.cost_scale, mppi.knots, mppi.kernel_scale, mppi.noise_variance) == ("raw", 8, 2, 1.5)
    assert (planner.push.mini_steps, planner.push.hazard) == (4, "per_mini_step")
    assert planner.push.push_angle == pytest.approx(math.radians(45))
    assert paper.stop.apc_ratio == 0.03
    assert paper.simulator.free_fraction == 0.95


def test_names_of_nested_settings():
    names = setting_names(Settings)
    assert {"seed", "filter.trigger", "planner.mppi.samples", "filter.descent.method"} <= set(names)
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"method": "poke"}, f"There is no method 'poke'; there are {', '.join(POLICIES)}"),
        ({"preset": "quick"}, "one of default, fast, paper, got 'quick'"),
        ({"sed": 1}, "There is no setting sed; there are task, method"),
        ({"filter": {"triger": 1}}, "There is no setting filter.triger; there are filter.peakiness"),
        ({"filter": 3}, "Expected filter. to be an object with named values, got 3"),
        ({"seed": "one"}, "Expected seed to be of type int, got 'one'"),
        ({"seed": True}, "Expected seed to be of type int, got True"),
        ({"seed": -1}, "Expected seed to be 0 or more, below 2**63, got -1"),
        ({"plan_budget_s": -0.1}, "Expected plan_budget_s to be 0 or more, got -0.1"),
        ({"plan_budget_s": "soon"}, "Expected plan_budget_s to be float | None, got 'soon'"),
        ({"planner": {"rollouts": 0}}, "planner: Expected rollouts to be 1 or more, got 0"),
        ({"initialise": {"particles": 0}}, "initialise: Expected particles to be 1 or more, got 0"),
        (
            {"filter": {"rotation_noise_rad": -1.0}},
            "filter: Expected rotation_noise_rad to be 0 or more and finite, got -1.0",
        ),
        ({"filter": {"descent": {"margin_m": math.nan}}}, "Expected filter.descent.margin_m to be a number, got nan"),
    ],
)
def test_what_is_wrong_is_named(values, message):
    with pytest.raises(UsageError) as caught:
        from_dict(values)
    assert message in str(caught.value)


def test_an_unknown_preset_is_refused_with_those_that_there_are(no_shape_check):
    with pytest.raises(UsageError, match="There is no preset 'x'; the presets are default, fast, paper"):
        preset("x")


def test_device_and_dtype(monkeypatch):
    assert preset().torch_device == torch.device("cpu")
    assert preset(dtype="float64").torch_dtype == torch.float64
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match="no CUDA device"):
        _ = preset(device="cuda").torch_device
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("sdf.gpu.available", lambda: False)
    with pytest.raises(UsageError, match=r"needs warp: pip install .*gpu.*, or leave out --device cuda"):
        _ = preset(device="cuda").torch_device
    monkeypatch.setattr("sdf.gpu.available", lambda: True)
    assert preset(device="cuda").torch_device == torch.device("cuda")
    assert any("made on the GPU" in note for note in TASKS["mug-0"].check(preset(device="cuda")))
    assert not TASKS["mug-0"].check(preset())
    box = preset(task="box", conditions="lab", device="cuda")  # the next touch is chosen
    assert any("nothing to do" in note for note in TASKS["box"].check(box))
    measured = replace(box, planner=replace(box.planner, next_touch=False))
    assert any("made on the GPU" in note for note in TASKS["box"].check(measured))


def test_a_replay_believes_by_the_push_model_of_its_run(monkeypatch):
    """Where nothing measures the motion, the belief follows the planner's push model, live and replayed."""
    monkeypatch.setattr(scenes, "make_tool", partial(scenes.make_tool, free_flying=True))
    settings, spec = preset("fast", task="shelf-mug"), scenes.find_task("shelf-mug")
    settings = replace(settings, filter=replace(settings.filter, unmeasured="corrected"))
    live = build_rummager(spec, settings, spec.object_factory(), scenes.make_tool(spec))
    again = TASKS["shelf-mug"].agent(settings)
    assert again.filter.pushed.predict.push is live.filter.pushed.predict.push is push_along_path
    measured = TASKS["mug-0"].agent(replace(settings, task="mug-0"))
    assert measured.filter.pushed is None and measured.policy.settings.push_model == "displacement"


def test_runs_on_record_of_before_plan_in_space_as_they_did():
    told = to_dict(preset(task="box"))
    for part, name in (("planner", "next_touch"), ("planner", "touches"), ("stop", "further")):
        del told[part][name]
    before = from_dict(told | {"made_with": {}})
    assert before.planner.next_touch is False and before.stop.further == 0
    now = from_dict(to_dict(preset(task="box")) | {"made_with": {}})
    assert now.planner.next_touch is None and now.stop.further is None
