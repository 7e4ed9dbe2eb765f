"""What the daemon's state says, as numbers in SI units and radians. Does not need ROS."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Any

FRAME_HEADER = struct.Struct("<4sHHIdQ")
FRAME_MAGIC = b"SGF1"
OK, WARN, ERROR = 0, 1, 2
"""Levels of diagnostic_msgs/DiagnosticStatus."""


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


@dataclass(frozen=True)
class RotationReading:
    """Rotation of the held object since the grasp, and one standard deviation of its error."""

    rotation_rad: float
    sigma_rad: float


@dataclass(frozen=True)
class GelImage:
    """One captured frame. pixels: rows from top to bottom, B, G, R for each pixel."""

    width_px: int
    height_px: int
    captured_at_s: float
    sequence: int
    pixels: memoryview


def parse_frame(message: bytearray) -> GelImage:
    """Return the frame in a message of the stream `/frames/{finger}`. Raises ValueError if it is not one."""
    if len(message) < FRAME_HEADER.size:
        raise ValueError(f"a message of {len(message)} bytes is not a frame")
    magic, width, height, size, captured_at_s, sequence = FRAME_HEADER.unpack_from(message)
    pixels = memoryview(message)[FRAME_HEADER.size :]
    if magic != FRAME_MAGIC or len(pixels) != size or size != 3 * width * height:
        raise ValueError(f"{magic!r}, {width} x {height} pixels in {len(pixels)} bytes is not a frame")
    return GelImage(width, height, captured_at_s, sequence, pixels)


def rotation_of(state: dict[str, Any]) -> RotationReading | None:
    """Return the rotation; None while there is no estimate."""
    rotation = state.get("rotation") or {}
    rotation_deg, sigma_deg = rotation.get("rotation_deg"), rotation.get("sigma_deg")
    if rotation_deg is None or sigma_deg is None:
        return None
    return RotationReading(math.radians(rotation_deg), math.radians(sigma_deg))


@dataclass(frozen=True)
class DeviceStatus:
    """One status of `/diagnostics`."""

    name: str
    level: int
    message: str
    values: dict[str, str]


def unreachable_status(reason: str) -> list[DeviceStatus]:
    """Return the statuses while no daemon responds."""
    return [DeviceStatus("guard", ERROR, reason, {})]


def device_statuses(state: dict[str, Any]) -> list[DeviceStatus]:
    """Return the status of the guard and of each device."""
    return [_guard_status(state), *(_device_status(name, state) for name in state.get("devices", {}))]


def _guard_status(state: dict[str, Any]) -> DeviceStatus:
    fault, waiting = state.get("fault"), state.get("waiting_for") or []
    if fault:
        level, message = ERROR, f"{fault['code']}: {fault['observed']}. {fault['what_to_do']}"
    elif waiting or state.get("config_problem"):
        level, message = WARN, "; ".join(waiting) or str(state["config_problem"])
    else:
        level, message = OK, f"{state.get('phase')}, {'guarding' if state.get('guarding') else 'not guarding'}"
        message += ", stopped by request" if state.get("stopped_by_request") else ""
    latency = state.get("latency") or {}
    return DeviceStatus(
        "guard",
        level,
        message,
        {
            "version": str(state.get("version")),
            "phase": str(state.get("phase")),
            "mode": str(state.get("mode")),
            "slipping": str(state.get("slipping")),
            "target force [N]": f"{state.get('target_force_n', 0.0):.1f}",
            "frame to decision p99 [ms]": str(latency.get("p99_ms")),
            "deadlines missed": str(state.get("deadlines_missed")),
        },
    )


def _device_status(name: str, state: dict[str, Any]) -> DeviceStatus:
    device = state["devices"][name]
    ready = device.get("state") == "ready"
    values: dict[str, str] = {}
    finger = (state.get("fingers") or {}).get(name)
    if finger:
        values = {"serial": str(finger.get("serial")), "frames per second": f"{finger.get('frames_per_s') or 0.0:.1f}"}
        values |= {key: str(value) for key, value in (finger.get("counts") or {}).items()}
    round_trip = (state.get("round_trips") or {}).get(name)
    if round_trip:
        values["round trip p99 [ms]"] = str(round_trip["p99_ms"])
    message = "ready" if ready else device.get("reason") or str(device.get("state"))
    return DeviceStatus(name, OK if ready else ERROR, message, values)
