"""The gel camera: the base class's methods, and what happens without new images."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from daemon_processes import Daemon, wait_until
from lerobot.cameras import Camera
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from PIL import Image

from lerobot_camera_slipguard import SlipguardCamera, SlipguardCameraConfig, StaleFrame
from slipguard_client import DaemonUnreachable


@pytest.fixture
def camera(daemon: Daemon) -> Iterator[Camera]:
    """The left gel, connected."""
    camera = make_cameras_from_configs({"gel": SlipguardCameraConfig(finger="left", socket=daemon.socket)})["gel"]
    assert isinstance(camera, SlipguardCamera), "made by its registered name"
    camera.connect()
    yield camera
    if camera.is_connected:
        camera.disconnect()


def test_images_are_new_rgb_and_as_captured(daemon: Daemon, camera: Camera) -> None:
    images = [camera.read(), camera.async_read(), camera.read_latest()]
    assert all(image.shape == (320, 240, 3) and image.dtype == np.uint8 for image in images)
    png = daemon.api.get("/frame/left")[0]
    reference = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(float)  # decoded by another library
    apart = [np.abs(reference - one.astype(float)).mean() for one in (images[2], images[2][..., ::-1])]
    assert apart[0] < 5.0 < apart[1], "red, green, blue"
    images[2][:] = 0
    assert camera.read_latest().any(), "a copy of its own"
    began_s = time.monotonic()
    for _ in range(20):
        camera.read_latest()
    assert time.monotonic() - began_s < 1.0, "read_latest does not wait"


def test_without_new_images_it_raises_and_recovers(daemon: Daemon, camera: Camera) -> None:
    daemon.stop()
    with pytest.raises(StaleFrame, match=r"no new image within 500 ms.*slipguard doctor"):
        wait_until(lambda: camera.read() is None, "the daemon has ended")
    with pytest.raises(StaleFrame, match=r"ms old, the limit is 500 ms"):
        camera.read_latest()
    assert SlipguardCamera.find_cameras(daemon.socket) == []
    daemon.start()
    wait_until(lambda: camera.async_read(5000.0).any(), "recovered")
    found = SlipguardCamera.find_cameras(daemon.socket)
    assert [(one["id"], one["type"], bool(one["serial"])) for one in found] == [
        ("left", "slipguard", True),
        ("right", "slipguard", True),
    ]


def test_connection_is_strict(camera: Camera) -> None:
    with pytest.raises(DeviceAlreadyConnectedError):
        camera.connect()
    before = threading.active_count()
    camera.disconnect()
    assert threading.active_count() < before
    for method in (camera.read, camera.async_read, camera.read_latest, camera.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            method()
    nowhere = SlipguardCamera(SlipguardCameraConfig(finger="left", socket="/nowhere/slipguard.sock"))
    with pytest.raises(DaemonUnreachable, match=r"/nowhere/slipguard.sock.*slipguard run"):
        nowhere.connect()
    assert not nowhere.is_connected


@pytest.mark.parametrize("wrong", [{"finger": "middle"}, {"width": 640}, {"max_age_ms": 0}])
def test_wrong_configurations_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=str(next(iter(wrong.values())))):
        SlipguardCameraConfig(**{"finger": "left"} | wrong)
