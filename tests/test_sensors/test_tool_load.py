"""Bias and weight of a tool: from readings at rest, and what is left of a reading without them."""

import pytest
import torch
from torch import Tensor

from sdf import so3
from sensors.force.tool_load import GRAVITY, ToolLoad, calibrate_load

F64 = torch.float64
LOAD = ToolLoad(
    torch.tensor([1.0, -2.0, 3.0, 0.1, -0.2, 0.3], dtype=F64),
    torch.tensor(0.8, dtype=F64),
    torch.tensor([0.01, -0.02, 0.07], dtype=F64),
)


def turns(count: int, generator: torch.Generator) -> Tensor:
    return so3.exp(torch.randn(count, 3, generator=generator, dtype=F64))


def readings(load: ToolLoad, world_R_sensor: Tensor) -> Tensor:
    """Spelt out one by one: a weight at the centre of mass."""
    rows = []
    for turn in world_R_sensor:
        force = turn.T @ torch.tensor([0.0, 0.0, -GRAVITY * float(load.mass_kg)], dtype=F64)
        rows.append(torch.cat((force, torch.linalg.cross(load.center_s, force))) + load.bias)
    return torch.stack(rows)


def test_a_level_sensor_feels_the_weight_below_it() -> None:
    load = ToolLoad(torch.zeros(6, dtype=F64), torch.tensor(2.0, dtype=F64), torch.tensor([0.1, 0.0, 0.0], dtype=F64))
    wrench = load.weight(torch.eye(3, dtype=F64))
    assert wrench.tolist() == pytest.approx([0.0, 0.0, -2.0 * GRAVITY, 0.0, 0.1 * 2.0 * GRAVITY, 0.0])
    falling = load.weight(torch.eye(3, dtype=F64), torch.tensor([0.0, 0.0, -GRAVITY], dtype=F64))
    assert falling.abs().max() == 0


def test_calibration_finds_the_load(generator: torch.Generator) -> None:
    turn = turns(8, generator)
    found = calibrate_load(readings(LOAD, turn), turn)
    torch.testing.assert_close(found.load.bias, LOAD.bias)
    torch.testing.assert_close(found.load.mass_kg, LOAD.mass_kg)
    torch.testing.assert_close(found.load.center_s, LOAD.center_s)
    assert found.force_rms_n < 1e-9
    turn = turns(400, generator)
    noise = torch.tensor([0.1] * 3 + [0.005] * 3, dtype=F64) * torch.randn(400, 6, generator=generator, dtype=F64)
    found = calibrate_load(readings(LOAD, turn) + noise, turn)
    assert found.force_rms_n == pytest.approx(0.1, rel=0.1)
    assert found.moment_rms_nm == pytest.approx(0.005, rel=0.1)
    # 400 readings leave a twentieth of the noise, and less
    torch.testing.assert_close(found.load.bias, LOAD.bias, atol=0.03, rtol=0)
    assert float((found.load.center_s - LOAD.center_s).norm()) < 5e-4


def test_what_is_left_is_the_contact(generator: torch.Generator) -> None:
    turn = turns(5, generator)
    contact = torch.randn(5, 6, generator=generator, dtype=F64)
    torch.testing.assert_close(LOAD.contact_wrench(readings(LOAD, turn) + contact, turn), contact)
    single = LOAD.contact_wrench((readings(LOAD, turn) + contact)[2].float(), turn[2])
    torch.testing.assert_close(single, contact[2].float(), atol=1e-5, rtol=0)


def test_a_tare_finds_the_bias_that_is_there_now(generator: torch.Generator) -> None:
    turn = turns(20, generator)
    drift = torch.tensor([0.5, 0.1, -0.4, 0.01, 0.02, -0.03], dtype=F64)
    tared = LOAD.tared(readings(LOAD, turn) + drift, turn)
    torch.testing.assert_close(tared.bias, LOAD.bias + drift)
    assert tared.mass_kg is LOAD.mass_kg


def test_what_cannot_be_calibrated_is_refused(generator: torch.Generator) -> None:
    alike = so3.exp(torch.tensor([0.0, 0.0, 1.0], dtype=F64) * torch.arange(5.0, dtype=F64)[:, None])
    with pytest.raises(ValueError, match="too much alike"):
        calibrate_load(readings(LOAD, alike), alike)
    one_axis = so3.exp(torch.tensor([1.0, 0.0, 0.0], dtype=F64) * torch.linspace(-0.001, 0.001, 6, dtype=F64)[:, None])
    with pytest.raises(ValueError, match="too much alike"):
        calibrate_load(readings(LOAD, one_axis), one_axis)
    turn = turns(6, generator)
    with pytest.raises(ValueError, match="negated"):
        calibrate_load(-readings(LOAD, turn), turn)
    with pytest.raises(ValueError, match="at least one"):
        LOAD.tared(torch.zeros(0, 6, dtype=F64), torch.zeros(0, 3, 3, dtype=F64))
