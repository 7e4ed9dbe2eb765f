"""The gel camera: the base class's methods, and what happens without new images."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from daemon_processes import Daemon, EmulatedCell, wait_until
from lerobot.cameras import Camera
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from PIL import Image

from lerobot_camera_slipguard import SlipguardCamera, SlipguardCameraConfig, StaleFrame
from slipguard_client import DaemonUnreachable

SHAPE = (320, 240, 3)


@pytest.fixture
def camera(daemon: Daemon) -> Iterator[Camera]:
    """The left gel, connected."""
    yield from connected(daemon)


@pytest.fixture
def rendered(cell: EmulatedCell) -> Iterator[Camera]:
    """The left gel of the emulated cell, connected."""
    yield from connected(cell)


def connected(daemon: Daemon) -> Iterator[Camera]:
    camera = SlipguardCamera(SlipguardCameraConfig(finger="left", socket=daemon.socket))
    camera.connect()
    yield camera
    if camera.is_connected:
        camera.disconnect()


def as_rgb(png: bytes) -> np.ndarray[Any, Any]:
    return np.asarray(Image.open(BytesIO(png)).convert("RGB"))


def test_images_are_new_rgb_and_as_captured(cell: EmulatedCell, rendered: Camera) -> None:
    camera = rendered
    images = [camera.read(), camera.async_read(), camera.read_latest()]
    assert all(image.shape == SHAPE and image.dtype == np.uint8 for image in images)
    assert np.any(images[0] != images[1]), "each read waits for a new image: the camera's noise differs"
    reference = as_rgb(cell.api.get("/frame/left")[0])  # decoded by another library
    apart = [np.abs(reference - one.astype(float)).mean() for one in (images[2], images[2][..., ::-1])]
    assert apart[0] < 5.0 < apart[1], "red, green, blue"


def test_latest_is_immediate_and_its_own_copy(camera: Camera) -> None:
    began_s = time.monotonic()
    for _ in range(20):
        camera.read_latest()[:] = 0
    assert time.monotonic() - began_s < 1.0
    assert camera.read_latest().any()


def test_the_overlay_shows_the_contact(cell: EmulatedCell) -> None:
    config = SlipguardCameraConfig(finger="left", overlay=True, socket=cell.socket)
    cell.api.submit("gripper", {"width_mm": 0.0})
    try:
        cell.wait_for("reference", "holding")
        with SlipguardCamera(config) as drawn:
            assert drawn.read().shape == SHAPE
            wait_until(
                lambda: (drawn.read_latest() == (255, 230, 80)).all(axis=-1).any() or _marked(drawn), "a contour"
            )
    finally:
        cell.release()


def _marked(drawn: Camera) -> bool:
    """Return whether pixels have nearly the contour's color: JPEG changes it."""
    apart = np.abs(drawn.read_latest().astype(int) - (255, 230, 80)).max(axis=-1)
    return int((apart < 60).sum()) > 20


def test_a_stalled_sensor_raises_and_recovers(cell: EmulatedCell, rendered: Camera) -> None:
    camera = rendered
    cell.order("fault left.stall")
    try:
        wait_until(lambda: _is_stale(lambda: camera.read_latest(max_age_ms=300)), "stale")
        with pytest.raises(StaleFrame, match=r"no new image within 500 ms.*slipguard doctor"):
            camera.read()
        with pytest.raises(StaleFrame, match=r"ms old, the limit is 500 ms"):
            camera.read_latest()
    finally:
        cell.order("clear left.stall")
    wait_until(lambda: not _is_stale(camera.read_latest), "recovered")


def _is_stale(read: Any) -> bool:
    with contextlib.suppress(StaleFrame):
        read()
        return False
    return True


def test_find_cameras_lists_the_fingers(daemon: Daemon) -> None:
    found = SlipguardCamera.find_cameras(daemon.socket)
    assert [one["id"] for one in found] == ["left", "right"]
    assert all(one["type"] == "slipguard" and one["serial"] for one in found)
    assert SlipguardCamera.find_cameras("/nowhere/slipguard.sock") == []


def test_connection_is_strict(camera: Camera) -> None:
    with pytest.raises(DeviceAlreadyConnectedError):
        camera.connect()
    before = threading.active_count()
    camera.disconnect()
    assert not camera.is_connected
    assert threading.active_count() <= before
    for method in (camera.read, camera.async_read, camera.read_latest, camera.disconnect):
        with pytest.raises(DeviceNotConnectedError):
            method()


def test_without_a_daemon_the_error_says_what_to_do() -> None:
    camera = SlipguardCamera(SlipguardCameraConfig(finger="left", socket="/nowhere/slipguard.sock"))
    with pytest.raises(DaemonUnreachable, match=r"/nowhere/slipguard.sock.*slipguard run"):
        camera.connect()
    assert not camera.is_connected


@pytest.mark.parametrize("wrong", [{"finger": "middle"}, {"width": 640}, {"max_age_ms": 0}])
def test_wrong_configurations_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=str(next(iter(wrong.values())))):
        SlipguardCameraConfig(**{"finger": "left"} | wrong)


def test_lerobot_makes_it_by_its_registered_name(daemon: Daemon) -> None:
    made = make_cameras_from_configs({"gel": SlipguardCameraConfig(finger="right", socket=daemon.socket)})
    assert isinstance(made["gel"], SlipguardCamera)
