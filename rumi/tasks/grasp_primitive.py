"""The grasp primitive of a gripper that slides x, y, z, turns, and closes two fingers: down, close, up, hold."""

import numpy as np

DROP_S, REST_S, CLOSE_S, LIFT_S, HOLD_S = 0.6, 0.1, 0.5, 0.6, 0.2
GRASP_S = DROP_S + 2 * REST_S + CLOSE_S + LIFT_S + HOLD_S
"""Seconds that the primitive takes."""


def grasp_controls(
    place: tuple[float, float, float], fingers: tuple[float, float], heights: tuple[float, float], step_s: float
) -> np.ndarray:
    """Controls (T, 6) of x, y, z, yaw and both fingers, the first at the beginning.

    Args:
        place: (x, y, yaw) of the gripper, metres and radians.
        fingers: places of each finger, open and closed, metres.
        heights: from which the gripper comes, and to which it lifts, above where it closes, metres.
        step_s: from one control to the next.
    """
    (x, y, yaw), (opened, closed), (high, lift) = place, fingers, heights
    knots = np.array(
        [
            (0.0, x, y, high, yaw, opened, opened),
            (DROP_S, x, y, 0.0, yaw, opened, opened),
            (REST_S, x, y, 0.0, yaw, opened, opened),
            (CLOSE_S, x, y, 0.0, yaw, closed, closed),
            (REST_S, x, y, 0.0, yaw, closed, closed),
            (LIFT_S, x, y, lift, yaw, closed, closed),
            (HOLD_S, x, y, lift, yaw, closed, closed),
        ]
    )
    times = np.cumsum(knots[:, 0])
    now = np.arange(0, round(times[-1] / step_s) + 1) * step_s
    return np.stack([np.interp(now, times, knots[:, 1 + axis]) for axis in range(6)], -1)
