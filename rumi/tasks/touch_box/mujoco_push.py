"""Particles of the touch-alone task pushed by MuJoCo: a `Carrier` beside the quasi-static one."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.along_path import Carried, Pusher, distance_to
from rumi.dynamics.sliding import Outline, Sliding
from rumi.sim.world import _import_mujoco
from rumi.tasks.touch_box.mujoco_scene import GripperPhysics, scene_xml, set_truth
from rumi.tasks.touch_box.scene import BoxTruth, TouchTask
from sdf.threads import count

# frictions that particles are put to, the nearest each: a model of the engine has one
_FRICTIONS = 5
# rows that are rolled out at once: every step's state of each is kept
_ROWS = 128
# metres that servo and soft contact may add to the tool's reach
_MARGIN_M = 0.003
# depth of the tool's start in a box up to which the engine parts them gently
_INSIDE_M = 0.001


class MujocoCarry:
    """Boxes carried along tool paths by the engine that the simulated truth has, too.

    Mass and the floor's friction are the middles of the task's ranges, and the limit surface is the engine's own: what
    a particle holds of it changes nothing here; of its friction the nearest of five in the task's range counts. The
    fingers must be the task's gripper's. A box in which the tool would come down stays where it stands, as it does
    when it blocks the tool: the engine would throw it metres away.

    Skipped, with the same result but for rounding: boxes that the tool does not come near where they stand, and of the
    others what is before it first does.

    Args:
        task: the scene.
        threads: that simulate at once; 0 for as many as torch has. The poses are the same to the bit.
        physics: of the engine; by default with steps of 2 ms.
    """

    def __init__(self, task: TouchTask, threads: int = 0, physics: GripperPhysics | None = None) -> None:
        self._mujoco = _import_mujoco()
        self.task, self.threads = task, threads
        self.physics = physics or GripperPhysics(time_step_s=0.002, contact_s=0.004)
        text = scene_xml(task, self.physics, grasping=False)
        low, high = task.friction
        self.frictions = [low + (high - low) * (k + 0.5) / _FRICTIONS for k in range(_FRICTIONS)]
        floor, mass = (0.5 * sum(ends) for ends in (task.floor_friction, task.mass_kg))
        self.models = []
        for friction in self.frictions:
            model = self._mujoco.MjModel.from_xml_string(text)
            set_truth(self._mujoco, model, task, BoxTruth(torch.zeros(3), friction, floor, mass))
            self.models.append(model)
        model = self.models[0]
        self._drives = [int(model.joint(name).qposadr[0]) for name in ("x", "y", "z", "yaw", "left", "right")]
        self._box = int(model.joint("box").qposadr[0])
        self._rest = self._settled(model)

    def __call__(
        self,
        poses: Float[Tensor, "E 3"],
        path: Float[Tensor, "#E K1 3"],
        pusher: Pusher,
        outline: Outline,
        sliding: Sliding,
        *,
        substeps: int = 2,
        passes: int = 2,
    ) -> Carried:
        """Where boxes are after each instant of a path, and how far the tool then is; see `carry`.

        `substeps` and `passes` mean nothing to this engine.
        """
        instants = path.shape[1] - 1
        track = poses[:, None].expand(-1, instants, 3).clone()
        if instants and len(poses):
            first = self._first_near(poses, path, pusher, outline)
            bucket = (sliding.friction.expand(len(poses))[:, None] - poses.new_tensor(self.frictions)).abs().argmin(-1)
            for index, model in enumerate(self.models):
                rows = ((bucket == index) & (first < instants)).nonzero()[:, 0]
                for part in rows[first[rows].argsort(stable=True)].split(_ROWS) if len(rows) else ():
                    self._push(model, part, int(first[part].min()), poses, path, track)
        wide = path.expand(len(poses), -1, 3)
        flat = track.reshape(-1, 3), wide[:, 1:].reshape(-1, 3)
        return Carried(track, distance_to(*flat, pusher, outline).view(len(poses), instants))

    def _first_near(
        self, poses: Float[Tensor, "E 3"], path: Float[Tensor, "#E K1 3"], pusher: Pusher, outline: Outline
    ) -> Int[Tensor, "E"]:
        """The first part of the path in which the tool may touch a box that stands still; their number if none.

        None for a box that the path begins inside of.
        """
        wide = path.expand(len(poses), -1, 3)
        step = float((path[:, 1:, :2] - path[:, :-1, :2]).norm(dim=-1).max())
        still = poses[:, None].expand(-1, path.shape[1], 3)
        apart = distance_to(still.reshape(-1, 3), wide.reshape(-1, 3), pusher, outline).view(wide.shape[:2])
        near: Bool[Tensor, "E K1"] = (apart < step + _MARGIN_M) & (apart[:, :1] >= -_INSIDE_M)
        none = torch.full_like(near[:, 0].long(), path.shape[1] - 1)
        return torch.where(near.any(-1), near.to(torch.uint8).argmax(-1), none)

    def _push(self, model: Any, rows: Tensor, first: int, poses: Tensor, path: Tensor, track: Tensor) -> None:  # noqa: ANN401
        """Roll some boxes out from one instant on; their track is changed in place."""
        from mujoco import rollout

        own = path.expand(len(poses), -1, 3)[rows, first:].double().numpy()
        states = np.repeat(self._rest[None], len(rows), 0)
        boxes = poses[rows].double().numpy()
        at = 1 + self._box  # time comes first
        states[:, at : at + 2] = boxes[:, :2]
        states[:, at + 3], states[:, at + 6] = np.cos(0.5 * boxes[:, 2]), np.sin(0.5 * boxes[:, 2])
        places = [1 + place for place in self._drives]
        states[:, [places[0], places[1], places[3]]] = own[:, 0]
        length = np.linalg.norm(own[:, 1:, :2] - own[:, :-1, :2], axis=-1).max()
        each = max(1, round(length / self.task.speed / self.physics.time_step_s))
        share = (np.arange(each) + 1.0) / each
        planar = own[:, :-1, None] + share[:, None] * (own[:, 1:] - own[:, :-1])[:, :, None]
        planar = planar.reshape(len(rows), -1, 3)
        controls = np.zeros((*planar.shape[:2], 6))
        controls[..., [0, 1, 3]] = planar
        controls[..., 4:] = self.task.finger_m
        threads = self.threads or count()
        data = [self._mujoco.MjData(model) for _ in range(max(1, threads))]
        with rollout.Rollout(nthread=threads if threads > 1 else 0) as engine:
            found, _ = engine.rollout(model, data, states, controls)
        ends = found[:, each - 1 :: each, at : at + 7]
        w, x, y, z = (ends[..., 3 + k] for k in range(4))
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        now = np.concatenate((ends[..., :2], yaw[..., None]), -1)
        track[rows, first:] = torch.from_numpy(now).to(track)

    def _settled(self, model: Any) -> np.ndarray:  # noqa: ANN401
        """Physics state of a box at rest and the gripper down, beside it."""
        data = self._mujoco.MjData(model)
        data.qpos[self._drives] = (-3.0, 0.0, 0.0, 0.0, self.task.finger_m, self.task.finger_m)
        data.ctrl[:] = data.qpos[self._drives]
        self._mujoco.mj_step(model, data, nstep=round(0.3 / self.physics.time_step_s))
        data.qvel[:] = 0.0
        kind = self._mujoco.mjtState.mjSTATE_FULLPHYSICS
        rest = np.empty(int(self._mujoco.mj_stateSize(model, kind)))
        self._mujoco.mj_getState(model, data, rest, kind)
        return rest
