"""A DIGIT's image is rotated upright; an incomplete JPEG is never decoded to an image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipguard_drivers.digit.decoding import DamagedFrame, check_jpeg, decode_jpeg, decode_yuyv


def jpeg(width: int = 320, height: int = 240) -> bytes:
    rng = np.random.default_rng(4)
    smooth = cv2.GaussianBlur(rng.integers(0, 256, (height, width, 3), np.uint8), (0, 0), 8)
    return bytes(cv2.imencode(".jpg", smooth)[1].tobytes())


JPEG = jpeg()


def test_the_image_is_rotated_counter_clockwise() -> None:
    landscape = np.full((240, 320, 2), 128, np.uint8)
    landscape[:, :, 0] = 16
    landscape[:40, -40:, 0] = 235  # bright at the top right
    portrait = decode_yuyv(landscape.tobytes())
    assert portrait.shape == (320, 240, 3)
    assert portrait[:40, :40].min() > 250, "top right becomes top left"
    assert portrait[60:].max() < 5
    colour = cv2.cvtColor(landscape, cv2.COLOR_YUV2BGR_YUYV)
    assert np.array_equal(portrait, np.rot90(colour, 1))


def test_a_jpeg_is_rotated_like_yuyv() -> None:
    plain = cv2.imdecode(np.frombuffer(JPEG, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decode_jpeg(JPEG), np.rot90(plain, 1))
    assert np.array_equal(decode_jpeg(JPEG + bytes(500)), np.rot90(plain, 1)), "cameras fill up with zeros"


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "not a JPEG"),
        (b"no image at all", "not a JPEG"),
        (JPEG[:-2], "without its end"),
        (JPEG + b"more", "without its end"),
        (JPEG[: JPEG.index(b"\xff\xc0") + 6], "broken at byte"),
        (jpeg(640, 480), "640x480 instead of 320x240"),
        (b"\xff\xd8" + JPEG[JPEG.index(b"\xff\xda") :], "without its end"),
    ],
    ids=["nothing", "text", "cut off", "something behind", "cut in the header", "another size", "no header"],
)
def test_an_incomplete_image_is_reported(data: bytes, expected: str) -> None:
    with pytest.raises(DamagedFrame, match=expected):
        decode_jpeg(data)


@given(length=st.integers(0, len(JPEG) - 1))
@settings(max_examples=60, deadline=None)
def test_an_incomplete_jpeg_is_damaged(length: int) -> None:
    with pytest.raises(DamagedFrame):
        check_jpeg(JPEG[:length])


@given(data=st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_the_check_accepts_any_bytes(data: bytes) -> None:
    with pytest.raises(DamagedFrame):
        check_jpeg(b"\xff\xd8" + data)


def test_too_few_bytes_are_damaged() -> None:
    with pytest.raises(DamagedFrame, match="100 bytes instead of 153600"):
        decode_yuyv(bytes(100))
