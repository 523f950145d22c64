"""Settings of the pose filter (RUMI, Algs 1-4 and 6)."""

from dataclasses import dataclass, field
from typing import Literal

from rumi.belief.motion import Motion
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.registration.descent import DescentSettings
from sdf import numbers
from sdf.bounds import Checked, NotNegative, Positive, ShareAbove0, TrainedNotNegative, TrainedPositive


@dataclass(frozen=True)
class FilterSettings(Checked):
    """Settings of the pose filter.

    Attributes:
        peakiness: lambda, nats per metre of discrepancy (Eq 10).
        free_scale: C of free and occupied points (Eqs 4, 5), for the lattice `free_spacing_m`.
        tolerance_m: violation that a free or occupied point is allowed.
        free_spacing_m, surface_spacing_m: lattice that keeps one point a cell (Alg 6).
        free_points: that were seen before "ride" with the object, which keeps them true, or are "dropped" as Alg 6 has
            it: they stay where they are, and those inside a particle go at every step. Not of the motion "trajectory".
        motion: "measured" by a slip sensor, "sticking" to the tool, "pushed" as a quasi-static model has it,
            "estimated" from sticking by what was sensed (Alg 5), or "corrected", from pushed in the same way; with
            "trajectory" every particle has its own (`PoseTrajectoryFilter`), of which a measured one is evidence.
            "auto", of tasks, is "trajectory" in space where a prior is followed by touches, else "measured".
        unmeasured: what "measured" and "auto" become where nothing measures the motion; "pushed" and "corrected" are
            for upright objects and a level tool, and "estimated" elsewhere. None for what suits: "trajectory" where a
            view or a prior is followed by touches alone, else "corrected", in space "estimated".
        stated_errors: what a robot and its model are stated to be off by in a whole run counts as wider "noise" of the
            sensors of trajectories, or, in the plane, as "systematic" errors that every particle has of its own;
            "auto": as these where there can be any.
        translation_noise_m, rotation_noise_rad: standard deviations of the process noise, drawn on every move
            and after every resampling (Alg 3); in SE(2) along x, y and yaw. By default the 1 mm and 1 degree of a
            usual slip sensor: 3 mm throws particles across a 4 mm wall, to where the seen side fits the inner one.
        trigger: discrepancy l_r above which the belief is resampled (Alg 1, line 16).
        trigger_percentile: of the particles' discrepancies, compared with the trigger; 1 is the paper's maximum.
        weighing: "scratch" weighs by all observations each time, after an optimiser has moved the particles
            (it is then a heuristic as in the paper: particles resampled by a likelihood and weighed by it again
            count it twice); "incremental" weighs by the change since the last resampling, which does not count
            twice, for a filter without optimiser (`descent.iterations` 0).
        weigh_before_resampling: False is the order of the paper's Alg 1, whose resampling has not seen the new
            data and whose weights after it are all 1/P.
        descent: the optimiser after resampling (Alg 4).
        lies_flat: the object is known to lie flat on the floor at the start, so that in the frame that rides with it
            poses keep their height and tilt even where all may be searched; only with a prior, which has these.
        level_within_rad: tilt of that frame beyond which poses are optimised along the world's floor as well: errors of
            the measured motion, which are level in the world, are then not level in the frame; only with a prior.
        still_m, still_rad: motions below these are no move: no noise, discrepancies carry over.
        evidence: kinds of evidence that count beside semantic points, by name (`rumi.belief.evidence.EVIDENCE`).
        trajectories: of the motion "trajectory", which of the settings above takes the lattice alone.
    """

    peakiness: TrainedPositive = 2.0
    free_scale: NotNegative = 80.0
    tolerance_m: NotNegative = 0.001
    free_spacing_m: Positive = 0.005
    surface_spacing_m: Positive = 0.002
    free_points: Literal["ride", "dropped"] = "ride"
    motion: Motion = "measured"
    unmeasured: Motion | None = None
    stated_errors: Literal["auto", "noise", "systematic"] = "auto"
    translation_noise_m: TrainedNotNegative = 0.001
    rotation_noise_rad: TrainedNotNegative = 0.0175
    trigger: float = 5.0
    trigger_percentile: ShareAbove0 = 0.95
    weighing: Literal["scratch", "incremental"] = "scratch"
    weigh_before_resampling: bool = True
    descent: DescentSettings = field(default_factory=DescentSettings)
    lies_flat: bool = True
    level_within_rad: float = 0.1
    still_m: NotNegative = 1e-4
    still_rad: NotNegative = 1e-3
    evidence: tuple[str, ...] = ()
    trajectories: PoseTrajectorySettings = field(default_factory=PoseTrajectorySettings)

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        numbers.refuse_trained(self, "peakiness", "translation_noise_m", "rotation_noise_rad")
        super().__post_init__()
        if self.unmeasured in ("auto", "measured"):
            raise ValueError(f"Expected unmeasured to be a motion that needs no slip sensor, got {self.unmeasured!r}")
