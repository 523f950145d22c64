"""Settings refuse what cannot work, and say what would."""

from dataclasses import replace

import pytest
import torch

from kmppi import MPPI, Changes, KernelKnots, MPPISettings, PerStep, make_parameterization

pytestmark = pytest.mark.usefixtures("no_shape_check")


def test_defaults_are_the_papers():
    settings = MPPISettings()
    assert (settings.horizon, settings.knots, settings.samples) == (15, 8, 500)
    assert (settings.noise_variance, settings.temperature, settings.kernel_scale) == (1.5, 0.01, 2.0)


def test_knots_choose_the_method():
    assert isinstance(make_parameterization(MPPISettings(knots=None)), PerStep)
    assert isinstance(make_parameterization(MPPISettings()), KernelKnots)
    assert isinstance(make_parameterization(MPPISettings(knots=None, changes=True)), Changes)


def test_planner_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="control_max to be one number or one for each of 3 control dimensions, got 2"):
        MPPI(MPPISettings(control_max=(1.0, 2.0)), 3)
    with pytest.raises(ValueError, match="control_dim to be 1 or more"):
        MPPI(MPPISettings(), 0)
    with pytest.raises(ValueError, match="floating"):
        MPPI(MPPISettings(), 3, dtype=torch.int64)
    with pytest.raises(ValueError, match="use fewer knots or a smaller kernel_scale"):
        MPPI(replace(MPPISettings(), knots=15), 3)
