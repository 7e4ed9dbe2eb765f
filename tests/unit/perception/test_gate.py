"""The contact gate skips only frames without contact, under drifting light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slipguard.errors import FrameCorrupt
from slipguard.perception.skipping import DEFAULT_NOISE_BGR, ContactGate, block_means, check_frame

Image = NDArray[np.uint8]


def glow(seed: int = 0) -> NDArray[np.float64]:
    """A background image: three colored lobes."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-1:1:320j, -1:1:240j]
    return np.stack(
        [60 + 90 * np.exp(-2 * ((x - rng.uniform(-1, 1)) ** 2 + (y - rng.uniform(-1, 1)) ** 2)) for _ in range(3)],
        axis=-1,
    )


def camera(scene: NDArray[np.float64], rng: np.random.Generator) -> Image:
    """Noise as a DIGIT has it: 2.9, 1.5, 2.4 gray levels, neighbours correlated by 0.65."""
    noise = cv2.GaussianBlur(rng.standard_normal(scene.shape), (0, 0), 0.85)
    return np.clip(scene + noise / noise.std() * DEFAULT_NOISE_BGR, 0, 255).round().astype(np.uint8)


def press(scene: NDArray[np.float64], levels: float, radius_px: float, at: tuple[float, float]) -> NDArray[np.float64]:
    """A dent: bright on one side, dark on the other."""
    y, x = np.mgrid[0:320, 0:240]
    dx, dy = (x - at[0]) / radius_px, (y - at[1]) / radius_px
    slope = dx * np.exp(1 - dx * dx - dy * dy)
    return scene + (levels * slope)[..., None] * np.array([-1.0, 0.5, 1.0])


@given(st.integers(0, 10_000), st.floats(-6, 6), st.floats(-3, 3), st.floats(-3, 3))
def test_drift_of_the_light_is_no_contact(seed: int, level: float, right: float, down: float) -> None:
    rng = np.random.default_rng(seed)
    scene = glow(seed % 7)
    y, x = np.mgrid[-1:1:320j, -1:1:240j]
    drifted = scene + level * rng.uniform(0.5, 1.0, 3) + (right * x + down * y)[..., None]
    gate = ContactGate(scene.astype(np.uint8))
    assert not gate.may_be_contact(block_means(camera(drifted, rng)))


@given(st.integers(0, 10_000), st.floats(14, 60), st.floats(12, 70))
def test_a_press_passes_the_gate(seed: int, levels: float, radius_px: float) -> None:
    rng = np.random.default_rng(seed)
    scene = glow(seed % 7)
    at = (rng.uniform(20, 220), rng.uniform(20, 300))
    gate = ContactGate(scene.astype(np.uint8))
    assert gate.may_be_contact(block_means(camera(press(scene + 3.0, levels, radius_px, at), rng)))


def test_without_a_background_every_frame_may_be_contact() -> None:
    assert ContactGate(None).may_be_contact(block_means(glow().astype(np.uint8)))


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((240, 320, 3), np.uint8), "320×240"),
        (np.zeros((1, 1, 3), np.uint8), "1×1"),
        (np.zeros((320, 240, 4), np.uint8), "4 channels"),
        (np.zeros((320, 240), np.uint8), "expected uint8"),
        (np.full((320, 240, 3), np.nan, np.float32), "float32"),
        (np.zeros((320, 240, 3), np.uint16), "uint16"),
        (np.zeros((0, 0, 3), np.uint8), "0×0"),
        (None, "NoneType"),
    ],
)
def test_invalid_frames_are_rejected(image: Image, says: str) -> None:
    with pytest.raises(FrameCorrupt, match=says) as caught:
        block_means(image)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("level", "says"), [(0, "all black"), (255, "all white")])
def test_a_black_or_white_background_is_rejected(level: int, says: str) -> None:
    with pytest.raises(FrameCorrupt, match=says):
        ContactGate(np.full((320, 240, 3), level, np.uint8))


def test_a_good_frame_passes() -> None:
    check_frame(glow().astype(np.uint8))
    assert block_means(glow().astype(np.uint8)).shape == (1200, 3)


def test_invalid_noise_values_do_not_disable_the_gate() -> None:
    scene = glow()
    for noise in ((float("nan"),) * 3, (1e9, 1e9, 1e9), (0.0, 0.0, 0.0)):
        gate = ContactGate(scene.astype(np.uint8), noise)
        pressed = press(scene, 120, 40, (120, 160))
        assert gate.may_be_contact(block_means(np.clip(pressed, 0, 255).astype(np.uint8)))
