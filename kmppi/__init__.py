"""Sampling model predictive control: MPPI, SMPPI (smooth) and KMPPI (kernel-interpolated)."""

from kmppi.kernels import KERNELS, kernel_matrix
from kmppi.mppi import MPPI
from kmppi.parameterization import Changes, KernelKnots, Parameterization, PerStep, make_parameterization
from kmppi.rollout import rollout_objective
from kmppi.types import (
    ControlPlan,
    CostScale,
    KernelName,
    MPPISettings,
    NonFiniteCostsError,
    Objective,
    Rollouts,
)
from kmppi.weights import perturbation_cost, sample_weights, scale_costs

__all__ = [
    "KERNELS",
    "MPPI",
    "Changes",
    "ControlPlan",
    "CostScale",
    "KernelKnots",
    "KernelName",
    "MPPISettings",
    "NonFiniteCostsError",
    "Objective",
    "Parameterization",
    "PerStep",
    "Rollouts",
    "kernel_matrix",
    "make_parameterization",
    "perturbation_cost",
    "rollout_objective",
    "sample_weights",
    "scale_costs",
]
