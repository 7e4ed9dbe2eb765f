"""Recording a data set: frames with proposed labels, from a running daemon or from the sensor itself."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slipguard
from fake_daemon_api import FakeDaemonApi, served
from numpy.typing import NDArray
from pipe_capture import PipeCapture, delivery, found

from slipguard.daemon.api.client import Client
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.datasets import recorder as dataset_record
from slipguard.datasets.recorder import (
    SensorImage,
    daemon_reader,
    images_of,
    opened,
    propose_mask,
    record_dataset,
    sensor_reader,
)
from slipguard.devices import DriverContext, Frame
from slipguard.errors import CommandRefused, DeviceLost
from slipguard.perception.segmenter import Segmenter
from slipguard.sim.contact_label import label
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import LightChange, random_unit
from slipguard.tools.waiting import wait_until
from slipguard_drivers.digit.camera import DigitSensor


def overlap(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float((one & other).sum() / max((one | other).sum(), 1))


@pytest.mark.parametrize("name", ["bar", "key"])
def test_the_proposed_mask_is_a_useful_start(name: str) -> None:
    camera = GelCamera(random_unit(np.random.default_rng(3)), seed=1)
    truth = camera.draw_with_truth(GelView(name, angle_deg=40.0, depth_mm=0.6))
    assert overlap(propose_mask(Segmenter(), truth.image, camera.no_contact()), label(truth)) > 0.85


@pytest.mark.parametrize("light", [LightChange(), LightChange(offset_bgr=(6.0, -5.0, 4.0), tilt_bgr=(5.0, -4.0, 6.0))])
def test_an_untouched_gel_has_no_proposal_under_any_light_change(light: LightChange) -> None:
    camera = GelCamera(random_unit(np.random.default_rng(3)), seed=1)
    camera.set_light(light)
    assert not propose_mask(Segmenter(), camera.draw(GelView("bar")), camera.no_contact()).any()


async def two_shots() -> AsyncIterator[SensorImage]:
    camera = GelCamera(random_unit(np.random.default_rng(3)), seed=1)
    yield SensorImage("D20001", camera.draw(GelView("bar")), 7)
    yield SensorImage("D20001", camera.draw(GelView("bar", depth_mm=0.6)), 19)


async def test_a_recording_is_a_data_set(tmp_path: Path) -> None:
    background = GelCamera(random_unit(np.random.default_rng(3))).no_contact()
    touched = await record_dataset(tmp_path / "set", two_shots(), 2, {"D20001": background})
    assert touched == 1
    lines = [json.loads(line) for line in (tmp_path / "set" / "manifest.jsonl").read_text().splitlines()]
    assert [(line["serial"], line["sequence"], line["has_contact"]) for line in lines] == [
        ("D20001", 7, False),
        ("D20001", 19, True),
    ]
    for line in lines:
        image, under, mask = (
            cv2.imread(str(tmp_path / "set" / kind / line["file"])) for kind in ("images", "backgrounds", "masks")
        )
        assert image.shape == (320, 240, 3)
        assert np.array_equal(under, background)
        assert set(np.unique(mask)) <= {0, 255}
        assert (mask.max() > 0) == line["has_contact"]


async def test_a_daemon_is_asked_finger_by_finger(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with served(daemon, tmp_path / "s") as path:
        with Client(path) as client:
            shots = images_of([daemon_reader(client, finger) for finger in ("left", "right")], 0.0)
            seen = [await anext(shots) for _ in range(4)]
            await shots.aclose()
    assert [one.serial for one in seen] == ["D20001", "D20002"] * 2
    assert len({one.image.tobytes() for one in seen}) == 4


async def test_a_finger_that_stays_away_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset_record, "NO_FRAME_TIMEOUT_S", 0.05)
    daemon = FakeDaemonApi()
    daemon.failure = CommandRefused("no frame of the left finger: unplugged")
    async with served(daemon, tmp_path / "s") as path:
        with Client(path) as client, pytest.raises(CommandRefused, match="unplugged"):
            await anext(images_of([daemon_reader(client, "left")], 0.01))


async def test_without_a_daemon_the_sensor_is_opened_and_closed() -> None:
    sensor = DigitSensor(DigitSensor.Settings(serial="D20001"), DriverContext("sensor"), found, PipeCapture)
    async with opened([sensor]):
        shots = images_of([sensor_reader(sensor)], 0.0)
        waiting = asyncio.ensure_future(anext(shots))
        await wait_until(None, lambda: sensor.mode is not None, 30.0, "it is not opened")
        PipeCapture.last.offer(delivery(1, damage="torn"), delivery(2))
        shot = await waiting
        assert (shot.serial, shot.sequence, shot.image.shape) == ("D20001", 2, (320, 240, 3))
        await shots.aclose()
    assert PipeCapture.last.closed
    with pytest.raises(DeviceLost):
        await sensor.next_frame()


CONFIG = """
[left]
driver = "replay"
[left.replay]
path = "{left}"
[right]
driver = "replay"
[right.replay]
path = "{right}"
[gripper]
driver = "fake"
[arm]
driver = "fake"
[state]
directory = "{state}"
"""


def test_the_command_records_both_fingers_of_a_configuration(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    camera = GelCamera(random_unit(np.random.default_rng(3)), seed=1)
    for number, finger in enumerate(("left", "right")):
        (tmp_path / finger).mkdir()
        for frame in range(4):
            view = GelView("bar", depth_mm=0.6 * number, angle_deg=frame)
            cv2.imwrite(str(tmp_path / finger / f"{frame}.png"), camera.draw(view))
    cv2.imwrite(str(tmp_path / "background.png"), camera.no_contact())
    places = {name: tmp_path / name for name in ("left", "right", "state")}
    (tmp_path / "config.toml").write_text(CONFIG.format(**places))
    options = ["--config", tmp_path / "config.toml", "--background", tmp_path / "background.png", "--every-s", "0"]
    ran = slipguard(capfd, "dataset", "record", "--out", tmp_path / "set", "--count", 6, *options)
    assert ran.code == 0, ran.err
    assert "6 frames" in ran.out
    assert "3 with contact" in ran.out
    assert len(list((tmp_path / "set" / "images").iterdir())) == 6


class LateSerialSensor:
    """A sensor that reads its serial number when it is opened, as the port allows."""

    Settings = DigitSensor.Settings

    def __init__(self, settings: object, context: DriverContext) -> None:
        self.serial = ""
        self.sequence = 0

    async def open(self) -> None:
        self.serial = "D30003"

    async def next_frame(self) -> Frame:
        self.sequence += 1
        await asyncio.sleep(0)
        return Frame(np.full((320, 240, 3), 90, np.uint8), 0.0, self.sequence)

    async def close(self) -> None:
        self.serial = ""


@pytest.mark.parametrize("stored", [True, False])
def test_a_serial_number_known_only_after_opening_is_used(
    stored: bool, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setattr("slipguard.registry.load_driver", lambda group, name: LateSerialSensor)
    if stored:
        gray = np.full((320, 240, 3), 90, np.uint8)
        StateDir(None).save_background("D30003", BackgroundImage(gray, (1.0, 1.0, 1.0), 30))
    out = tmp_path / "set"
    ran = slipguard(capfd, "dataset", "record", "--serial", "D1", "--out", out, "--count", 2, "--every-s", 0)
    if not stored:
        assert "has no background image of D30003" in ran.complaint
        return
    assert ran.code == 0, ran.err
    lines = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    assert [line["serial"] for line in lines] == ["D30003", "D30003"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "either --config config.toml or --serial"),
        (["--serial", "D 1"], "--serial"),
        (["--serial", "D99999", "--background", "nowhere.png"], "nowhere.png"),
        (["--serial", "D99999"], "has no background image of D99999"),
    ],
)
def test_misuse_is_one_line(
    arguments: list[str],
    expected: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    ran = slipguard(capfd, "dataset", "record", "--out", tmp_path / "set", *arguments)
    assert ran.code == 2
    assert expected in ran.complaint
    assert not (tmp_path / "set").exists()
