"""Whole runs that plan on a GPU, pretended: the belief is followed on the CPU, as ever."""

from dataclasses import replace

import pytest

from rumi import loop
from rumi.planning.on_device import PolicyOnDevice
from rumi.tasks.rummage.build import build
from rumi.tasks.rummage.settings import Settings, preset
from tests.fixtures.pretended_gpu import pretended_gpu

pytest.importorskip("warp")


def few(task: str) -> Settings:
    """Settings of a run whose plans are made of few samples."""
    settings = preset("default", task=task, seed=1000, device="cuda", conditions="lab")
    mppi = replace(settings.planner.mppi, samples=40, warmup_iterations=1)
    return replace(settings, planner=replace(settings.planner, mppi=mppi, next_touch=False))


@pytest.mark.sim
@pytest.mark.parametrize("task", ["mug", "drill"])
def test_a_run_plans_there_and_believes_here(task, all_in_reach):
    with pretended_gpu() as counts, build(few(task), cache_dir=all_in_reach) as parts:
        assert isinstance(parts.agent.policy, PolicyOnDevice)
        counts.clear()
        steps = []
        loop.run(*parts, seed=1000, steps=3, on_step=steps.append)
        record = steps[-1]
        assert parts.agent.filter.settings.motion == "trajectory"
        assert not counts.mixed and any("warp" in where for where in counts.launches)
        assert record.belief.world_T_object.device.type == record.plan.controls.device.type == "cpu"
        assert bool(record.plan.samples.paths.isfinite().all()) and record.plan.samples.paths.device.type == "cpu"
        assert {values.device.type for values in record.plan.fields.values()} == {"cpu"}
