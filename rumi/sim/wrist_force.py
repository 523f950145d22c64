"""Wrist force sensor of a simulated robot: the contact force on the tool, averaged over each mini step, with noise."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.sim.force_sensing_world import WrenchTrace


def wrist_force(trace: WrenchTrace, noise_n: float, generator: torch.Generator) -> Float[Tensor, "K 3"]:
    """Mean force on the tool in each of an action's K mini steps, N, world axes, float32.

    What the tool weighs, and what it takes to speed it up, is taken for compensated.

    Args:
        trace: the contact wrenches of the action.
        noise_n: deviation of each number.
        generator: of the noise.
    """
    begins = np.concatenate(([0], trace.ends[:-1] + 1))
    mean = np.stack([trace.wrench[a : b + 1, :3].mean(0) for a, b in zip(begins, trace.ends, strict=True)])
    noise = noise_n * torch.randn(mean.shape, generator=generator, dtype=torch.float64)
    return (torch.from_numpy(mean) + noise).float()
