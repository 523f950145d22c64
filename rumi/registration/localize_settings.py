"""How poses are looked for by `localize`."""

import math
from dataclasses import dataclass

NOISE_M = (1e-9, 1e3)
"""Least and greatest noise of touches, metres: beyond these likelihoods are lost in rounding."""


@dataclass(frozen=True)
class LocalizeSettings:
    """How poses are looked for.

    Attributes:
        starts: poses that the descent starts from.
        spread: of the starts' places about the points' mean, as part of half the diagonal.
        from_prior: share of the starts that a prior seeds, if there is one.
        coarse_points: points that all starts descend on; a sample where there are more.
        coarse: steps of that descent, on squared distances.
        polished: poses that go on.
        fine_points: points that those descend on, at most.
        fine: steps of that descent, on distances.
        noise_m: how far touches are off, the scale of a Laplace distribution, within `NOISE_M`; by default what the
            best pose leaves, and `least_noise_m` at least.
        least_noise_m: see there.
        normal_noise_rad: how far normals are off, a standard deviation (the paper's 6 degrees).
        mode_m, mode_rad: poses nearer to each other than both, up to the object's symmetries, are one mode.
        plausible: least likelihood of a mode that is kept, relative to the best.
        kept: modes that are kept at most, the heaviest.
    """

    starts: int = 800
    spread: float = 0.25
    from_prior: float = 1.0 / 3.0
    coarse_points: int = 100
    coarse: int = 12
    polished: int = 80
    fine_points: int = 1000
    fine: int = 20
    noise_m: float | None = None
    least_noise_m: float = 0.001
    normal_noise_rad: float = math.radians(6.0)
    mode_m: float = 0.01
    mode_rad: float = 0.2
    plausible: float = 1e-6
    kept: int = 30

    def __post_init__(self) -> None:
        """Refuse empty searches."""
        for name in ("starts", "coarse_points", "polished", "fine_points", "kept"):
            if getattr(self, name) < 1:
                raise ValueError(f"Expected {name} to be 1 or more, got {getattr(self, name)}")
        for name in ("least_noise_m", "normal_noise_rad", "mode_m", "mode_rad"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Expected {name} above 0, got {getattr(self, name)}")
        least, most = NOISE_M
        if not self.least_noise_m <= most:
            raise ValueError(f"Expected least_noise_m of {most:g} m at most, got {self.least_noise_m}")
        if self.noise_m is not None and not least <= self.noise_m <= most:
            raise ValueError(f"Expected noise_m of {least:g} to {most:g} m, got {self.noise_m}")
        if not (0 <= self.from_prior <= 1 and 0 < self.plausible <= 1):
            raise ValueError(f"Expected from_prior in [0, 1] and plausible in (0, 1], got {self}")
