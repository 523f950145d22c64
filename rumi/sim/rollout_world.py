"""Simulated world that is stepped from many states at once, for a planner that pushes by it."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rumi.sim.world import World
from sdf import se3


class RolloutWorld(World):
    """A world with a gripper that flies, and physics states of it that are independent of each other."""

    _rest: np.ndarray | None = None

    def states(self, configuration: Float[Tensor, "R Q"], object_pose: Float[Tensor, "R 3"]) -> np.ndarray:
        """Physics states (R, S) with gripper and object at rest, the object at (x, y, yaw), settled into the floor."""
        if self._rest is None:
            away = torch.zeros(len(self._gripper))
            away[0] = -3.0
            self.reset(away, torch.zeros(3))
            size = int(self._mujoco.mj_stateSize(self.model, self._mujoco.mjtState.mjSTATE_FULLPHYSICS))
            rest = np.empty(size)
            self._mujoco.mj_getState(self.model, self.data, rest, self._mujoco.mjtState.mjSTATE_FULLPHYSICS)
            self._rest = rest
        states = np.repeat(self._rest[None], len(object_pose), 0)
        pose, place = object_pose.double().numpy(), 1 + self._object  # time comes first
        states[:, place : place + 2] = pose[:, :2]
        # upright but for what settling tilted it
        states[:, place + 3], states[:, place + 6] = np.cos(0.5 * pose[:, 2]), np.sin(0.5 * pose[:, 2])
        states[:, place + 4 : place + 6] = 0.0
        states[:, [1 + index for index in self._gripper]] = configuration.double().numpy()
        return states

    def act(
        self, states: np.ndarray, ways: np.ndarray, action_s: float, hold_s: float, threads: int
    ) -> tuple[np.ndarray, Float[Tensor, "R 3"]]:
        """Drive the gripper of every state along its own straight way, then hold.

        Args:
            states: (R, S), as `states` gives them.
            ways: (R, 2, Q), configurations from where to where.
            action_s: duration of the motion.
            hold_s: of standing still after it.
            threads: that step at once; the states are the same to the bit.

        Returns:
            states after, and the object's (x, y, yaw).
        """
        from mujoco import rollout

        step_s = float(self.model.opt.timestep)
        moving = round(action_s / step_s)
        share = np.minimum(np.arange(1, moving + round(hold_s / step_s) + 1) / moving, 1.0)[None, :, None]
        commands = ways[:, :1] + share * (ways[:, 1:] - ways[:, :1])
        with rollout.Rollout(nthread=threads if threads > 1 else 0) as engine:
            data = [self._mujoco.MjData(self.model) for _ in range(max(1, threads))]
            found, _ = engine.rollout(self.model, data, states, commands)
        last = found[:, -1].copy()
        poses = self._object_poses(last[:, 1 : 1 + self.model.nq])
        return last, se3.to_planar(poses)
