"""Every case at a small size: its variants agree, and what is not timed is not made up."""

import math
from dataclasses import replace

import pytest
import torch

from rumi.bench import cases, naive, peers
from rumi.bench.case import CASES, SLOW, Setup
from rumi.bench.cases.discrepancy import view_scene
from rumi.bench.cases.fields import plain_formula
from rumi.bench.cases.rollouts import push_scene
from rumi.bench.measure import carry_out
from rumi.bench.scenes import box_scene, mug_scene
from rumi.fields.information import information_from_distances
from rumi.planning.costs import information_cost
from rumi.planning.reach_cost import ReachabilityCost
from sensors.semantics import Semantics

QUICK = [name for name in CASES if name not in ("import", "run-mug")]


@pytest.mark.parametrize("name", QUICK)
def test_variants_agree(name, tiny):
    assert cases
    result = carry_out(name, CASES[name](tiny), budget_s=0.0, least=1)
    assert result.agree
    own = [row for row in result.rows if row.by == "rumi"]
    assert own
    assert all(math.isfinite(row.error) for row in own if row.error is not None)
    for verdict in result.verdicts:
        assert verdict.target.variant in [row.name for row in result.rows]
    # targets that name a variant which is never there would go unseen
    names = {row.name for row in result.rows} | {"numba"}
    assert {target.variant for target in result.case.targets} <= names
    assert result.case.baselines[-1] in names


@pytest.mark.slow
@pytest.mark.sim
def test_a_whole_run_is_replayed(tiny, tmp_path):
    case = CASES["run-mug"](replace(tiny, cache_dir=tmp_path))
    assert "run-mug" in SLOW and case.items == 2
    result = carry_out("run-mug", case, budget_s=0.0, least=1)
    assert result.agree
    place, steps = case.variants[0]()
    assert steps == 2 and 0.5 < float(place[0]) < 0.7


def test_sizes_are_the_papers():
    whole = Setup()
    mug, box = mug_scene(whole), box_scene(whole)
    assert (mug.pairs, len(mug.workspace), mug.workspace.planar) == (656_100, 6561, True)
    assert (box.pairs, len(box.workspace), box.workspace.planar) == (1_849_100, 18_491, False)
    view = view_scene(whole)
    assert (len(view.points), view.free, len(view.world_T_object)) == (2300, 2000, 100)
    assert bool((view.semantics[: view.free] == Semantics.FREE).all())
    assert bool((view.semantics[view.free :] == Semantics.SURFACE).all())


@pytest.mark.parametrize("mode", ["surrogate", "sensor_mi"])
def test_the_plain_formula_is_the_fields(mode, generator):
    distance = 0.05 * torch.randn(7, 50, generator=generator, dtype=torch.float64)
    log_weights = torch.randn(7, generator=generator, dtype=torch.float64).log_softmax(-1)
    semantics, information = plain_formula(distance, log_weights, mode)
    expected = information_from_distances(distance, log_weights, mode=mode)
    torch.testing.assert_close(semantics, expected.semantics, atol=1e-12, rtol=0)
    torch.testing.assert_close(information, expected.information, atol=1e-12, rtol=0)


def test_the_naive_rollouts_are_the_models(tiny):
    scene = push_scene(tiny)
    result = scene.roll_out()
    states, moved = naive.roll_out(
        scene.field, scene.tool, scene.model.settings, scene.start, scene.controls, scene.draws
    )
    torch.testing.assert_close(states, result.configurations.flatten(0, 1), atol=1e-5, rtol=0)
    torch.testing.assert_close(moved, result.displacements.flatten(0, 1), atol=1e-5, rtol=0)
    assert 0.05 < float(result.touched.double().mean()) < 0.99
    assert float(moved.abs().max()) > 0.01


def test_the_naive_sums_are_the_costs(tiny, generator):
    scene = push_scene(tiny)
    q = torch.randn(20, 3, 3, generator=generator) * torch.tensor([0.2, 0.2, 2.0]) + torch.tensor([0.4, 0.0, 0.0])
    moved = 0.05 * torch.randn(20, 3, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    points = scene.tool.info
    found = naive.gathered(scene.information, points, q, moved)
    assert float(found.max()) > 0
    torch.testing.assert_close(-found, information_cost(scene.information, points, q, moved))
    reach = scene.information.with_values(torch.rand(scene.information.shape, generator=generator))
    torch.testing.assert_close(
        naive.reach_cost(scene.information, reach, moved), ReachabilityCost(scene.information, reach)(moved)
    )
    solid = box_scene(tiny).workspace.zeros()
    with pytest.raises(ValueError, match="planar"):
        naive.gathered(solid, points, q, moved)


def test_without_peers_the_table_says_how_to_get_them(tiny, monkeypatch):
    result = carry_out("distance-mug", CASES["distance-mug"](tiny), budget_s=0.0, least=1)
    assert result.left_out == ("peers: not asked for",)
    assert result.baseline == "torch"
    assert all(row.by == "rumi" for row in result.rows)
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
    peers.missing.cache_clear()
    try:
        assert "pip install 'rumi[peers]'" in peers.missing()
    finally:
        peers.missing.cache_clear()


@pytest.mark.skipif(bool(peers.missing()), reason="the peers are not installed")
@pytest.mark.parametrize("name", [name for name in QUICK if not name.startswith(("reach", "plan", "rollouts"))])
def test_peers_do_the_same_work(name):
    """Up to what their tables lose, and the bounding box that their outside is measured from."""
    setup = Setup(tiny=True, quick=True)
    result = carry_out(name, CASES[name](setup), budget_s=0.0, least=1)
    theirs = [row for row in result.rows if row.by == "peer"]
    assert theirs and not result.left_out
    limit = {"distance": 0.1, "gradient": 0.1, "field": 0.1, "normal": 0.5, "discrepancy": 2.0, "trajectory": 50.0}
    for row in theirs:
        assert row.error is None or row.error < limit[name.split("-")[0]]


def test_the_gpu_times_plain_versions_alone():
    assert Setup(torch.device("cuda")).versions == ("torch",)
    assert not Setup(torch.device("cuda")).peers
    assert "CPU only" in Setup(torch.device("cuda")).left_out[0]
