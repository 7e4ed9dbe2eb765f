"""Up in the base frame, from joints and accelerometer: known poses, the emulated accelerometer, readings to ignore."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
import pytest

from slipguard.devices import ArmState
from slipguard.diagnosis import CheckStatus
from slipguard_drivers.ur5.diagnostics import check_mounting, check_tcp
from slipguard_drivers.ur5.mounting import MeasuredUp, flange_rotation
from slipguard_drivers.ur5.state_monitor import RobotState
from slipguard_emulators.ur5.flange import GRAVITY_M_S2, Accelerometer, joints
from slipguard_emulators.ur5.tool import START_POSE

QUARTER = math.pi / 2
HALF_TURN = math.pi / math.sqrt(2.0)
REST = (0.0,) * 6
KNOWN: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "stretched": ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (QUARTER, 0.0, 0.0)),
    "upright": ((0.0, -QUARTER, 0.0, -QUARTER, 0.0, 0.0), (0.0, HALF_TURN, -HALF_TURN)),
    "tool down": ((0.0, -QUARTER, -QUARTER, -QUARTER, QUARTER, 0.0), (HALF_TURN, -HALF_TURN, 0.0)),
}
"""Joints and rotation vector of the flange, as the panel of a UR5 shows them without a TCP."""


def measured(joints_rad: tuple[float, ...], *readings: tuple[float, ...]) -> tuple[float, float, float] | None:
    up = MeasuredUp()
    for reading in readings:
        up.add(joints_rad, reading)
    return up.direction


def tilt_deg(up: tuple[float, float, float] | None) -> float:
    assert up is not None
    return math.degrees(math.acos(min(1.0, max(-1.0, up[2]))))


@pytest.mark.parametrize("name", KNOWN)
def test_the_flange_in_known_poses(name: str) -> None:
    joints_rad, rotation_vector = KNOWN[name]
    assert flange_rotation(joints_rad) == pytest.approx(cv2.Rodrigues(np.array(rotation_vector))[0], abs=1e-9)


def test_the_emulated_joints_have_the_flanges_orientation() -> None:
    rng = np.random.default_rng(0)
    vectors = [START_POSE[3:], (0.0, 0.0, 0.0), (QUARTER, 0.0, 0.0), *map(tuple, rng.uniform(-2.0, 2.0, (50, 3)))]
    for vector in vectors:
        expected = cv2.Rodrigues(np.array(vector))[0]
        assert flange_rotation(joints(tuple(vector))) == pytest.approx(expected, abs=1e-9), vector


@pytest.mark.parametrize("mounting_deg", [0.0, 8.0, 12.0, 90.0, 180.0])
@pytest.mark.parametrize("vector", [START_POSE[3:], (0.3, -1.1, 0.7), (QUARTER, 0.0, 0.0)])
def test_the_mounting_is_measured_in_any_pose(mounting_deg: float, vector: tuple[float, ...]) -> None:
    reading = Accelerometer(mounting_deg).read(0.0, (0.0, 0.0, 0.0, *vector), REST)
    assert math.hypot(*reading) == pytest.approx(GRAVITY_M_S2)
    assert tilt_deg(measured(joints(vector), reading)) == pytest.approx(mounting_deg, abs=1e-6)


def test_pointing_an_axis_upwards_reads_positive() -> None:
    """The manual's sentence: with the fingers down, the z axis of the tool points down."""
    assert Accelerometer(0.0).read(0.0, START_POSE, REST) == pytest.approx((0.0, 0.0, -GRAVITY_M_S2), abs=1e-9)
    assert Accelerometer(0.0).read(0.0, (0.0,) * 6, REST) == pytest.approx((0.0, 0.0, GRAVITY_M_S2), abs=1e-9)


def test_the_emulated_accelerometer_reads_a_motion_too() -> None:
    sensor = Accelerometer(0.0)
    sensor.read(0.0, START_POSE, REST)
    reading = sensor.read(0.008, START_POSE, (0.02, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert reading == pytest.approx((-2.5, 0.0, -GRAVITY_M_S2), abs=1e-6)
    assert sensor.read(0.016, START_POSE, (0.02, 0.0, 0.0, 0.0, 0.0, 0.0))[0] == pytest.approx(0.0, abs=1e-6)


def test_without_gravity_nothing_is_known() -> None:
    up = joints(START_POSE[3:])
    assert measured(up) is None
    assert measured(up, (0.0, 0.0, 0.0)) is None
    assert measured(up, (0.0, 0.0, -15.0)) is None
    assert tilt_deg(measured(up, (0.0, 0.0, -9.8), *[(0.0, 0.0, 0.0)] * 500)) == pytest.approx(0.0, abs=1e-6)


def test_single_readings_of_a_shaken_arm_change_little() -> None:
    up, rng = MeasuredUp(), np.random.default_rng(0)
    for _ in range(300):
        up.add(joints(START_POSE[3:]), np.array([0.0, 0.0, -9.8]) + rng.normal(0.0, 1.0, 3))
    assert tilt_deg(up.direction) < 2.0


@pytest.mark.parametrize(
    ("up", "mode", "status", "observed"),
    [
        ((0.0, 0.1, 0.99), "lift", CheckStatus.OK, "upright: up is 6° from"),
        ((0.0, 0.0, -1.0), "lift", CheckStatus.PROBLEM, "on the ceiling: up is 180° from"),
        ((0.0, 1.0, 0.0), "lift", CheckStatus.PROBLEM, "on a wall: up is 90° from"),
        ((0.0, 1.0, 0.0), "guard", CheckStatus.OK, "on a wall: up is 90° from"),
        (None, "lift", CheckStatus.NOTE, "does not measure gravity"),
    ],
)
def test_doctor_names_the_mounting(
    up: tuple[float, float, float] | None, mode: Literal["lift", "guard"], status: CheckStatus, observed: str
) -> None:
    result = check_mounting(ArmState(0.0, 0.0, False, False, False, 1.0, up=up), mode)
    assert result.status is status
    assert observed in result.observed


def test_doctor_notes_a_tcp_that_does_not_point_along_the_fingers() -> None:
    joints_rad, flange = KNOWN["stretched"]
    for vector, status in ((flange, CheckStatus.OK), ((0.0, 0.0, 0.0), CheckStatus.NOTE)):
        state = RobotState(1.0, (0.0, 0.0, 0.0, *vector), REST, joints_rad, (0.0, 9.8, 0.0), 1, 1, 7, 1.0)
        assert check_tcp(state).status is status
