"""The simulated cell: what the ball meets, when, and how a peg goes in."""

import math

import pytest
import torch

from rumi.clock import SimulatedClock
from rumi.information.contact_gain import ContactKind
from rumi.robot.motion_time import SpeedLimits, path_time, travel_time
from rumi.tasks.peg.cell import Block, TouchCell, time_to
from sensors.touch.touch_likelihood import TouchNoise

F64 = torch.float64
RADIUS = 0.0125
EXACT = TouchNoise(1e-9, 1e-9)


def cell(truth=(0.0, 0.0, 0.0), tip=(-0.3, 0.0, 0.03), noise=EXACT):
    return TouchCell(
        torch.tensor(truth, dtype=F64),
        Block(),
        RADIUS,
        noise,
        SpeedLimits(),
        torch.tensor(tip, dtype=F64),
        SimulatedClock(),
        torch.Generator().manual_seed(0),
    )


def to(*points):
    return torch.tensor(points, dtype=F64)


@pytest.mark.parametrize("length", [0.01, 0.025, 0.1, 0.8])
def test_time_to_is_the_profile(length):
    """Speed integrates to the way; the whole way takes what a motion from rest to rest does."""
    limits = SpeedLimits()
    gone = [length * k / 2000 for k in range(2001)]
    times = [time_to(g, length, limits) for g in gone]
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(float(travel_time(torch.tensor(length, dtype=F64), limits)))
    speeds = [(b - a) / (t - s) for a, b, s, t in zip(gone, gone[1:], times, times[1:], strict=False)]
    assert max(speeds) <= limits.speed_m_s * (1 + 1e-6)
    change = [abs(b - a) / (0.5 * (t - r)) for a, b, r, t in zip(speeds, speeds[1:], times, times[2:], strict=False)]
    assert max(change[5:-5]) <= limits.acceleration_m_s2 * 1.05
    assert time_to(0.5 * length, length, limits) == pytest.approx(0.5 * times[-1])


def test_it_stops_where_it_touches():
    table = cell()
    felt = table.follow(to((-0.3, 0.0, 0.03), (0.3, 0.0, 0.03)))
    assert felt.kind == ContactKind.TOUCH
    assert felt.tip.tolist() == pytest.approx([-0.1125, 0.0, 0.03])
    assert felt.point.tolist() == pytest.approx([-0.1, 0.0], abs=1e-7)
    assert felt.normal.tolist() == pytest.approx([-1.0, 0.0], abs=1e-7)
    assert felt.ended_s == pytest.approx(time_to(0.1875, 0.6, SpeedLimits())) == table.clock()
    assert felt.free.tolist()[0][1] == pytest.approx([-0.1125, 0.0])
    # from there it gets away, and then round the block
    away = table.follow(to((-0.1125, 0.0, 0.03), (-0.15, 0.0, 0.03), (-0.15, 0.2, 0.03)))
    assert away.kind == ContactKind.NOTHING and away.leaving and len(away.free) == 2
    wanted = path_time(to((-0.1125, 0.0, 0.03), (-0.15, 0.0, 0.03), (-0.15, 0.2, 0.03)), SpeedLimits())
    assert away.ended_s - away.begun_s == pytest.approx(float(wanted))
    with pytest.raises(ValueError, match="way from the tip"):
        table.follow(to((0.0, 0.0, 0.03), (0.1, 0.0, 0.03)))
    with pytest.raises(ValueError, match="level or straight"):
        table.follow(to((-0.15, 0.2, 0.03), (0.0, 0.0, 0.1)))


def test_it_passes_over_and_comes_down_on_the_top():
    table = cell(tip=(-0.3, 0.0, 0.1))
    over = table.follow(to((-0.3, 0.0, 0.1), (0.3, 0.0, 0.1)))
    assert over.kind == ContactKind.NOTHING and len(over.free) == 0
    down = table.follow(to((0.3, 0.0, 0.1), (0.05, 0.0, 0.1), (0.05, 0.0, 0.03)))
    assert down.kind == ContactKind.TOP
    assert float(down.tip[2]) == pytest.approx(0.06 + RADIUS)
    assert down.point.tolist() == pytest.approx([0.05, 0.0], abs=1e-7)
    # beside the edge by less than the radius it meets the edge, lower down; by more, nothing
    edge = cell(tip=(0.11, 0.0, 0.1)).follow(to((0.11, 0.0, 0.1), (0.11, 0.0, 0.03)))
    assert edge.kind == ContactKind.TOP and edge.point.tolist() == pytest.approx([0.1, 0.0], abs=1e-7)
    assert float(edge.tip[2]) == pytest.approx(0.06 + math.sqrt(RADIUS**2 - 0.01**2))
    beside = cell(tip=(0.113, 0.0, 0.1)).follow(to((0.113, 0.0, 0.1), (0.113, 0.0, 0.03)))
    assert beside.kind == ContactKind.NOTHING and float(beside.tip[2]) == pytest.approx(0.03)


def test_noise_is_as_stated():
    points, angles = [], []
    table = cell(noise=TouchNoise())
    for _ in range(400):
        table.tip = to(-0.3, 0.0, 0.03)
        felt = table.follow(to((-0.3, 0.0, 0.03), (0.3, 0.0, 0.03)))
        points.append(felt.point)
        angles.append(math.atan2(-float(felt.normal[1]), -float(felt.normal[0])))
    spread = torch.stack(points).std(0)
    assert torch.allclose(spread, torch.tensor([0.005, 0.005], dtype=F64), rtol=0.15)
    assert float(torch.tensor(angles).std()) == pytest.approx(math.radians(6.0), rel=0.15)


def test_the_peg():
    block = Block()
    truth = torch.tensor([0.1, 0.2, 0.7], dtype=F64)
    holes = block.holes(truth)
    assert torch.allclose(holes.mean(0), truth[:2])
    assert float((holes[0] - holes[1]).norm()) == pytest.approx(0.12)
    for off, wanted in ((0.004, True), (0.006, False)):
        table = cell(truth.tolist(), tip=(0.0, 0.0, 0.1))
        at = holes[1] + torch.tensor([off, 0.0], dtype=F64)
        found, distance = table.insert(at, 0.0725)
        assert found is wanted and distance == pytest.approx(off)
        assert table.clock() == pytest.approx(float(travel_time(torch.tensor(0.0275, dtype=F64), SpeedLimits())))
