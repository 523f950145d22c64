"""What an agent believes where it would be sure: what replicates of its last update leave of that."""

from dataclasses import replace

import pytest

from rumi.clock import Clock
from rumi.tasks.rummage import agent as rummaging
from rumi.tasks.rummage import evaluation
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import preset


@pytest.mark.parametrize("sure", [True, False])
def test_a_belief_that_would_be_sure_is_asked_of_replicates(cache, monkeypatch, sure):
    settings, made = preset(task="mug", seed=1000), []

    def pooled(pose_filter, before, reading, after, *, generator):
        made.append((before, replace(after)))
        return made[-1][1]

    monkeypatch.setattr(rummaging, "pooled", pooled)
    monkeypatch.setattr(evaluation, "converged", lambda rule, now: sure)
    with build(settings, cache_dir=cache) as (task, agent):
        begun = agent.begin(task.reset(1000), seed=1000, clock=Clock())
        state, action = agent.act(begun)
        after = agent.update(state, action, task.step(action))
    assert len(made) == sure
    if sure:
        assert made[0][0] is begun.record.belief and after.record.belief is made[0][1]
        assert after.record.timings_s["belief"] > 0
