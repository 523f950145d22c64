"""Retreat: from what leans on the tool it goes back the way it came, once, and not far."""

import math
from dataclasses import replace

import pytest
import torch

import rumi
from rumi.belief.island_filter import IslandFilter
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.retreat import way_back
from tests.test_tasks.rummage.test_trajectory_runs import settings


def test_the_way_back_is_that_of_the_last_action_and_short():
    scale = torch.tensor([0.08, 0.08, 0.08, 0.5])
    here = torch.tensor([0.41, 0.02, 0.1, -3.1])
    short = way_back(torch.tensor([0.4, 0.0, 0.1, 3.1]), here, scale)
    turned = 2.0 * math.pi - 6.2  # the nearer way round
    torch.testing.assert_close(short, torch.tensor([-0.125, -0.25, 0.0, -turned / 0.5]), atol=1e-5, rtol=0)
    long = way_back(here + torch.tensor([0.0, 0.0, 0.1, 0.3]), here, scale)
    torch.testing.assert_close(long, torch.tensor([0.0, 0.0, 0.5, 0.24]), atol=1e-5, rtol=0)
    assert way_back(here, here, scale) is None
    assert way_back(here + torch.tensor([0.0, 0.0, 0.0, 0.2]), here, scale) is None


@pytest.mark.sim
@pytest.mark.parametrize("asked", [None, False])
def test_a_run_in_space_goes_back_once_where_it_leans(asked, all_in_reach, monkeypatch):
    own = replace(settings(), task="drill-0", steps=3, retreats=asked)
    own = replace(own, simulator=replace(own.simulator, measures_motion=False))
    few = replace(own.filter.trajectories, unseen_particles=20)
    monkeypatch.setattr(IslandFilter, "leaning", lambda *_: 0.6)
    records = []
    with build(replace(own, filter=replace(own.filter, trajectories=few)), cache_dir=all_in_reach) as (sim, agent):
        assert agent.retreats == (asked is None)
        rumi.run(sim, agent, seed=0, on_step=records.append)
    planned = [record.plan is not None for record in records[1:]]
    assert planned == ([True, False, True] if asked is None else [True, True, True])
    if asked is None:
        there = records[2].reading.configuration - records[1].reading.configuration
        back = records[1].reading.configuration - records[0].reading.configuration
        assert float((there * back)[:3].sum()) < 0.0 and float(there[:3].norm()) < 0.05


def test_a_mug_never_retreats(all_in_reach):
    with build(rumi.preset("fast", task="mug", conditions="lab"), cache_dir=all_in_reach) as (_, agent):
        assert not agent.retreats
