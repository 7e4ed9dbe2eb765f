"""LeRobot camera `slipguard`: the gel image of one finger, `--robot.cameras='{gel: {type: slipguard, ...}}'`."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from slipguard_client import FINGERS, DaemonUnreachable, LocalApi, RequestRefused, StreamThread, parse_frame

WIDTH_PX, HEIGHT_PX = 240, 320
FIRST_FRAME_TIMEOUT_S = 5.0
log = logging.getLogger(__name__)


@CameraConfig.register_subclass("slipguard")
@dataclass(kw_only=True)
class SlipguardCameraConfig(CameraConfig):
    """finger: left or right.

    max_age_ms: reading raises StaleFrame if the newest image was captured earlier.
    socket: path of the daemon's Unix socket; empty for the daemon that runs on this machine.
    """

    finger: str
    max_age_ms: int = 500
    socket: str = ""
    fps: int | None = 60
    width: int | None = WIDTH_PX
    height: int | None = HEIGHT_PX

    def __post_init__(self) -> None:
        if self.finger not in FINGERS:
            raise ValueError(f"finger is {self.finger!r}; choose from: {', '.join(FINGERS)}")
        if (self.width, self.height) != (WIDTH_PX, HEIGHT_PX):
            size = f"{self.width} x {self.height}"
            raise ValueError(f"width x height is {size}; gel images have {WIDTH_PX} x {HEIGHT_PX} pixels")
        if self.max_age_ms <= 0:
            raise ValueError(f"max_age_ms is {self.max_age_ms}; it must be above 0")


class StaleFrame(TimeoutError):
    """No image is new enough; str() says how old the newest is, and why."""


class SlipguardCamera(Camera):
    """Reads images in a thread; after a loss of the daemon it connects again by itself."""

    def __init__(self, config: SlipguardCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._changed = threading.Condition()
        self._newest: tuple[NDArray[np.uint8], float] | None = None
        """Image and time of capture, on this machine's monotonic clock."""
        self._returned: tuple[NDArray[np.uint8], float] | None = None
        self._problem: str | None = None
        self._reader: StreamThread | None = None

    def __str__(self) -> str:
        return f"gel camera {self.config.finger}"

    @property
    def is_connected(self) -> bool:
        """Whether `connect` succeeded and `disconnect` was not called since."""
        return self._reader is not None

    @staticmethod
    def find_cameras(socket: str = "") -> list[dict[str, Any]]:
        """Return both fingers of a running daemon; an empty list if no daemon responds."""
        try:
            fingers = LocalApi(socket).state()["fingers"]
        except (DaemonUnreachable, RequestRefused) as why:
            log.warning("%s", why)
            return []
        profile = {"format": "RGB", "width": WIDTH_PX, "height": HEIGHT_PX}
        return [
            {
                "name": f"slipguard {name}",
                "type": "slipguard",
                "id": name,
                "serial": fingers[name]["serial"],
                "default_stream_profile": profile | {"fps": fingers[name]["frames_per_s"]},
            }
            for name in FINGERS
        ]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Connect to the daemon; with `warmup`, wait for the first image.

        Raises:
            DaemonUnreachable: a ConnectionError; no daemon responds.
            StaleFrame: The daemon has no new image of this finger.
        """
        api = LocalApi(self.config.socket)
        device = api.state()["devices"][self.config.finger]
        if warmup and device["state"] != "ready":
            raise StaleFrame(f"{self}: the sensor is not ready: {device['reason']}. See `slipguard doctor`.")
        self._newest = self._returned = self._problem = None
        self._reader = StreamThread(api, f"/frames/{self.config.finger}", self._on_frame, self._on_lost)
        try:
            if warmup:
                self.async_read(1000.0 * FIRST_FRAME_TIMEOUT_S)
        except StaleFrame:
            self.disconnect()
            raise

    def read(self) -> NDArray[Any]:
        """Wait for the next image and return it, (320, 240, 3) uint8 RGB. Raises StaleFrame."""
        with self._changed:
            self._returned = self._newest
        return self.async_read(self.config.max_age_ms)

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """Return the newest image that was not returned before, (320, 240, 3) uint8 RGB; wait for it if necessary.

        Raises:
            StaleFrame: No such image arrived within `timeout_ms`, or it is older than the configured `max_age_ms`.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._newest is not self._returned, timeout_ms / 1000.0):
                raise self._stale(f"no new image within {timeout_ms:g} ms")
            self._returned = self._newest
        return self._checked(self.config.max_age_ms)

    @check_if_not_connected
    def read_latest(self, max_age_ms: int | None = None) -> NDArray[Any]:
        """Return the newest image at once, also if it was returned before.

        Raises:
            StaleFrame: The image was captured more than `max_age_ms` ago; by default that of the configuration.
            RuntimeError: No image has arrived since `connect`.
        """
        if self._newest is None:
            raise RuntimeError(f"{self}: no image yet{self._why()}")
        return self._checked(self.config.max_age_ms if max_age_ms is None else max_age_ms)

    @check_if_not_connected
    def disconnect(self) -> None:
        """End the stream; the sensor and the guard are not affected. Raises DeviceNotConnectedError."""
        reader, self._reader = self._reader, None
        assert reader is not None
        reader.stop()

    def _checked(self, max_age_ms: float) -> NDArray[np.uint8]:
        """Return the newest image if it is new enough: its age counts from its capture."""
        assert self._newest is not None
        rgb, captured_at_s = self._newest
        age_ms = 1000.0 * (time.monotonic() - captured_at_s)
        if age_ms > max_age_ms:
            raise self._stale(f"the newest image is {age_ms:.0f} ms old, the limit is {max_age_ms:g} ms")
        return rgb.copy()

    def _stale(self, what: str) -> StaleFrame:
        return StaleFrame(f"{self}: {what}{self._why()}. Check the sensor with `slipguard doctor`.")

    def _why(self) -> str:
        return f" ({self._problem})" if self._problem else ""

    def _on_frame(self, message: bytearray) -> None:
        frame = parse_frame(message)
        bgr = np.frombuffer(frame.pixels, np.uint8).reshape(frame.height_px, frame.width_px, 3)
        with self._changed:
            self._newest, self._problem = (np.ascontiguousarray(bgr[..., ::-1]), frame.captured_at_s), None
            self._changed.notify_all()

    def _on_lost(self, why: str) -> None:
        if why != self._problem:
            log.warning("%s: %s", self, why)
        self._problem = why
