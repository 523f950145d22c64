"""Settings refuse what cannot work, and say what would."""

from dataclasses import FrozenInstanceError, replace

import pytest
import torch

from kmppi import MPPI, Changes, KernelKnots, MPPISettings, PerStep, make_parameterization

pytestmark = pytest.mark.usefixtures("no_shape_check")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"horizon": 0}, "horizon to be a whole number of at least 1, got 0"),
        ({"horizon": 2.5}, "horizon to be a whole number"),
        ({"samples": True}, "samples to be a whole number"),
        ({"samples": 1}, "at least 2 with include_nominal, got 1"),
        ({"iterations": 0}, "iterations"),
        ({"warmup_iterations": -1}, "warmup_iterations"),
        ({"knots": 16}, "between 2 and the horizon of 15.*got 16.*None for MPPI"),
        ({"knots": 1}, "between 2 and the horizon of 15"),
        ({"knots": 0}, "knots to be a whole number of at least 1"),
        ({"horizon": 1}, "between 1 and the horizon of 1.*got 8"),
        ({"kernel": "gauss"}, "one of rbf, matern32, matern52, bspline3, got 'gauss'"),
        ({"cost_scale": "max"}, "one of raw, std, got 'max'"),
        ({"kernel_scale": 0.0}, "kernel_scale to be positive"),
        ({"temperature": float("nan")}, "temperature to be positive"),
        ({"noise_variance": (1.0, -1.0)}, "noise_variance to be positive"),
        ({"control_min": 1.0}, "control_min to be finite and below"),
        ({"control_min": (-1.0, 2.0)}, "control_min to be finite and below"),
        ({"control_min": (-1.0, -1.0), "control_max": (1.0, 1.0, 1.0)}, "as many control_min as control_max"),
        ({"control_max": float("inf")}, "finite control_max"),
        ({"changes": True}, "knots to be None where changes are sampled, got 8"),
        ({"change_cost": -1.0}, "change_cost to be 0 or more"),
        ({"change_cost": float("inf")}, "change_cost to be 0 or more and finite"),
    ],
)
def test_refuses(changes, message):
    with pytest.raises(ValueError, match=message):
        MPPISettings(**changes)


def test_defaults_are_the_papers():
    settings = MPPISettings()
    assert (settings.horizon, settings.knots, settings.samples) == (15, 8, 500)
    assert (settings.noise_variance, settings.temperature, settings.kernel_scale) == (1.5, 0.01, 2.0)
    with pytest.raises(FrozenInstanceError):
        settings.horizon = 3


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
