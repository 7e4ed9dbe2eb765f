"""The daemon's state and estimates as ROS messages: SI units, and NaN for what is not known."""

from __future__ import annotations

import array
import math
import time
from dataclasses import dataclass
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.clock import Clock
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header

from slipguard_client import GelImage

UNITS = {"": 1.0, "_n": 1.0, "_mm": 1e-3, "_deg": math.pi / 180.0, "_deg_s": math.pi / 180.0, "_mm_s": 1e-3}
"""Endings of the daemon's names, and the factor to SI units."""
NOT_MEASURED = (0, 7, 14, 21, 28)
"""The variances of x, y, z and of the rotations about x and y in a 6 x 6 covariance."""
ROTATION_ABOUT_Z = 35


@dataclass(frozen=True)
class JawJoint:
    """The joint that stands for the jaws: its position is `offset` + `scale` * meters between the jaws."""

    name: str
    scale: float
    offset: float

    def position(self, width_mm: float) -> float:
        return self.offset + self.scale * width_mm / 1000.0

    def width_mm(self, position: float) -> float:
        return (position - self.offset) / self.scale * 1000.0


class Stamps:
    """Converts the daemon's times, which are CLOCK_MONOTONIC of this machine, to the node's clock.

    frame_prefix: begins the names of all coordinate frames.
    """

    def __init__(self, clock: Clock, frame_prefix: str) -> None:
        self._clock, self._prefix = clock, frame_prefix

    def now(self) -> Header:
        """Return a header without a frame."""
        return Header(stamp=self._clock.now().to_msg())

    def header(self, at_s: float | None, frame: str) -> Header:
        """Return a header. at_s: None stands for now."""
        age_s = 0.0 if at_s is None else time.monotonic() - at_s
        nanoseconds = max(self._clock.now().nanoseconds - round(1e9 * age_s), 0)
        stamp = Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)
        return Header(stamp=stamp, frame_id=self._prefix + frame)


def fill(message: Any, values: dict[str, Any]) -> Any:
    """Set each field from the value of the same name, which may end with a unit of `UNITS`; return the message.

    An unknown number is NaN, a missing object an empty message.
    """
    for name, kind in message.get_fields_and_field_types().items():
        found = next((end for end in UNITS if name + end in values), None)
        if found is None:
            continue
        value = values[name + found]
        if kind == "double":
            value = math.nan if value is None else UNITS[found] * value
        elif "/" in kind and (value is None or isinstance(value, dict)):
            value = fill(getattr(message, name), value or {})
        elif kind == "string":
            value = value or ""
        setattr(message, name, value)
    return message


def slip_values(rotation: dict[str, Any] | None, header: Header, number: int = 0) -> dict[str, Any]:
    """Return the values of a SlipEstimate. rotation: the estimate of both fingers, as the daemon reports it."""
    values = {"rotation_deg": None, "sigma_deg": None, "rate_deg_s": None, "shift_mm": None, **(rotation or {})}
    values |= {"header": header, "number": number, "valid": values["rotation_deg"] is not None}
    return values if rotation else values | {"declined": "no fresh frames"}


def state_values(state: dict[str, Any], stamps: Stamps) -> dict[str, Any]:
    """Return the values of a State. state: the daemon's complete state."""
    header, rotation = stamps.header(state["now_s"], "grasp"), state["rotation"]
    gripper = state["gripper"] or {"force_n": None, "width_mm": None, "holding": False}
    captured = stamps.header(rotation["captured_at_s"], "grasp") if rotation else header
    slip = slip_values(rotation, captured)
    limit = {"force_max_n": state["limits"]["force_max_n"]}
    return {**gripper, **state, **limit, "header": header, "slip": slip}


def image_message(image: GelImage, header: Header) -> Image:
    """Return a gel image."""
    message = Image(header=header, height=image.height_px, width=image.width_px, encoding="bgr8", is_bigendian=0)
    message.step = 3 * image.width_px
    pixels = array.array("B")
    pixels.frombytes(image.pixels)  # one copy; array.array("B", image.pixels) takes each of 230,400 bytes by itself
    message.data = pixels
    return message


def joint_message(gripper: dict[str, Any], joint: JawJoint, header: Header) -> JointState:
    """Return position (see `JawJoint`) and force per finger of the jaws."""
    position, effort = joint.position(gripper["width_mm"]), float(gripper["force_n"])
    return JointState(header=header, name=[joint.name], position=[position], effort=[effort])


def force_message(gripper: dict[str, Any], header: Header) -> WrenchStamped:
    """Return the force that each finger applies to the object, along z."""
    message = WrenchStamped(header=header)
    message.wrench.force.z = float(gripper["force_n"])
    return message


def rotation_message(rotation: dict[str, Any], header: Header) -> PoseWithCovarianceStamped:
    """Return a valid rotation about z and its variance; -1 is the variance of what is not measured."""
    message, half_rad = PoseWithCovarianceStamped(header=header), math.radians(rotation["rotation_deg"]) / 2.0
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(half_rad), math.cos(half_rad)
    message.pose.covariance[list(NOT_MEASURED)] = -1.0
    message.pose.covariance[ROTATION_ABOUT_Z] = math.radians(rotation["sigma_deg"]) ** 2
    return message


def diagnostics_message(state: dict[str, Any] | None, lost: str, header: Header) -> DiagnosticArray:
    """Return the status of guard and devices. lost: why there is no state."""
    if state is None:
        return DiagnosticArray(header=header, status=[_status("guard", DiagnosticStatus.ERROR, lost, {})])
    return DiagnosticArray(header=header, status=[_guard_status(state), *(_device_status(state))])


def _guard_status(state: dict[str, Any]) -> DiagnosticStatus:
    fault, waiting = state["fault"], state["waiting_for"]
    level, message = DiagnosticStatus.OK, f"{state['phase']}, {'guarding' if state['guarding'] else 'not guarding'}"
    if fault:
        level, message = DiagnosticStatus.ERROR, f"{fault['code']}: {fault['observed']}. {fault['what_to_do']}"
    elif waiting or state["config_problem"]:
        level, message = DiagnosticStatus.WARN, "; ".join(waiting) or state["config_problem"]
    elif state["stopped_by_request"]:
        message += ", stopped by request"
    latency_ms = (state["latency"] or {}).get("p99_ms")
    return _status("guard", level, message, {**state, "frame to decision p99 [ms]": latency_ms})


def _device_status(state: dict[str, Any]) -> list[DiagnosticStatus]:
    statuses = []
    for name, device in state["devices"].items():
        finger, round_trip = state["fingers"].get(name, {}), (state["round_trips"].get(name) or {}).get("p99_ms")
        values = {**finger, **finger.get("counts", {}), "round trip p99 [ms]": round_trip}
        level = DiagnosticStatus.OK if device["state"] == "ready" else DiagnosticStatus.ERROR
        statuses.append(_status(name, level, device["reason"] or device["state"], values))
    return statuses


def _status(name: str, level: bytes, message: str, values: dict[str, Any]) -> DiagnosticStatus:
    """Return a status with the values that are single numbers or texts."""
    pairs = [KeyValue(key=key, value=str(one)) for key, one in values.items() if isinstance(one, (str, int, float))]
    serial = str(values.get("serial") or "slipguard")
    return DiagnosticStatus(level=level, name=f"slipguard: {name}", message=message, hardware_id=serial, values=pairs)
