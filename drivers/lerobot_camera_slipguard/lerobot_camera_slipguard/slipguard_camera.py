"""LeRobot camera `slipguard`: the gel image of one finger."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Generator
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from lerobot_camera_slipguard.config_slipguard_camera import FINGERS, HEIGHT_PX, WIDTH_PX, SlipguardCameraConfig
from lerobot_camera_slipguard.local_api import DaemonUnreachable, GelImage, LocalApi, RequestRefused

FIRST_FRAME_TIMEOUT_S = 5.0
OVERLAY_PERIOD_S = 0.1
"""The daemon draws the contact ten times per second."""
RETRY_S = 0.5
WAIT_S = 0.5
"""The reading thread notices a disconnect after this time at the latest."""
log = logging.getLogger(__name__)


class StaleFrame(TimeoutError):
    """No image is new enough; str() says how old the newest is, and why."""


class SlipguardCamera(Camera):
    """Reads images in a thread; after a loss of the daemon it connects again by itself."""

    def __init__(self, config: SlipguardCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._changed = threading.Condition()
        self._newest: GelImage | None = None
        self._returned: GelImage | None = None
        self._problem: str | None = None
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def __str__(self) -> str:
        return f"gel camera {self.config.finger}"

    @property
    def is_connected(self) -> bool:
        """Whether `connect` succeeded and `disconnect` was not called since."""
        return self._thread is not None

    @staticmethod
    def find_cameras(socket: str = "") -> list[dict[str, Any]]:
        """Return both fingers of a running daemon; an empty list if no daemon responds."""
        with LocalApi(socket) as api:
            try:
                fingers = api.state()["fingers"]
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
            if name in fingers
        ]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Connect to the daemon; with `warmup`, wait for the first image.

        Raises:
            DaemonUnreachable: a ConnectionError; no daemon responds.
            StaleFrame: The daemon has no new image of this finger.
        """
        with LocalApi(self.config.socket) as api:
            device = api.state()["devices"].get(self.config.finger, {})
            if warmup and device.get("state") != "ready":
                raise StaleFrame(f"{self}: the sensor is not ready: {device.get('reason')}. See `slipguard doctor`.")
        self._newest = self._returned = self._problem = None
        self._stopped.clear()
        self._thread = threading.Thread(target=self._run, name=str(self), daemon=True)
        self._thread.start()
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
            if not self._changed.wait_for(self._has_new_image, timeout_ms / 1000.0):
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

    def disconnect(self) -> None:
        """End the stream; the sensor and the guard are not affected. Raises DeviceNotConnectedError."""
        thread = self._stop_thread()
        if thread is not threading.current_thread():
            thread.join(timeout=5.0)

    @check_if_not_connected
    def _stop_thread(self) -> threading.Thread:
        thread, self._thread = self._thread, None
        assert thread is not None
        self._stopped.set()
        with self._changed:
            self._changed.notify_all()
        return thread

    def _has_new_image(self) -> bool:
        return self._newest is not self._returned and self._newest is not None

    def _checked(self, max_age_ms: float) -> NDArray[np.uint8]:
        """Return the newest image if it is new enough: its age counts from its capture."""
        newest = self._newest
        assert newest is not None
        age_ms = 1000.0 * (time.monotonic() - newest.captured_at_s)
        if age_ms > max_age_ms:
            raise self._stale(f"the newest image is {age_ms:.0f} ms old, the limit is {max_age_ms:g} ms")
        return newest.rgb.copy()

    def _stale(self, what: str) -> StaleFrame:
        return StaleFrame(f"{self}: {what}{self._why()}. Check the sensor with `slipguard doctor`.")

    def _why(self) -> str:
        return f" ({self._problem})" if self._problem else ""

    def _run(self) -> None:
        """Keep the newest image until disconnected."""
        while not self._stopped.is_set():
            try:
                with LocalApi(self.config.socket) as api:
                    source = self._overlays(api) if self.config.overlay else self._frames(api)
                    with contextlib.closing(source) as images:
                        for image in images:
                            self._set(image)
            except (DaemonUnreachable, RequestRefused) as why:
                if str(why) != self._problem:
                    log.warning("%s: %s", self, why)
                self._problem = str(why)
                self._stopped.wait(RETRY_S)

    def _set(self, image: GelImage) -> None:
        with self._changed:
            self._newest, self._problem = image, None
            self._changed.notify_all()

    def _frames(self, api: LocalApi) -> Generator[GelImage]:
        with contextlib.closing(api.frames(self.config.finger, WAIT_S)) as frames:
            for image in frames:
                if self._stopped.is_set():
                    return
                if image is not None:
                    yield image

    def _overlays(self, api: LocalApi) -> Generator[GelImage]:
        newest = -1
        while not self._stopped.wait(OVERLAY_PERIOD_S):
            image = api.overlay(self.config.finger)
            if image.sequence != newest:
                newest = image.sequence
                yield image
