"""Configuration of a gel camera, `--robot.cameras='{gel: {type: slipguard, finger: left}}'`."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.cameras import CameraConfig

FINGERS = ("left", "right")
WIDTH_PX, HEIGHT_PX = 240, 320


@CameraConfig.register_subclass("slipguard")
@dataclass(kw_only=True)
class SlipguardCameraConfig(CameraConfig):
    """finger: left or right.

    overlay: the image with contour and axis of the contact drawn over it, 10 per second; otherwise as it was captured.
    max_age_ms: reading raises StaleFrame if the newest image was captured earlier.
    socket: path of the daemon's Unix socket; empty for the daemon that runs on this machine.
    """

    finger: str
    overlay: bool = False
    max_age_ms: int = 500
    socket: str = ""
    fps: int | None = 60
    width: int | None = WIDTH_PX
    height: int | None = HEIGHT_PX

    def __post_init__(self) -> None:
        if self.finger not in FINGERS:
            raise ValueError(f"finger is {self.finger!r}; choose from: {', '.join(FINGERS)}")
        if (self.width, self.height) != (WIDTH_PX, HEIGHT_PX):
            raise ValueError(
                f"width x height is {self.width} x {self.height}; gel images have {WIDTH_PX} x {HEIGHT_PX} pixels"
            )
        if self.max_age_ms <= 0:
            raise ValueError(f"max_age_ms is {self.max_age_ms}; it must be above 0")
