"""Missing frames are reported: those that the camera did not deliver, and those that this machine did not read."""

from __future__ import annotations

import pytest

from slipguard_drivers.digit.rate_monitor import FrameRateMonitor


def watched(asked_fps: float, made_fps: float, taken_share: float = 1.0, frames: int = 400) -> FrameRateMonitor:
    watch = FrameRateMonitor(asked_fps)
    for number in range(frames):
        if number * taken_share % 1.0 < taken_share:
            watch.note(5.0 + number / made_fps, number)
    return watch


@pytest.mark.parametrize(
    ("made_fps", "taken_share", "expected"),
    [
        (60.0, 1.0, None),
        (58.0, 0.95, None),
        (44.8, 1.0, "the camera delivers only 45 of 60 frames per second"),
        (60.0, 0.5, "only 30 of 60 frames per second are read: this machine is too busy"),
        (30.0, 0.5, "the camera delivers only"),
    ],
)
def test_missing_frames_are_reported(made_fps: float, taken_share: float, expected: str | None) -> None:
    remark = watched(60.0, made_fps, taken_share).remark
    assert remark is None if expected is None else remark is not None and expected in remark


def test_before_the_end_of_the_first_window_there_is_no_remark() -> None:
    assert watched(60.0, 20.0, frames=30).remark is None


def test_a_remark_ends_when_the_frames_return() -> None:
    watch = watched(60.0, 20.0)
    assert watch.remark is not None
    for number in range(500):
        watch.note(30.0 + number / 60.0, 1000 + number)
    assert watch.remark is None


def test_a_restarted_camera_restarts_the_measurement() -> None:
    watch = watched(60.0, 60.0)
    for number in range(200):
        watch.note(100.0 + number / 60.0, number)
    assert watch.remark is None
