"""Which way is up in the frame of the arm's base, as the accelerometer in the tool measures it at rest.

Its axes are those of the tool, and an axis that points upwards gives a positive reading (Universal Robots, URScript
manual for CB3 and e-Series, `get_tool_accelerometer_reading`; RTDE's `actual_tool_accelerometer` is the same sensor).
So at rest it reads 9.8 m/s2 upwards, in the frame of the tool flange. The flange's orientation follows from the joints,
because an active TCP may be rotated against the flange.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

LINK_TWISTS_RAD = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
"""Angle alpha of each link's Denavit-Hartenberg parameters, the same for all UR arms. The other parameters move the
flange, but do not rotate it. Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics"."""
GRAVITY_MIN_M_S2, GRAVITY_MAX_M_S2 = 7.0, 13.0
"""A reading outside of this is not gravity alone: the arm is shaken, or the sensor does not measure."""
READINGS_MAX = 25
"""The mean follows a change within about this many readings."""


def flange_rotation(joints_rad: Sequence[float]) -> NDArray[np.float64]:
    """Return the rotation of the tool flange in the base frame: (3, 3). joints_rad: six angles."""
    rotation = np.eye(3)
    for angle_rad, twist_rad in zip(joints_rad, LINK_TWISTS_RAD, strict=True):
        c, s, ct, st = math.cos(angle_rad), math.sin(angle_rad), math.cos(twist_rad), math.sin(twist_rad)
        rotation = rotation @ np.array([[c, -s * ct, s * st], [s, c * ct, -c * st], [0.0, st, ct]])
    return rotation


def rotation_matrix(rotation_vector: Sequence[float]) -> NDArray[np.float64]:
    """Return a rotation vector in rad as a (3, 3) matrix."""
    return np.asarray(cv2.Rodrigues(np.array(rotation_vector, np.float64))[0], np.float64)


class MeasuredUp:
    """Mean direction of up in the base frame."""

    def __init__(self) -> None:
        self._mean = np.zeros(3)
        self._readings = 0

    def add(self, joints_rad: Sequence[float], acceleration_m_s2: Sequence[float]) -> None:
        """Add a reading of the arm at rest."""
        if not GRAVITY_MIN_M_S2 <= math.hypot(*acceleration_m_s2) <= GRAVITY_MAX_M_S2:
            return
        up = flange_rotation(joints_rad) @ np.asarray(acceleration_m_s2)
        self._readings = min(self._readings + 1, READINGS_MAX)
        self._mean += (up - self._mean) / self._readings

    @property
    def direction(self) -> tuple[float, float, float] | None:
        """Unit vector; None without a reading."""
        length = float(np.linalg.norm(self._mean))
        if length == 0.0:
            return None
        x, y, z = (float(part) / length for part in self._mean)
        return x, y, z
