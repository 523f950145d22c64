"""Pictures in the manner of RUMI's: what they are of."""

import pytest
import torch

from scripts.reproduce import illustrations
from scripts.reproduce.experiments import EXPERIMENTS


def test_the_sensor_model_is_sure_of_the_surface_within_its_tolerance():
    distance = torch.tensor([-0.05, -0.003, 0.0, 0.003, 0.013, 0.05], dtype=torch.float64)
    chances = illustrations.sensor_model(distance)
    torch.testing.assert_close(chances.sum(-1), torch.ones(6, dtype=torch.float64))
    assert chances[1:4, 2].tolist() == pytest.approx([1.0] * 3)
    assert float(chances[4, 2]) == pytest.approx(float(torch.tensor(-1.0).exp()), rel=1e-6)
    assert chances[0].argmax() == 1 and chances[5].argmax() == 0


def test_all_are_experiments():
    assert set(illustrations.DRAWN) <= set(EXPERIMENTS)


def test_the_sensor_model_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    path = tmp_path / "fig2.png"
    assert "3 mm" in illustrations.DRAWN["fig2"]("mug-0", 0, tmp_path, path)
    assert path.stat().st_size > 5000
