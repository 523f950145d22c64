"""Contract of simulated sensors: numbers at each instant of a reading, kept in traces, that disturb no other."""

from dataclasses import replace

import pytest
import torch

pytest.importorskip("mujoco")

from rumi.clock import Clock
from rumi.errors import UsageError
from rumi.runs.codec import read_steps, write_step
from rumi.runs.trace import TraceWriter, read_trace
from rumi.sim.sensors import SIMULATED_SENSORS, SimulatedSensor
from rumi.tasks.registry import TASKS
from rumi.tasks.rummage.build import build_rummager, make_task
from rumi.tasks.rummage.scenes import make_tool
from rumi.tasks.rummage.settings import preset

pytestmark = pytest.mark.sim
FORWARD = torch.tensor([0.3, 0.0, 0.0])


def clearance(world, track, world_T_tool, generator):
    """The tool's distance from the object's origin, with noise."""
    away = (world_T_tool[:, :3, 3].double() - track.world_T_object[:, :3, 3]).norm(dim=-1)
    return (away + 0.001 * torch.randn(len(away), generator=generator, dtype=away.dtype))[:, None]


@pytest.fixture(params=["clearance", *SIMULATED_SENSORS])
def sensor(request, monkeypatch):
    if request.param == "clearance":
        monkeypatch.setitem(SIMULATED_SENSORS._members, "clearance", clearance)
    return request.param


def first_step(*further, seed=0, begun=False):
    settings = preset("fast", task="mug-0", method="slide", seed=seed)
    simulator = replace(settings.simulator, sensors=replace(settings.simulator.sensors, further=further))
    small = replace(settings.initialise, particles=12, starts=40, polished=12)
    settings = replace(settings, simulator=simulator, initialise=small, steps=1)
    TASKS["mug-0"].check(settings)
    spec = TASKS["mug-0"].spec
    model, tool = spec.object_factory(), make_tool(spec, free_flying=True)
    task = make_task(spec, settings.simulator, tool=tool, model=model)
    first = task.reset(seed)
    reading = task.step(FORWARD).reading
    if not begun:
        return reading
    return reading, build_rummager(spec, settings, model, tool).begin(first, seed=seed, clock=Clock())


def test_measurements_are_of_each_instant_and_disturb_nothing(sensor):
    reading, bare = first_step(sensor), first_step()
    values = reading.measurements[sensor]
    assert isinstance(SIMULATED_SENSORS[sensor], SimulatedSensor)
    assert len(values) == len(reading.tool_pose) and values.dtype == torch.float32
    assert bare.measurements == {}
    torch.testing.assert_close(reading.observation.points, bare.observation.points, rtol=0, atol=0)
    torch.testing.assert_close(reading.object_motion, bare.object_motion, rtol=0, atol=0)


def test_the_same_seed_measures_the_same(sensor):
    one, again = (first_step(sensor).measurements[sensor] for _ in range(2))
    torch.testing.assert_close(one, again, rtol=0, atol=0, equal_nan=True)


def test_a_trace_keeps_them(sensor, tmp_path):
    reading, state = first_step(sensor, begun=True)
    step = replace(state.record, reading=reading)
    with TraceWriter(tmp_path / "trace.npz") as trace:
        write_step(trace, step, None)
    (read,) = read_steps(read_trace(tmp_path / "trace.npz"), {})
    assert list(read.reading.measurements) == [sensor]
    torch.testing.assert_close(read.reading.measurements[sensor], reading.measurements[sensor], equal_nan=True)


def test_an_unknown_sensor_is_refused_with_the_names():
    with pytest.raises(UsageError, match="no simulated sensor 'sonar'"):
        first_step("sonar")
