"""The tool flange of the emulated arm: joint angles of its orientation, and the accelerometer in it.

The joints have the orientation of the flange only: the emulated tool moves in straight lines, without kinematics.
The active TCP is not rotated against the flange.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

GRAVITY_M_S2 = 9.82
"""As in the manual's example of `set_gravity`."""


def flange_rotation(pose: Sequence[float]) -> NDArray[np.float64]:
    """Return the flange's rotation in the base frame: (3, 3). pose: with a rotation vector, as RTDE has it."""
    return np.asarray(cv2.Rodrigues(np.array(pose[3:], np.float64))[0])


@lru_cache(maxsize=16)
def joints(rotation_vector: tuple[float, ...]) -> tuple[float, ...]:
    """Return six joint angles in rad that turn the flange this way, the first three 0.

    In the zero position the arm is stretched out and its flange faces -y. There the axes of the joints are, from the
    base on, z, three times -y, -z and -y. Source: Universal Robots, "DH parameters".
    """
    zero = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    turned = zero.T @ flange_rotation((0.0, 0.0, 0.0, *rotation_vector))
    # Seen from the flange in its zero position, the last three joints rotate about z, -y and z.
    tilt = math.acos(min(1.0, max(-1.0, turned[2, 2])))
    if math.sin(tilt) < 1e-9:
        return 0.0, 0.0, 0.0, 0.0, -tilt, math.atan2(turned[1, 0], turned[1, 1])
    first = math.atan2(turned[1, 2], turned[0, 2])
    last = math.atan2(turned[2, 1], -turned[2, 0])
    return 0.0, 0.0, 0.0, first, -tilt, last


class Accelerometer:
    """The accelerometer in the flange, with the flange's axes: an axis that points upwards gives a positive reading.

    It reads the acceleration of a motion, too. Source: Universal Robots, URScript manual for CB3 and e-Series,
    `get_tool_accelerometer_reading`. mounting_deg: tilt of the base about its x axis, as in the example of
    `set_gravity` there: 0 upright, 90 on a wall, 180 on the ceiling.
    """

    def __init__(self, mounting_deg: float) -> None:
        tilt = math.radians(mounting_deg)
        self._up = np.array([0.0, math.sin(tilt), math.cos(tilt)])
        self._before: tuple[float, NDArray[np.float64]] | None = None

    def read(self, now_s: float, pose: Sequence[float], velocity: Sequence[float]) -> tuple[float, ...]:
        """Return the reading in m/s2; the acceleration is that since the reading before."""
        speed, acceleration = np.array(velocity[:3]), np.zeros(3)
        if self._before is not None and now_s > self._before[0]:
            acceleration = (speed - self._before[1]) / (now_s - self._before[0])
        self._before = now_s, speed
        reading = flange_rotation(pose).T @ (GRAVITY_M_S2 * self._up + acceleration)
        return tuple(map(float, reading))
