"""Limit of how hard an arm's hand presses, in operational space (Khatib 1987)."""

from typing import NamedTuple, Self

import numpy as np

_AXES = [0, 1, 2, 5]  # rows of a Jacobian: along x, y, z and about z
_LEVER_M = 0.1  # of a turn, by which angles are measured against lengths
_LEAST = 1e-3  # 1/kg, added to mobilities: where an arm is stretched out its hand cannot move along all axes


class HandDynamics(NamedTuple):
    """Operational-space dynamics of a hand along x, y, z and about z; roll and pitch are left to the arm.

    Attributes:
        axes: (4, J), Jacobian of the axes.
        across: (J, 4), how the joints accelerate by a force along each axis.
        mobility: (4, 4), how the hand accelerates along the axes by forces there, 1/kg and 1/(kg m^2).
    """

    axes: np.ndarray
    across: np.ndarray
    mobility: np.ndarray

    @classmethod
    def of(cls, mass: np.ndarray, jacobian: np.ndarray) -> Self:
        """By the arm's mass matrix (J, J) and the hand's Jacobian (6, J)."""
        axes = jacobian[_AXES]
        across = np.linalg.solve(mass, axes.T)
        least = np.array((_LEAST, _LEAST, _LEAST, _LEAST / _LEVER_M**2))
        return cls(axes, across, axes @ across + np.diag(least))

    def pressed(self, acceleration: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Joint accelerations (J) of a hand that presses with no more than so much force (4), N and N m.

        Those that need no more stay. Others become those of a spring along each axis by itself, cut to its limit: the
        forces by which an arm keeps to a straight way are of no use to a hand that is held, and lead it astray. The
        springs are so soft that together they are no stiffer than what they stand for. What moves the hand along no
        axis stays.
        """
        along = self.axes @ acceleration
        needed = np.linalg.solve(self.mobility, along)
        if bool((np.abs(needed) <= force).all()):
            return acceleration
        scale = np.array((1.0, 1.0, 1.0, _LEVER_M))
        most = (np.abs(self.mobility) * np.outer(scale, scale)).sum(1) / scale**2
        return acceleration - self.across @ (needed - np.clip(along / most, -force, force))
