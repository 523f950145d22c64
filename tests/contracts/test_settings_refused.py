"""Contract of settings: values without meaning are refused by the setting's name, and what was set stays."""

import math
from dataclasses import FrozenInstanceError, fields
from typing import Any, NamedTuple

import pytest

from kmppi import MPPISettings
from rumi.belief.misfit import MisfitSettings
from rumi.belief.pose_filter import FilterSettings
from rumi.belief.reinitialise import ReinitialiseSettings
from rumi.belief.static_filter import ResampleMoveSettings
from rumi.belief.trajectory_filter import TrajectorySettings
from rumi.belief.trajectory_settings import PoseTrajectorySettings
from rumi.dynamics.displacement_rollouts import DisplacementSettings
from rumi.dynamics.quasi_static import QuasiStaticSettings
from rumi.dynamics.registry import EngineSettings
from rumi.errors import UsageError
from rumi.fields.information import InformationSettings
from rumi.information.stopping import StopSettings
from rumi.planning.gpvr import GPVRSettings
from rumi.planning.rummaging import RummagingSettings
from rumi.planning.slide import SlideSettings
from rumi.registration.descent import DescentSettings
from rumi.registration.from_contacts import LocalizeSettings
from rumi.registration.register import RegisterSettings
from rumi.sim.sensor_settings import SensorSettings
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.tasks.handle.settings import HandleSettings
from rumi.tasks.peg.settings import PegSettings
from rumi.tasks.rummage.objects import ObjectSettings
from rumi.tasks.rummage.settings import Settings
from rumi.tasks.touch_box.scene import TouchTask
from rumi.tasks.touch_box.settings import PokeSettings, TouchSettings
from sdf.mesh.convex import ConvexSettings
from sensors.force.force_torque import WrenchNoise, WrenchSettings
from sensors.touch.bubble import BubbleSettings
from sensors.touch.touch_likelihood import TouchNoise

NAN, INF = math.nan, math.inf
ABOVE_0 = ("radius_m", "speed_m_s", "length_m", "tolerance_m", "spread_deg")  # of the peg task


class Refused(NamedTuple):
    """Settings that cannot be, each by itself, and what is said of them; by default the setting's name."""

    kind: type
    said: str | None
    values: list[dict[str, Any]]
    error: type[ValueError] = ValueError


def one(name: str, *values: Any) -> list[dict[str, Any]]:
    return [{name: value} for value in values]


REFUSED = [
    Refused(MPPISettings, "horizon to be a whole number of at least 1, got 0", one("horizon", 0)),
    Refused(MPPISettings, "horizon to be a whole number", one("horizon", 2.5)),
    Refused(MPPISettings, "samples to be a whole number", one("samples", True)),
    Refused(MPPISettings, "at least 2 with include_nominal, got 1", one("samples", 1)),
    Refused(MPPISettings, None, [{"iterations": 0}, {"warmup_iterations": -1}]),
    Refused(MPPISettings, "between 2 and the horizon of 15.*got 16.*None for MPPI", one("knots", 16)),
    Refused(MPPISettings, "between 2 and the horizon of 15", one("knots", 1)),
    Refused(MPPISettings, "knots to be a whole number of at least 1", one("knots", 0)),
    Refused(MPPISettings, "between 1 and the horizon of 1.*got 8", one("horizon", 1)),
    Refused(MPPISettings, "one of rbf, matern32, matern52, bspline3, got 'gauss'", one("kernel", "gauss")),
    Refused(MPPISettings, "one of raw, std, got 'max'", one("cost_scale", "max")),
    Refused(MPPISettings, "kernel_scale to be positive", one("kernel_scale", 0.0)),
    Refused(MPPISettings, "temperature to be positive", one("temperature", NAN)),
    Refused(MPPISettings, "noise_variance to be positive", one("noise_variance", (1.0, -1.0))),
    Refused(MPPISettings, "control_min to be finite and below", one("control_min", 1.0, (-1.0, 2.0))),
    Refused(MPPISettings, "as many control_min", [{"control_min": (-1.0,) * 2, "control_max": (1.0,) * 3}]),
    Refused(MPPISettings, "finite control_max", one("control_max", INF)),
    Refused(MPPISettings, "knots to be None where changes are sampled, got 8", one("changes", True)),
    Refused(MPPISettings, "change_cost to be 0 or more", one("change_cost", -1.0)),
    Refused(MPPISettings, "change_cost to be 0 or more and finite", one("change_cost", INF)),
    Refused(FilterSettings, "measured, sticking, pushed, estimated, corrected", one("motion", "guessed")),
    Refused(FilterSettings, "needs no slip sensor", one("unmeasured", "measured", "auto")),
    Refused(FilterSettings, None, [{"peakiness": 0.0}, {"trigger_percentile": 2.0}]),
    Refused(ResampleMoveSettings, None, [{"trigger": 2.0}, {"crossed": -1.0}, {"moves": -1}, {"jitter_m": (0.0, 1.0)}]),
    Refused(TrajectorySettings, None, [{"trigger": 1.5}, {"friction": (0.5, 0.1)}, {"jitter_rad_per_m": NAN}]),
    Refused(TrajectorySettings, None, [*one("jitter_m", (0.0, 0.1), (1e-3, INF)), *one("noise", -1.0, NAN)]),
    Refused(TrajectorySettings, None, [{"noise_tails": INF}, *one("overlap_error", 0.0, 0.5), {"sweeps": 1.5}]),
    Refused(TrajectorySettings, None, [{"substeps": 0}, {"passes": 0}, {"resampling": "luck"}]),
    Refused(PoseTrajectorySettings, None, [{"particles": 0}, {"first_particles": -1}, {"rounds": 1.5}, {"lag": NAN}]),
    Refused(
        PoseTrajectorySettings, None, [*one("along", -1.0, INF, NAN), {"height_off": (0.0, -0.1)}, {"fresh_m": -1.0}]
    ),
    Refused(
        PoseTrajectorySettings, None, [*one("friction", (0.0, 1.0), (0.4, NAN), (0.4,)), {"lever_ratio": (0.0, 0.1)}]
    ),
    Refused(PoseTrajectorySettings, None, [{"seen_sd_m": 0.0}, {"free_most": 0}, {"most": (500, 250, 0, 120)}]),
    Refused(PoseTrajectorySettings, r"shared in \[0, 1\], got 1.5", one("shared", 1.5)),
    Refused(PoseTrajectorySettings, r"outliers in \(0, 0.5\)", one("outliers", 0.0, 0.7)),
    Refused(PoseTrajectorySettings, r"dead in \[0, 1\), got", one("dead", 1.0, -0.1)),
    Refused(PoseTrajectorySettings, r"missed in \[0, 1\), got", one("missed", 1.0, 2.0)),
    Refused(PoseTrajectorySettings, r"false in \[0, 1\), got", one("false", 1.0, NAN)),
    Refused(PoseTrajectorySettings, r"exchanged in \[0, 1\], got 3", one("exchanged", 3.0)),
    Refused(PoseTrajectorySettings, "unfitted above 0 and finite", one("unfitted", 0.0, INF)),
    Refused(PoseTrajectorySettings, "sampling_error to be 0 or 1e-6 nats at least", one("sampling_error", 1e-7)),
    Refused(PoseTrajectorySettings, "sampling_error to be 0 or more", one("sampling_error", -1.0, NAN)),
    Refused(PoseTrajectorySettings, "eye_m as 3 values", one("eye_m", (0.0, 0.0))),
    Refused(MisfitSettings, r"alpha in \[0, 1\)", one("alpha", 1.0, -0.1, NAN)),
    Refused(MisfitSettings, None, [*one("outlier", 0.0, 0.5), *one("fit_m", 0.0, NAN), {"broad_m": -1.0}]),
    Refused(MisfitSettings, None, [{"knock_m": 0.0}, {"knock_rad": INF}]),
    Refused(DisplacementSettings, None, [{"mini_steps": 0}, {"push_angle": 0.0}, {"discs": -1}]),
    Refused(DisplacementSettings, "per_step, per_mini_step", one("hazard", "never")),
    Refused(QuasiStaticSettings, None, [{"mini_steps": 0}, {"passes": 0}, {"lever_ratio": 0.0}, {"spacing_m": 0.0}]),
    Refused(QuasiStaticSettings, None, one("friction", -0.1)),
    Refused(EngineSettings, None, [{"time_step_s": 0.0}, {"friction": 0.0}, {"threads": -1}, {"hold_s": -1.0}]),
    Refused(InformationSettings, "surrogate, reverse_kl, forward_kl, sensor_mi", one("mode", "mi")),
    Refused(InformationSettings, "tolerance to be 0 or more", one("tolerance", -0.001)),
    Refused(InformationSettings, None, [{"sharpness": 0.0}, {"tail": 1.0}]),
    Refused(StopSettings, "one of auto, self, apc, probability, never.*, got 'sometimes'", one("rule", "sometimes")),
    Refused(GPVRSettings, None, [{"refit_steps": -1}, {"max_points": -1}, {"least_lengthscale": -0.5}]),
    Refused(GPVRSettings, None, [{"tolerance": -0.1}, {"learning_rate": 0.0}, {"free_spacing": 0.0}]),
    Refused(GPVRSettings, None, [{"free_probability": 1.1}, {"discount": -0.1}]),
    Refused(RummagingSettings, None, [{"rollouts": 0}, {"push_model": "magnetic"}]),
    Refused(RummagingSettings, "not both 0", [{"information_scale": 0.0, "reachability_scale": 0.0}]),
    Refused(SlideSettings, None, [*one("stride", 0.0, 1.5), *one("press", -0.1, INF)]),
    Refused(DescentSettings, "one of gauss-newton, adam", one("method", "newton")),
    Refused(DescentSettings, None, one("enough", 1.0)),
    Refused(LocalizeSettings, r"noise_m in \[1e-09, 1000\]", one("noise_m", 0.0, -1.0, NAN, INF, 1e-30, 1e4)),
    Refused(RegisterSettings, None, [{"kept": 0}, {"starts": 0}, {"polished": 0}, {"plausible": 0.0}]),
    Refused(ReinitialiseSettings, None, [{"starts": -3}, {"polished": 0}, {"plausible": 0.0}, *one("bin_m", 0.0, NAN)]),
    Refused(SensorSettings, None, [{"kind": "ears"}, {"lost": 1.0}], UsageError),
    Refused(SensorSettings, None, [{"turned_about": "me"}, {"membrane_m": 0.0}], UsageError),
    Refused(PhysicsSettings, None, [{"mass_kg": 0.0}, {"friction": 0.0}], UsageError),
    Refused(SimSettings, None, [{"time_step_s": 0.0}, *one("mini_steps", 0, 1000), {"contact_m": -1.0}], UsageError),
    Refused(HandleSettings, None, [{"sensors": ()}, {"steps": 0}], UsageError),
    Refused(
        HandleSettings, None, [*one("run_budget_s", 0.0, INF, NAN), *one("thinking_s", -1.0, INF, NAN)], UsageError
    ),
    Refused(PegSettings, "some blocks are never met", one("lane_m", 0.13)),
    Refused(PegSettings, "low_m above 0", one("low_m", 0.0, -0.1), UsageError),
    Refused(PegSettings, "meets no side", one("low_m", 0.2), UsageError),
    Refused(PegSettings, "lane_m above 0", one("lane_m", 0.0, -1.0), UsageError),
    Refused(PegSettings, "table_m above 0", one("table_m", (0.8, -1.0)), UsageError),
    Refused(PegSettings, r"clear in \[0, 1\]", one("clear", 2.0), UsageError),
    Refused(PegSettings, "holes in the block", one("hole_m", 5.0), UsageError),
    Refused(PegSettings, "hole_m to be 0 or more", one("hole_m", -0.01), UsageError),
    Refused(PegSettings, "doublings to be 0 or more", one("doublings", -1), UsageError),
    Refused(PegSettings, "action_budget_s above 0 and finite", one("action_budget_s", INF, NAN), UsageError),
    Refused(PegSettings, "action_budget_s above 0", one("action_budget_s", -1.0), UsageError),
    Refused(PegSettings, "evaluation_s to be 0 or more", one("evaluation_s", -1.0), UsageError),
    Refused(PegSettings, "evaluation_s to be 0 or more and finite", one("evaluation_s", NAN), UsageError),
    *(Refused(PegSettings, f"{name} above 0", one(name, 0.0, -1.0), UsageError) for name in ABOVE_0),
    Refused(PegSettings, r"probability in \(0, 1\)", one("probability", 2.0), UsageError),
    Refused(PegSettings, "particles to be 100 or more", one("particles", 1), UsageError),
    Refused(PegSettings, "search_particles to be 300 or more", one("search_particles", 0), UsageError),
    Refused(ObjectSettings, "scale", [{"scale": 0.0, "mesh": "a.obj"}], UsageError),
    Refused(ObjectSettings, r"mass_kg in \[0.0001, 1000\]", one("mass_kg", -1.0, 1e-30, 1e30, INF), UsageError),
    Refused(ObjectSettings, "friction", one("friction", INF), UsageError),
    Refused(ObjectSettings, "give --mesh", [{"scale": 0.001}, {"upright": (0.0, 0.0, 90.0)}], UsageError),
    Refused(ObjectSettings, "upright", [{"mesh": "a.obj", "upright": (0.0, NAN, 0.0)}], UsageError),
    Refused(Settings, "no method 'poke'; there are rumi, info-only, reach-only", one("method", "poke"), UsageError),
    Refused(Settings, None, [{"steps": -1}, {"replan_every": 0}, *one("tool_height_m", 0.0, NAN)], UsageError),
    Refused(Settings, "approach_m to be 0 or more", one("approach_m", -0.01, NAN), UsageError),
    Refused(TouchTask, None, [{"rates": (0.1, 0.5)}, {"correlation": 1.0}, {"readings": 0}], UsageError),
    Refused(TouchTask, "box of at most 0.07 m", one("half", (0.036, 0.08)), UsageError),  # 8 mm less than the opening
    Refused(TouchTask, None, [{"half": (0.0, 0.08)}, {"height_m": -0.1}, {"spacing_m": 0.0}], UsageError),
    Refused(TouchTask, None, [*one("modes", (), ((0.4, NAN, 0.0),)), {"spread": (0.06, 0.06, 0.0)}], UsageError),
    Refused(TouchTask, None, [{"friction": (0.6, 0.2)}, {"floor_friction": (0.6, 0.2)}], UsageError),
    Refused(TouchTask, None, [{"mass_kg": (0.0, 0.5)}, {"speed": 0.0}, {"finger_m": 0.0}], UsageError),
    Refused(TouchTask, None, one("opening_m", NAN), UsageError),
    Refused(TouchSettings, None, [*one("threshold", NAN, 0.0, 1.1), *one("decay", 0.0, NAN)], UsageError),
    Refused(PokeSettings, None, [{"neighbours": 1}, {"bend": NAN}, {"hold_m": -0.1}, {"funnel": NAN}], UsageError),
    Refused(ConvexSettings, None, [{"method": "boxes"}, {"concavity": 0.0}, {"iterations": 10}, {"nodes": 1}]),
    Refused(WrenchSettings, None, [{"least_force_n": 0.0}, {"friction": -1.0}, {"sigmas": 0.0}, {"twist_m": -0.1}]),
    Refused(WrenchNoise, None, [{"force_n": -1.0}, {"moment_nm": NAN}, {"tared_over": 0}]),
    Refused(BubbleSettings, None, [{"mean_px": 4}, {"top": 0.0}, {"still_m": 0.005}]),
    Refused(BubbleSettings, "free_stride_px to be 1 or more", one("free_stride_px", 0)),
    Refused(TouchNoise, None, [{"point_m": 0.0}, {"normal_rad": -1.0}, {"outlier": 1.0}, {"extent_m": 0.0}]),
]
CASES = [(row, values) for row in REFUSED for values in row.values]


@pytest.mark.parametrize(("row", "values"), CASES, ids=[f"{row.kind.__name__}-{values}" for row, values in CASES])
def test_what_has_no_meaning_is_refused_by_its_name(row: Refused, values: dict[str, Any], no_shape_check: None) -> None:
    with pytest.raises(row.error, match=row.said or next(iter(values))):
        row.kind(**values)


@pytest.mark.parametrize("kind", sorted({row.kind for row in REFUSED}, key=str))
def test_what_was_set_stays(kind: type) -> None:
    made = kind()
    with pytest.raises(FrozenInstanceError):
        setattr(made, fields(made)[0].name, None)
