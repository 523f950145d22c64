"""How far the physics engine says that the object moved while the tool went its way: no slip sensor needed."""

import torch
from jaxtyping import Float
from torch import Tensor

from rumi.belief.particles import PoseBelief
from rumi.dynamics.along_path import unwrapped
from rumi.dynamics.registry import EngineSettings
from rumi.robot.gripper import GripperShape
from rumi.sim.settings import PhysicsSettings
from rumi.sim.world import World
from sdf import se3
from sdf.object_model import ObjectModel
from sensors.reading import Reading


class EngineMotion:
    """Motion of the best-fitting particle in MuJoCo, along the path that the tool reports; as `PushedMotion`.

    An action in which nothing was felt moved nothing. Upright objects and a level tool only. The scenes of a batch are
    simulated one after the other.

    Args:
        model: the object; its exact shape is simulated.
        shape: of the gripper.
        height_m: of the level tool.
        settings: of the engine.
    """

    def __init__(
        self, model: ObjectModel, shape: GripperShape, height_m: float, settings: EngineSettings | None = None
    ) -> None:
        self.settings = own = settings or EngineSettings()
        physics = PhysicsSettings(mass_kg=own.mass_kg, friction=own.friction)
        self.world = World(model.exact, shape, height_m, own.time_step_s, physics)

    @torch.no_grad()
    def __call__(self, belief: PoseBelief, reading: Reading) -> Float[Tensor, "*b K 4 4"]:
        """World motion up to each instant."""
        poses, tool = belief.world_T_object, reading.tool_pose
        best = belief.discrepancy.argmin(-1)[..., None, None, None]
        chosen = torch.gather(poses, -3, best.expand(*best.shape[:-3], 1, 4, 4))[..., 0, :, :]
        path = unwrapped(se3.to_planar(tool).reshape(-1, tool.shape[-3], 3))
        felt = reading.in_contact.any(-1).reshape(-1)
        rows = [
            self._motion(se3.to_planar(pose), way) if touched else se3.identity((len(way),))
            for pose, way, touched in zip(chosen.reshape(-1, 4, 4), path, felt.tolist(), strict=True)
        ]
        return torch.stack(rows).to(tool).reshape(tool.shape)

    def _motion(self, start: Float[Tensor, "3"], path: Float[Tensor, "K 3"]) -> Float[Tensor, "K 4 4"]:
        # the way to the first instant is not reported: it is taken to be as long as the one after it
        before = 2.0 * path[0] - path[1] if len(path) > 1 else path[0]
        self.world.reset(before.cpu(), start.cpu())
        stood = self.world.world_T_object()
        track = self.world.move(path.cpu(), self.settings.action_s, self.settings.hold_s)
        return track.world_T_object @ se3.inverse(stood)
