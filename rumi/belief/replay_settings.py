"""Settings of the filter that replays its history."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

Resampling = Literal["replay", "importance", "newcomers", "none"]


@dataclass(frozen=True)
class ReplaySettings:
    """Settings of the filter.

    Attributes:
        resampling: "replay" moves particles along the exact posterior; "importance" copies the likely ones;
            "newcomers" is the paper's rule, near the robot where contact was felt and importance else; "none" never.
        trigger: share of N that the effective sample size falls below before it is resampled.
        sweeps: Metropolis moves of every particle at a resampling.
        from_prior: share of moves that are draws from the prior, not jitter.
        jitter_m: least and greatest standard deviation of the jitter, log-uniform.
        jitter_rad_per_m: of yaw with it.
        friction: range of the coefficient, uniform.
        lever_m: range of c, uniform.
        noise: standard deviation of each action's motion, as a share of it; 0 for none.
        noise_tails: h of Tukey's g-and-h distribution, z exp(h z^2 / 2) of a normal z: 0 is normal, more has heavier
            tails, for motions that now and then go quite another way.
        noise_m_per_rad: metres of motion that a radian counts as.
        noise_rad_per_m: of yaw with it.
        newcomers: share of the particles that newcomers replace.
        newcomer_mass: weight that they get in all, split by their likelihood.
        temper: power of the likelihood: 1 for readings that err independently, below it for those that err together.
        overlap_m: distance over which it is uncertain whether the tool, coming down, meets the object.
        overlap_error: chance that it is wrongly taken to have met it, or not to.
        substeps: parts of the way between two readings.
        passes: contacts that are settled in a part, at most.
    """

    resampling: Resampling = "replay"
    trigger: float = 0.5
    sweeps: int = 2
    from_prior: float = 0.1
    jitter_m: tuple[float, float] = (1e-3, 0.05)
    jitter_rad_per_m: float = 8.0
    friction: tuple[float, float] = (0.1, 0.6)
    lever_m: tuple[float, float] = (0.03, 0.06)
    noise: float = 0.0
    noise_tails: float = 0.0
    noise_m_per_rad: float = 0.04
    noise_rad_per_m: float = 10.0
    newcomers: float = 0.2
    newcomer_mass: float = 0.1
    temper: float = 1.0
    overlap_m: float = 0.002
    overlap_error: float = 0.02
    substeps: int = 2
    passes: int = 2

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if self.resampling not in get_args(Resampling):
            raise ValueError(
                f"Expected resampling to be one of {', '.join(get_args(Resampling))}, got {self.resampling!r}"
            )
        for name in ("trigger", "from_prior", "newcomers", "newcomer_mass"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"Expected {name} in [0, 1], got {getattr(self, name)}")
        for name in ("friction", "lever_m", "jitter_m"):
            low, high = getattr(self, name)
            if not 0 <= low <= high < math.inf or (name != "friction" and low <= 0):
                raise ValueError(f"Expected {name} as (low, high) above 0, got {(low, high)}")
        for name in ("noise", "noise_tails", "noise_m_per_rad", "noise_rad_per_m", "jitter_rad_per_m"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"Expected {name} to be 0 or more, got {getattr(self, name)}")
        for name, least in (("sweeps", 0), ("substeps", 1), ("passes", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"Expected {name} to be a whole number from {least} on, got {value}")
        for name in ("temper", "overlap_m"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"Expected {name} above 0, got {getattr(self, name)}")
        if not 0 < self.overlap_error < 0.5:
            raise ValueError(f"Expected overlap_error between 0 and 0.5, got {self.overlap_error}")
