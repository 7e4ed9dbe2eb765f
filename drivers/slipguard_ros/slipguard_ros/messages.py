"""Readings as ROS messages."""

from __future__ import annotations

import array
import json
import math
import time
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.clock import Clock
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header, String

from slipguard_ros.readings import DeviceStatus, GelImage, JawJoint, RotationReading

ROTATION_ABOUT_Z = 35
"""Index of the variance of the rotation about z in a 6 x 6 covariance."""


class Stamps:
    """Converts the daemon's times, which are CLOCK_MONOTONIC of this machine, to the node's clock.

    frame_prefix: begins the names of all coordinate frames.
    """

    def __init__(self, clock: Clock, frame_prefix: str) -> None:
        self._clock, self._prefix = clock, frame_prefix

    def header(self, at_s: float | None, frame: str) -> Header:
        """Return a header. at_s: None stands for now."""
        age_s = 0.0 if at_s is None else time.monotonic() - at_s
        nanoseconds = max(self._clock.now().nanoseconds - round(1e9 * age_s), 0)
        stamp = Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)
        return Header(stamp=stamp, frame_id=self._prefix + frame)


def image_message(image: GelImage, header: Header) -> Image:
    """Return a gel image."""
    message = Image(header=header, height=image.height_px, width=image.width_px, encoding="bgr8", is_bigendian=0)
    message.step = 3 * image.width_px
    pixels = array.array("B")
    pixels.frombytes(
        image.pixels
    )  # one copy; `array.array("B", image.pixels)` takes each byte by itself, 230,400 times
    message.data = pixels
    return message


def state_message(state: dict[str, Any]) -> String:
    """Return the complete state as JSON."""
    return String(data=json.dumps(state))


def joint_message(gripper: dict[str, Any], joint: JawJoint, header: Header) -> JointState:
    """Return position (see `JawJoint`) and force per finger of the jaws."""
    return JointState(
        header=header,
        name=[joint.name],
        position=[joint.position(gripper["width_mm"])],
        effort=[float(gripper["force_n"])],
    )


def force_message(gripper: dict[str, Any], header: Header) -> WrenchStamped:
    """Return the force that each finger applies to the object, along z."""
    message = WrenchStamped(header=header)
    message.wrench.force.z = float(gripper["force_n"])
    return message


def rotation_message(rotation: RotationReading, header: Header) -> PoseWithCovarianceStamped:
    """Return the rotation about z and its variance; position and the other rotations are not measured, and 0."""
    message = PoseWithCovarianceStamped(header=header)
    message.pose.pose.orientation.z = math.sin(rotation.rotation_rad / 2.0)
    message.pose.pose.orientation.w = math.cos(rotation.rotation_rad / 2.0)
    message.pose.covariance[ROTATION_ABOUT_Z] = rotation.sigma_rad**2
    return message


def diagnostics_message(statuses: list[DeviceStatus], header: Header) -> DiagnosticArray:
    """Return the statuses of guard and devices."""
    return DiagnosticArray(
        header=header,
        status=[
            DiagnosticStatus(
                level=bytes([one.level]),
                name=f"slipguard: {one.name}",
                message=one.message,
                hardware_id=one.values.get("serial", "slipguard"),
                values=[KeyValue(key=key, value=value) for key, value in one.values.items()],
            )
            for one in statuses
        ],
    )
