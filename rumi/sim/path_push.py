"""Pushes along tool paths in MuJoCo: a `PathPush` beside the quasi-static one."""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rumi.dynamics.along_path import PathOutcome, Pusher, distance_to
from rumi.dynamics.sliding import Outline, Sliding
from rumi.sim.world import _import_mujoco
from sdf.threads import count

# rows that are rolled out at once: every step's state of each is kept
_ROWS = 128
# metres that servo and soft contact may add to the tool's reach
_MARGIN_M = 0.003
# depth of the tool's start in an object up to which the engine parts them gently
_INSIDE_M = 0.001
_FAR_M = -3.0  # where the tool waits until the object has come to rest


class PathScene(NamedTuple):
    """An object that stands on a floor, and a tool that servos drive along paths.

    Attributes:
        models: of the engine, alike but for the friction between tool and object.
        frictions: of each model.
        object_joint: name of the object's free joint.
        drives: names of the tool's joints, in the order of the servos.
        planar: which of them are x, y and yaw.
        posture: what all servos hold while the tool is pushed along, those of x, y and yaw apart.
        speed: of the tool, m/s.
        time_step_s: of the physics.
    """

    models: tuple[Any, ...]
    frictions: tuple[float, ...]
    object_joint: str
    drives: tuple[str, ...]
    planar: tuple[int, int, int]
    posture: tuple[float, ...]
    speed: float
    time_step_s: float


class MujocoPathPush:
    """Objects pushed along tool paths by the engine that a simulated truth has, too.

    The limit surface is the engine's own: what a particle holds of it changes nothing here; of its friction the
    nearest of the scene's counts. The pusher must be the scene's tool. An object in which the tool would come down
    stays where it stands, as it does when it blocks the tool: the engine would throw it metres away.

    Skipped, with the same result but for rounding: objects that the tool does not come near where they stand, and of
    the others what is before it first does.

    Args:
        scene: object and tool.
        threads: that simulate at once; 0 for as many as torch has. The poses are the same to the bit.
    """

    def __init__(self, scene: PathScene, threads: int = 0) -> None:
        self._mujoco = _import_mujoco()
        self.scene, self.threads = scene, threads
        model = scene.models[0]
        self._drives = [int(model.joint(name).qposadr[0]) for name in scene.drives]
        self._object = int(model.joint(scene.object_joint).qposadr[0])
        self._rest = self._resting(model)

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
    ) -> PathOutcome:
        """Where objects are after each instant of a path, and how far the tool then is; see `push_along_path`.

        `substeps` and `passes` mean nothing to this engine.
        """
        instants = path.shape[1] - 1
        track = poses[:, None].expand(-1, instants, 3).clone()
        if instants and len(poses):
            first = self._first_near(poses, path, pusher, outline)
            bucket = (
                (sliding.friction.expand(len(poses))[:, None] - poses.new_tensor(self.scene.frictions)).abs().argmin(-1)
            )
            for index, model in enumerate(self.scene.models):
                rows = ((bucket == index) & (first < instants)).nonzero()[:, 0]
                for part in rows[first[rows].argsort(stable=True)].split(_ROWS) if len(rows) else ():
                    self._push(model, part, int(first[part].min()), poses, path, track)
        wide = path.expand(len(poses), -1, 3)
        flat = track.reshape(-1, 3), wide[:, 1:].reshape(-1, 3)
        return PathOutcome(track, distance_to(*flat, pusher, outline).view(len(poses), instants))

    def _first_near(
        self, poses: Float[Tensor, "E 3"], path: Float[Tensor, "#E K1 3"], pusher: Pusher, outline: Outline
    ) -> Int[Tensor, "E"]:
        """The first part of the path in which the tool may touch an object that stands still; their number if none.

        None for an object that the path begins inside of.
        """
        wide = path.expand(len(poses), -1, 3)
        step = float((path[:, 1:, :2] - path[:, :-1, :2]).norm(dim=-1).max())
        still = poses[:, None].expand(-1, path.shape[1], 3)
        apart = distance_to(still.reshape(-1, 3), wide.reshape(-1, 3), pusher, outline).view(wide.shape[:2])
        near: Bool[Tensor, "E K1"] = (apart < step + _MARGIN_M) & (apart[:, :1] >= -_INSIDE_M)
        none = torch.full_like(near[:, 0].long(), path.shape[1] - 1)
        return torch.where(near.any(-1), near.to(torch.uint8).argmax(-1), none)

    def _push(self, model: Any, rows: Tensor, first: int, poses: Tensor, path: Tensor, track: Tensor) -> None:  # noqa: ANN401
        """Roll some objects out from one instant on; their track is changed in place."""
        from mujoco import rollout

        own = path.expand(len(poses), -1, 3)[rows, first:].double().numpy()
        states = np.repeat(self._rest[None], len(rows), 0)
        stand = poses[rows].double().numpy()
        at = 1 + self._object  # time comes first
        states[:, at : at + 2] = stand[:, :2]
        states[:, at + 3], states[:, at + 6] = np.cos(0.5 * stand[:, 2]), np.sin(0.5 * stand[:, 2])
        places = [1 + place for place in self._drives]
        states[:, [places[index] for index in self.scene.planar]] = own[:, 0]
        length = np.linalg.norm(own[:, 1:, :2] - own[:, :-1, :2], axis=-1).max()
        each = max(1, round(length / self.scene.speed / self.scene.time_step_s))
        share = (np.arange(each) + 1.0) / each
        planar = own[:, :-1, None] + share[:, None] * (own[:, 1:] - own[:, :-1])[:, :, None]
        planar = planar.reshape(len(rows), -1, 3)
        controls = np.tile(np.array(self.scene.posture), (*planar.shape[:2], 1))
        controls[..., list(self.scene.planar)] = planar
        threads = self.threads or count()
        data = [self._mujoco.MjData(model) for _ in range(max(1, threads))]
        with rollout.Rollout(nthread=threads if threads > 1 else 0) as engine:
            found, _ = engine.rollout(model, data, states, controls)
        ends = found[:, each - 1 :: each, at : at + 7]
        w, x, y, z = (ends[..., 3 + k] for k in range(4))
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        now = np.concatenate((ends[..., :2], yaw[..., None]), -1)
        track[rows, first:] = torch.from_numpy(now).to(track)

    def _resting(self, model: Any) -> np.ndarray:  # noqa: ANN401
        """Physics state of an object at rest and the tool down, beside it."""
        data = self._mujoco.MjData(model)
        data.qpos[self._drives] = (_FAR_M, *self.scene.posture[1:])
        data.ctrl[:] = data.qpos[self._drives]
        self._mujoco.mj_step(model, data, nstep=round(0.3 / self.scene.time_step_s))
        data.qvel[:] = 0.0
        kind = self._mujoco.mjtState.mjSTATE_FULLPHYSICS
        rest = np.empty(int(self._mujoco.mj_stateSize(model, kind)))
        self._mujoco.mj_getState(model, data, rest, kind)
        return rest
