"""Motion prior of trajectories by what is believed of real pushes (`rumi.dynamics.push_posterior`)."""

import math
from dataclasses import replace

from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.push_posterior import PushPosterior

_PARTICLES = 512
_OWN: dict[str, object] = {
    "ahead": (0.0, 0.0),  # a rod low on a block tips nothing
    "centre_change_m": 0.0,
    "tails": 0.25,
    "shared": 1.0,
}


def as_believed(
    own: PoseTrajectorySettings, spread_m: float, believed: PushPosterior | None = None
) -> PoseTrajectorySettings:
    """Settings with the motion prior of a push density; of its limit surface the ellipsoid alone.

    Args:
        own: the settings.
        spread_m: mean distance of the object's base from below its centre of mass.
        believed: of how objects slide; by default the library's prior of objects never seen.
    """
    believed = PushPosterior.prior(_PARTICLES) if believed is None else believed
    weights = believed.log_weights.exp()
    mean = weights @ believed.parameters
    deviation = (weights @ (believed.parameters - mean).square()).sqrt().tolist()
    scale = float(believed.scale_quantiles((0.5,))[0])
    share = [scale * part for part in believed.residual.share]
    return replace(
        own,
        friction=(math.exp(mean[0]), deviation[0]),
        lever_ratio=(math.exp(mean[1]), deviation[1]),
        centre_m=math.sqrt(0.5 * (deviation[6] ** 2 + deviation[7] ** 2)) * spread_m,
        along=share[0],
        across=share[1],
        turn_rad_per_m=share[2] / spread_m,
        m_per_rad=spread_m,
        **_OWN,  # type: ignore[arg-type]
    )
