"""A movable mug before four kinds of sensors: a camera's first view, soft bubbles, a wrench, and joint torques."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rumi.dynamics.sliding import rotated
from rumi.robot.gripper import gripper_parts
from rumi.robot.tool import Tool
from rumi.seeding import split
from rumi.sim.bodies import Body
from rumi.sim.conditions import image_errors
from rumi.sim.fault import Fault
from rumi.sim.force_sensing_world import ForceSensingWorld, WrenchTrace
from rumi.sim.joint_torques import JointFeeler
from rumi.sim.object_faults import Friction, Mass
from rumi.sim.sensor_faults import HandOff
from rumi.sim.sensor_settings import SensorKind, SensorSettings
from rumi.sim.settings import PhysicsSettings, SimSettings
from rumi.sim.view_faults import miscalibration
from rumi.sim.world import Track
from rumi.task import StepResult
from rumi.tasks.grasp_table import Grasp
from rumi.tasks.handle.gripper import HandleGripper
from rumi.tasks.handle.settings import HandleSettings, task_of
from rumi.tasks.rummage.free_region import region_of_prior
from rumi.tasks.rummage.sensed import SensedTask
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.contact_reading import ContactReading, WrenchTouch, surest
from sensors.force.force_torque import WrenchContact, WrenchNoise, WrenchSettings, WrenchStatus
from sensors.force.tool_parts import parts_contact
from sensors.observation import Observation, concatenate
from sensors.semantics import Semantics
from sensors.touch.tactile import swept_points

_PALM = 2  # the part after the two pads
_GUARD = 2  # mini steps of silence before a contact, and at an action's end, that free nothing: readings may be late


class HandleTask(SensedTask):
    """The scene, with those of the sensors that are switched on.

    All images have the errors of the conditions `lab`, lost ones included, unless the settings ask for none. In every
    variant the object's motion is measured, with noise, and where the rigid gripper has been is free: that takes no
    more than joint positions. Where the wrench or the joints say that nothing is touched, the gripper's skin is free
    too.

    Args:
        settings: of the run.
        tool: the gripper with the reach of its arm.
        model: the mug.
        cache_dir: folder that keeps what takes long.
        faults: what goes wrong.
    """

    world: ForceSensingWorld

    def __init__(
        self,
        settings: HandleSettings,
        tool: Tool,
        model: ObjectModel,
        *,
        cache_dir: Path | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        own = settings.sensors
        spec = task_of(settings)
        kind: SensorKind = "bubbles" if "bubbles" in own else "camera"
        sensors = SensorSettings(kind) if settings.noise_free else image_errors(kind)
        simulator = SimSettings(sensors=sensors, free_region_m=settings.free_region_m)
        super().__init__(spec, simulator, tool, model, cache_dir=cache_dir, faults=faults)
        self.fused = settings
        self._drawn = spec
        shape, wrist = self.shape, settings.wrist
        ahead = torch.tensor([wrist.behind_m, 0.0, 0.0], dtype=torch.float64)
        self._parts = gripper_parts(shape, ahead)
        self._noise = WrenchNoise(wrist.force_n, wrist.moment_nm)
        joints = settings.joints.without_errors() if settings.noise_free else settings.joints
        self._joints = JointFeeler(spec.base, spec.height_m, joints) if "torques" in own else None
        self._wrist_noise, self._joint_noise, self._from = torch.Generator(), torch.Generator(), torch.zeros(3)
        self._wrist_off = se3.identity().double()
        self._sought = model.exact
        self.gripper = self._gripper(spec.physics)

    def _gripper(self, physics: PhysicsSettings) -> HandleGripper:
        """What grasps the mug that is there where the one that is looked for would be."""
        return HandleGripper(self.model.exact, self.world.body, physics, self._sought)

    def _world(self, body: Body, physics: PhysicsSettings) -> ForceSensingWorld:
        return ForceSensingWorld(body, self.shape, self.spec.height_m, self.settings.time_step_s, physics)

    def reset(self, seed: int) -> StepResult:
        """Put the mug where the seed has it and return the first look; without a camera it shows nothing."""
        self.spec = replace(self._drawn, start=self.drawn(seed))
        self._wrist_noise, self._joint_noise = split(seed, "wrist"), split(seed, "signals")
        if self._joints is not None:
            self._joints.seed(split(seed, "joints"))
        result = super().reset(seed)
        self._wrist_off = miscalibration(self.sensors, split(seed, "wrist calibration")).double()
        return result

    def drawn(self, seed: int) -> tuple[float, float, float]:
        """(x, y, yaw) of the mug: normal about the mean within two deviations, its handle away from the camera."""
        own, prior, camera = self.fused, self._drawn.prior, self._drawn.camera
        assert prior is not None and camera is not None
        generator = split(seed, "mug")
        while True:
            off = torch.randn(2, generator=generator, dtype=torch.float64)
            if float(off.norm()) < 2.0:
                break
        x, y = (mean + own.spread_m * float(part) for mean, part in zip(prior.mean_m, off, strict=True))
        away = math.atan2(y - camera.position[1], x - camera.position[0])
        turn = 2.0 * float(torch.rand((), generator=generator, dtype=torch.float64)) - 1.0
        return x, y, away + own.handle_rad * turn

    def step(self, control: Float[Tensor, "A"]) -> StepResult:
        """Carry out one control and report."""
        self._from = self.world.configuration()
        return super().step(control)

    @property
    def _looks_again(self) -> bool:
        """It looks once."""
        return False

    def finish(self, grasp: Grasp) -> bool:
        """Grasp the mug where it is taken to stand, in a simulation of its own; whether it was lifted."""
        pose, physics, rougher = grasp.pose, self.spec.physics, 1.0
        for fault in self._begun_faults():
            if isinstance(fault, HandOff):  # by as much in the hand's frame, which is turned as the mug is
                pose = torch.cat((pose[:2] - rotated(fault.aside()[:2].to(pose), pose[2]), pose[2:]))
            elif isinstance(fault, Mass):
                physics = replace(physics, mass_kg=fault.size * physics.mass_kg)
            elif isinstance(fault, Friction):
                rougher *= fault.size
        gripper = self.gripper
        if physics != self.spec.physics or rougher != 1.0:
            gripper = self._gripper(physics)
            gripper.model.geom_friction[:, 0] *= rougher
        return gripper.grasp(pose, self.world.world_T_object())

    def _view(self) -> Observation:
        if "camera" in self.fused.sensors:
            return super()._view()
        self._camera.region = region_of_prior(self.spec, self.model)
        return Observation.empty()

    def _sense(self, before: Float[Tensor, "4 4"], track: Track, refused: Tensor) -> ContactReading:
        """All that was felt on the way."""
        felt, own = self.world.trace, self.fused.sensors
        assert felt is not None
        measured = self._measured(before, track)
        assert measured is not None
        configuration = track.configuration.float()
        tool_pose = self.tool.pose(configuration)
        parts, instants, in_contact = self._felt_by_bubbles(track, tool_pose)
        silent = torch.zeros(len(tool_pose), dtype=torch.bool)
        touch, signals = WrenchTouch.none(), None
        if "wrench" in own:
            arrived = self._arrived(len(tool_pose), self._wrist_noise)
            touch, pushed = self._felt_by_wrist(felt, tool_pose, arrived)
            parts.append(Observation.of(touch.points, Semantics.SURFACE))
            instants.append(touch.instant)
            in_contact, silent = in_contact | pushed, silent | (arrived & ~pushed)
        if self._joints is not None:
            signals, known = (self._delayed(one) for one in self._joints.signals(felt, self._from))
            known = known & self._arrived(len(tool_pose), self._joint_noise)
            signals = signals & known
            in_contact, silent = in_contact | signals, silent | (known & ~signals)
        # what one sensor feels, another's silence does not deny
        free, instant = self._free(tool_pose, measured, silent & ~_soon(in_contact))
        parts.append(free)
        instants.append(instant)
        return ContactReading(
            concatenate(parts),
            torch.cat(instants),
            tool_pose,
            in_contact,
            measured,
            configuration[-1],
            refused,
            float(self.world.data.time),
            wrench=touch,
            signals=signals,
        )

    def _arrived(self, count: int, generator: torch.Generator) -> Bool[Tensor, "K"]:
        """Which mini steps' readings are not lost."""
        return torch.rand(count, generator=generator) >= self.sensors.lost

    def _delayed(self, rows: Tensor) -> Tensor:
        """What arrives at each mini step: of some before, as late as readings are."""
        return rows[(torch.arange(len(rows)) - self._late).clamp_min(0)]

    def _felt_by_wrist(
        self, felt: WrenchTrace, tool_pose: Float[Tensor, "K 4 4"], arrived: Bool[Tensor, "K"]
    ) -> tuple[WrenchTouch, Bool[Tensor, "K"]]:
        """Touches by the mean wrenches of the mini steps, and where there was a force at all."""
        contact, part = self.wrist_contacts(felt)
        pushed = arrived & (contact.status != int(WrenchStatus.NONE))
        good = arrived & (contact.status == int(WrenchStatus.CONTACT))
        # nothing is narrow enough to come between the pads: a line of force through there is of a touch on each
        good &= ~((part == _PALM) & (contact.normal_s[:, 0] > 0.5))
        index, variance = good.nonzero()[:, 0], contact.covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        kept = index[surest(variance[index], self.fused.wrist.most)]
        return WrenchTouch.of(contact, tool_pose.double() @ self._tool_T_sensor(), kept), pushed

    def wrist_contacts(self, felt: WrenchTrace) -> tuple[WrenchContact, Tensor]:
        """Of the noisy mean wrench of each mini step, in the sensor's frame, and the parts that they are on."""
        wrist, rows = self.fused.wrist, torch.from_numpy(felt.wrench)
        yaw = torch.from_numpy(felt.configuration[:, 2].copy())
        turn = se3.from_planar(torch.stack((torch.zeros_like(yaw), torch.zeros_like(yaw), yaw), -1))[:, :3, :3]
        force, moment = ((turn.mT @ part[..., None])[..., 0] for part in (rows[:, :3], rows[:, 3:]))
        ahead = torch.tensor([wrist.behind_m, 0.0, 0.0], dtype=torch.float64)
        moment = moment + torch.linalg.cross(ahead.expand_as(force), force)
        ends = [0, *(int(end) + 1 for end in felt.ends)]
        own = torch.cat((force, moment), -1)
        mean = torch.stack([own[a:b].mean(0) for a, b in pairwise(ends)])
        scale = torch.tensor([wrist.force_n] * 3 + [wrist.moment_nm] * 3, dtype=torch.float64)
        scale *= not self.fused.noise_free
        mean = self._delayed(mean) + scale * torch.randn(mean.shape, generator=self._wrist_noise, dtype=torch.float64)
        settings = WrenchSettings(least_force_n=wrist.least_force_n, friction=wrist.friction)
        return parts_contact(mean, self._parts, self._noise.covariance(), settings)

    def _tool_T_sensor(self) -> Float[Tensor, "4 4"]:
        """Where the wrist's sensor is taken to be."""
        behind = torch.tensor([-self.fused.wrist.behind_m, 0.0, 0.0], dtype=torch.float64)
        return se3.make(torch.eye(3, dtype=torch.float64), behind) @ self._wrist_off

    def _free(
        self, tool_pose: Float[Tensor, "K 4 4"], measured: Float[Tensor, "K 4 4"], silent: Bool[Tensor, "K"]
    ) -> tuple[Observation, Tensor]:
        """What the rigid gripper went through, with its skin where nothing was touched."""
        attached_T_world = self._space.ridden(measured)
        spacing, region = self.settings.free_spacing_m, self._camera.region
        inner = swept_points(tool_pose, self._inner, spacing, attached_T_world=attached_T_world, region=region)[0]
        points, instants = [inner.points], [inner.instant]
        if bool(silent.any()):
            which = silent.nonzero()[:, 0]
            poses, back = tool_pose[which], attached_T_world[which]
            skin = swept_points(poses, self._body, spacing, attached_T_world=back, region=region)[0]
            points.append(skin.points)
            instants.append(which[skin.instant])
        return Observation.of(torch.cat(points), Semantics.FREE), torch.cat(instants)


def _soon(in_contact: Bool[Tensor, "K"]) -> Bool[Tensor, "K"]:
    """Where something is touched then or a little later, as far as is known: nothing is of what comes after the end."""
    later = torch.cat((in_contact, torch.ones(_GUARD, dtype=torch.bool)))
    return torch.stack([later[k : k + len(in_contact)] for k in range(_GUARD + 1)]).any(0)
