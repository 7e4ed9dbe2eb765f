"""`slipguard calibrate` with a served daemon: take, show, plot and restore background images."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Ran, slipguard
from fake_daemon_api import FakeDaemonApi, served

from slipguard.daemon.api.requests import CalibrateRequest, DaemonRequest, RestoreBackgroundRequest
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir

CONFIG = Path(__file__).parents[3] / "config.toml"


@pytest.fixture
def daemon() -> FakeDaemonApi:
    return FakeDaemonApi()


async def calibrate(capfd: pytest.CaptureFixture[str], daemon: FakeDaemonApi, folder: Path, *words: object) -> Ran:
    async with served(daemon, folder / "s") as path:
        line = ("calibrate", "--config", CONFIG, "--socket", path, *words)
        return await asyncio.to_thread(slipguard, capfd, *line)


@pytest.mark.parametrize(
    ("words", "submitted"),
    [
        ([], CalibrateRequest()),
        (["--force"], CalibrateRequest(force=True)),
        (["--new-gel"], CalibrateRequest(new_gel=True)),
        (["--back-to", "1", "--finger", "left"], RestoreBackgroundRequest(finger="left", number=1)),
    ],
)
async def test_the_request_reaches_the_daemon_and_stored_images_are_shown(
    words: list[str],
    submitted: DaemonRequest,
    daemon: FakeDaemonApi,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    ran = await calibrate(capfd, daemon, tmp_path, *words)
    assert (ran.code, ran.err) == (0, "")
    assert daemon.requests == [submitted]
    assert ran.out.count("2026-11-20 12:00") == 2  # the newest of each finger
    assert "2.9 1.5 2.4" in ran.out
    assert "+0.0 +0.0 +0.0" in ran.out


async def test_show_takes_no_images_and_shows_all(
    daemon: FakeDaemonApi, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    ran = await calibrate(capfd, daemon, tmp_path, "--show")
    assert ran.code == 0
    assert daemon.requests == []
    assert ran.out.count("2026-11-20 12:00") == 4
    assert "no images were taken" in ran.out


async def test_stored_images_are_plotted(
    daemon: FakeDaemonApi, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ran = await calibrate(capfd, daemon, tmp_path, "--plot", tmp_path / "gels.png")
    assert ran.code == 0, ran.err
    assert daemon.requests == []
    drawn = cv2.imread(str(tmp_path / "gels.png"))
    assert drawn is not None
    assert drawn.std() > 10


async def test_json_output_is_complete(
    daemon: FakeDaemonApi, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    received = json.loads((await calibrate(capfd, daemon, tmp_path, "--json")).out)
    assert set(received["fingers"]) == {"left", "right"}
    assert [one["number"] for one in received["stored"]["left"]["versions"]] == [1, 2]


def test_stored_images_are_shown_without_a_sensor(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    StateDir().save_background("D20479", BackgroundImage(np.full((320, 240, 3), 90, np.uint8), (1.0, 2.0, 3.0), 30))
    ran = slipguard(capfd, "calibrate", "--config", CONFIG, "--socket", tmp_path / "s", "--show")
    assert (ran.code, ran.err) == (0, "")
    assert "D20479" in ran.out
    assert "1.0 2.0 3.0" in ran.out
    assert "D20510" in ran.out


@pytest.mark.parametrize("words", [["--back-to", "2"], ["--finger", "left"]])
def test_back_to_needs_finger_and_the_reverse(words: list[str], capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd, "calibrate", "--config", CONFIG, *words)
    assert "go together, such as `--back-to 3 --finger left`" in ran.complaint
