"""Permanent marks on a gel are found; drifting light, a shifted image and noise are not reported as marks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slipguard.datasets.background_patterns import drift
from slipguard.perception.background import GelChange, compare_gel
from slipguard.sim.sensor_unit import background_image, random_unit

NOISE_BGR = (2.9, 1.5, 2.4)


FRAMES = 30


UNITS = range(6)


def gel(seed: int) -> np.ndarray:
    return background_image(random_unit(np.random.default_rng(seed)))


def dusty(seed: int) -> np.ndarray:
    """A gel with specks that have always been there."""
    rng, image = np.random.default_rng(seed), gel(seed).astype(np.float64)
    for x, y in rng.uniform(20.0, 220.0, (8, 2)):
        image = spotted(image, float(rng.choice([-45.0, 45.0])), 2, at=(round(x), round(y)))
    return np.rint(image).astype(np.uint8)


def averaged(rng: np.random.Generator, frame_image: np.ndarray, frames: int = FRAMES) -> np.ndarray:
    """The mean of noisy frames; neighbouring pixels share some of their noise, as the sensor's do."""
    noise = cv2.GaussianBlur(rng.normal(0.0, 1.0, frame_image.shape).astype(np.float32), (0, 0), 0.6)
    noisy = frame_image + noise / noise.std() * np.asarray(NOISE_BGR) / np.sqrt(frames)
    return np.clip(noisy, 0, 255).astype(np.float32)


def drifted(rng: np.random.Generator, frame_image: np.ndarray, levels: float) -> np.ndarray:
    """Lamp edges crept, streaks, columns, another gain and level."""
    pattern = cv2.resize(drift(rng), (240, 320)) * levels
    return np.clip(
        frame_image * (1.0 + rng.normal(0.0, 0.003 * levels)) + pattern + rng.normal(0.0, 0.4 * levels, 3), 0, 255
    )


def moved(frame_image: np.ndarray, x_px: float, y_px: float) -> np.ndarray:
    matrix = np.array([[1.0, 0.0, x_px], [0.0, 1.0, y_px]])
    return cv2.warpAffine(frame_image.astype(np.float32), matrix, (240, 320), borderMode=cv2.BORDER_REPLICATE)


def spotted(frame_image: np.ndarray, levels: float, radius_px: int, at: tuple[int, int] = (100, 200)) -> np.ndarray:
    spot = np.zeros((320, 240), np.float32)
    cv2.circle(spot, at, radius_px, 1.0, -1, cv2.LINE_AA)
    return np.clip(frame_image + levels * cv2.GaussianBlur(spot, (0, 0), 0.8)[..., None], 0, 255)


def scratched(frame_image: np.ndarray, levels: float, end: tuple[int, int] = (160, 220)) -> np.ndarray:
    line = np.zeros((320, 240), np.float32)
    cv2.line(line, (130, 190), end, 1.0, 2, cv2.LINE_AA)
    return np.clip(frame_image + levels * cv2.GaussianBlur(line, (0, 0), 0.8)[..., None], 0, 255)


def compared(now: np.ndarray, known: np.ndarray, frames: int = FRAMES) -> GelChange:
    return compare_gel(now.astype(np.float32), frames, known, NOISE_BGR, 30)


@pytest.mark.parametrize("seed", UNITS)
def test_an_unchanged_gel_shows_no_change(seed: int) -> None:
    rng, known = np.random.default_rng(seed), gel(seed)
    change = compared(averaged(rng, known), known)
    assert change.marks == ()
    assert max(abs(level) for level in change.level_bgr) < 0.2
    assert change.uneven_levels < 0.2


@pytest.mark.parametrize("seed", UNITS)
def test_drifting_light_and_a_shifted_image_are_no_marks(seed: int) -> None:
    rng, known = np.random.default_rng(seed), gel(seed)
    for levels in (3.0, 6.0, 10.0):
        now = moved(drifted(rng, known, levels), *rng.uniform(-1.0, 1.0, 2))
        assert compared(averaged(rng, now), known).marked_px <= 30, levels


@pytest.mark.parametrize("gain", [0.65, 1.5])
def test_other_led_settings_are_no_wear(gain: float) -> None:
    for seed in UNITS:
        known = np.clip(dusty(seed), 10, 165)
        lit = known * np.array([gain, 1.0, gain])
        assert compared(averaged(np.random.default_rng(seed), lit), known).marks == (), seed


def test_specks_that_move_with_the_image_are_no_wear() -> None:
    for seed in UNITS:
        rng, known = np.random.default_rng(seed), dusty(seed)
        now = moved(known, *rng.choice([-1.2, 1.2], 2))
        assert compared(averaged(rng, now), known).marked_px <= 30, seed


@pytest.mark.parametrize("seed", UNITS)
def test_marks_are_located_in_drifted_light(seed: int) -> None:
    rng, known = np.random.default_rng(seed), gel(seed)
    lit = moved(drifted(rng, known, 5.0), 0.6, -0.4)
    change = compared(averaged(rng, spotted(lit, -35.0, 6)), known)
    assert change.marks
    strongest = change.marks[0]
    assert (strongest.x_px, strongest.y_px) == (pytest.approx(100, abs=7), pytest.approx(200, abs=7))
    assert change.marked_px >= 40
    assert compared(averaged(rng, scratched(lit, 25.0)), known).marked_px >= 40


def test_more_wear_is_reported_as_a_larger_area() -> None:
    rng, known = np.random.default_rng(1), gel(1)
    areas = [
        compared(averaged(rng, scratched(known, 25.0, (130 + size, 190))), known).marked_px for size in (8, 25, 60)
    ]
    assert 0 < areas[0] < areas[1] < areas[2]
    heights = [compared(averaged(rng, spotted(known, levels, 5)), known).marks[0].levels for levels in (15, 30, 60)]
    assert heights == sorted(heights)


def test_a_change_of_light_is_reported_in_gray_levels() -> None:
    rng, known = np.random.default_rng(2), np.clip(gel(2), 20, 200)
    change = compared(averaged(rng, known + np.array([5.0, -3.0, 0.0])), known)
    assert change.level_bgr == pytest.approx((5.0, -3.0, 0.0), abs=0.2)
    assert change.uneven_levels < 0.3
    slope = np.linspace(-8.0, 8.0, 240)[None, :, None]
    tilted = compared(averaged(rng, known + slope), known)
    assert tilted.uneven_levels == pytest.approx(8.0 / np.sqrt(3.0), abs=0.7)


@pytest.mark.real
def test_real_units_without_contact_have_no_marks(real_data: Path) -> None:
    """Six units as they are, drifted and moved; and the gel around 60 real presses of two units."""
    rng = np.random.default_rng(0)
    for path in sorted((real_data / "backgrounds").glob("*.png")):
        known = cv2.imread(str(path))
        now = averaged(rng, moved(drifted(rng, known, 8.0), 0.7, -0.5))
        assert compared(now, known).marked_px <= 30, path.name
        assert compared(averaged(rng, spotted(now, 35.0, 6)), known).marked_px >= 40, path.name
    for frame, mask, known in beside_presses(real_data):
        outside = np.where(cv2.dilate(mask, np.ones((41, 41), np.uint8))[..., None] > 0, known, frame)
        assert compared(outside, known, frames=1).marks == ()


def beside_presses(real_data: Path):  # type: ignore[no-untyped-def]
    """Frame, contact and background image of each press."""
    folder = real_data / "anytouch2_force2"
    known = cv2.imread(str(folder / "background.png"))
    for path in sorted((folder / "frames").glob("*.png"))[::2]:
        yield cv2.imread(str(path)), cv2.imread(str(folder / "masks" / path.name), 0), known
    folder = real_data / "taxim_sphere"
    known = cv2.imread(str(folder / "background.png"))
    rows = (folder / "circles.csv").read_text().splitlines()[1:]
    for name, x, y, radius in (row.split(",")[:4] for row in rows):
        mask = np.zeros((320, 240), np.uint8)
        cv2.circle(mask, (round(float(x)), round(float(y))), round(float(radius)) + 5, 1, -1)
        yield cv2.imread(str(folder / name)), mask, known
