"""The stream of frames: the newest frame is returned, once; repetition and damage are reported."""

from __future__ import annotations

from collections.abc import Coroutine
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen
from slipguard.frame_stream import FROZEN_AFTER, FrameStream


def image(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (320, 240, 3), np.uint8)


def outcome(next_frame: Coroutine[Any, Any, Any]) -> int | type[DeviceError]:
    """The sequence number handed out, or the kind of failure."""

    async def ask() -> int | type[DeviceError]:
        try:
            return int((await next_frame).sequence)
        except DeviceError as error:
            return type(error)

    return run_virtual(ask())


def outcomes(stream: FrameStream, count: int) -> list[int | type[DeviceError]]:
    return [outcome(stream.next()) for _ in range(count)]


@pytest.fixture
def stream() -> FrameStream:
    return FrameStream("left", stall_s=0.25)


def test_the_newest_frame_wins_and_is_returned_once(stream: FrameStream) -> None:
    for sequence in (1, 2, 3):
        stream.put(image(sequence), 0.1 * sequence, sequence)
    assert outcomes(stream, 2) == [3, DeviceTimeout]


def test_a_frame_older_than_the_last_is_skipped(stream: FrameStream) -> None:
    stream.put(image(5), 0.5, 5)
    stream.put(image(4), 0.4, 4)
    assert outcomes(stream, 2) == [5, DeviceTimeout]


def test_a_duplicate_is_skipped(stream: FrameStream) -> None:
    stream.put(image(1), 0.1, 1)
    assert outcomes(stream, 1) == [1]
    stream.put(image(1), 0.2, 2)
    assert outcomes(stream, 1) == [DeviceTimeout]
    stream.put(image(2), 0.3, 3)
    assert outcomes(stream, 1) == [3]


def test_a_returned_frame_is_not_returned_again_after_a_skipped_one(stream: FrameStream) -> None:
    stream.put(image(1), 0.1, 1)
    assert outcomes(stream, 1) == [1]
    stream.put(image(2), 0.2, 2)
    stream.put(image(1), 0.3, 3)
    assert outcomes(stream, 2) == [2, DeviceTimeout]


@pytest.mark.parametrize("fresh_sequence", [True, False], ids=["same pixels", "same sequence number"])
def test_repetition_is_a_frozen_camera_until_something_changes(stream: FrameStream, fresh_sequence: bool) -> None:
    stream.put(image(1), 0.1, 1)
    for extra in range(1, FROZEN_AFTER + 1):
        stream.put(image(1 if fresh_sequence else 1 + extra), 0.1, 1 + extra * fresh_sequence)
    assert outcomes(stream, 1) == [FrameFrozen]
    stream.put(image(99), 1.0, 50)
    assert outcomes(stream, 1) == [50]


def test_damage_is_reported_once(stream: FrameStream) -> None:
    stream.damaged("half of it is missing")
    assert outcomes(stream, 2) == [FrameCorrupt, DeviceTimeout]


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((240, 320, 3), np.uint8), np.zeros((320, 240), np.uint8), np.zeros((320, 240, 3), np.uint16)],
    ids=["landscape", "gray", "16 bit"],
)
def test_an_image_of_another_type_is_damaged(stream: FrameStream, wrong: NDArray[Any]) -> None:
    stream.put(wrong, 0.1, 1)
    assert outcomes(stream, 1) == [FrameCorrupt]


def test_a_lost_camera_stays_lost(stream: FrameStream) -> None:
    stream.put(image(1), 0.1, 1)
    stream.lose("it was unplugged")
    stream.put(image(2), 0.2, 2)
    assert stream.lost
    assert outcomes(stream, 2) == [DeviceLost, DeviceLost]


def test_images_are_read_only(stream: FrameStream) -> None:
    stream.put(image(1), 0.1, 1)
    frame = run_virtual(stream.next())
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0, 0] = 1


@pytest.mark.parametrize("level", [0, 1, 255])
def test_a_black_or_white_camera_does_not_count_as_frozen(stream: FrameStream, level: int) -> None:
    """Its images have no noise in which they could differ; perception names the light."""
    for sequence in range(1, 8):
        stream.put(np.full((320, 240, 3), level, np.uint8), 0.1 * sequence, sequence)
        assert outcomes(stream, 1) == [sequence]
