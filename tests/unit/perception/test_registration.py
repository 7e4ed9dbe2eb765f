"""Registration of drawn textures: known motions, equivariance, sigma; and the correlation over all rotations."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from slipguard.perception.estimate import DeclineReason
from slipguard.perception.gel_memory import ImprintMemory
from slipguard.perception.patch import Patch, find_patch
from slipguard.perception.registration import Ghost, Registration, TexturePose, register
from slipguard.perception.texture_map import ImageWindow, TextureMap
from slipguard.perception.texture_template import (
    STEP_DEG,
    TextureTemplate,
    correlation_curve,
    make_texture_template,
    maxima_deg,
    similar_deg,
)

CENTER = (59.5, 79.5)
WINDOW = ImageWindow(0, 0, 120, 160)
LEVELS = 10.0
Field = NDArray[np.float32]


def moved(image: Field, rotation_deg: float, shift: tuple[float, float] = (0.0, 0.0), scale: float = 1.0) -> Field:
    """Rotate an image counter-clockwise about its center, then shift it right and down."""
    matrix = cv2.getRotationMatrix2D(CENTER, rotation_deg, scale)
    matrix[:, 2] += shift
    return np.asarray(cv2.warpAffine(image, matrix, (120, 160), flags=cv2.INTER_CUBIC), np.float32)


def blobs(seed: int = 3, radius_px: float = 26.0) -> Field:
    """Smooth random curvature in a disc."""
    noise = np.random.default_rng(seed).standard_normal((160, 120)).astype(np.float32)
    image = np.asarray(cv2.GaussianBlur(noise, (0, 0), 3.0), np.float32)
    y, x = np.mgrid[0:160, 0:120]
    radius = np.hypot(x - CENTER[0], y - CENTER[1])
    return np.asarray(LEVELS * image / image.std() / (1.0 + np.exp(radius - radius_px)), np.float32)


def teeth(number: int) -> Field:
    """A rim with a number of teeth."""
    y, x = np.mgrid[0:160, 0:120].astype(np.float32)
    dx, dy = x - np.float32(CENTER[0]), np.float32(CENTER[1]) - y
    rim = np.exp(-((np.hypot(dx, dy) - 20.0) ** 2) / 30.0)
    return np.asarray(LEVELS * rim * np.cos(number * np.arctan2(dy, dx)), np.float32)


def disc_patch() -> Patch:
    y, x = np.mgrid[0:160, 0:120]
    patch = find_patch(np.asarray(np.hypot(x - CENTER[0], y - CENTER[1]) < 26.0, np.float32), 0.5, 100, 2.0)
    assert patch is not None
    return patch


def template_of(image: Field, noise: float = 0.0) -> TextureTemplate:
    template = make_texture_template(TextureMap(WINDOW, image, noise), disc_patch())
    assert template is not None
    return template


def noisy(image: Field, noise: float, seed: int = 1) -> TextureMap:
    white = np.random.default_rng([seed, 1]).standard_normal(image.shape).astype(np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), 1.0)
    return TextureMap(WINDOW, np.asarray(image + noise * smooth / smooth.std(), np.float32), noise)


def registered(image: Field, now: TextureMap, start_deg: float = 0.0) -> Registration:
    return register(template_of(image), now, TexturePose(start_deg))


@settings(max_examples=30)
@given(st.integers(0, 50), st.floats(-8, 8), st.floats(-3, 3), st.floats(-3, 3), st.floats(0.8, 1.3))
def test_a_known_motion_is_recovered(seed: int, rotation_deg: float, dx: float, dy: float, gain: float) -> None:
    image = blobs(seed)
    found = registered(image, noisy(np.float32(gain) * moved(image, rotation_deg, (dx, dy)), 0.3, seed))
    assert found.declined is None
    assert found.pose.rotation_deg == pytest.approx(rotation_deg, abs=0.3)
    assert (found.pose.dx_px, found.pose.dy_px) == pytest.approx((dx, dy), abs=0.15)
    assert found.pose.gain == pytest.approx(gain, rel=0.1)
    assert found.alike > 0.9
    assert abs(found.rotation_deg - rotation_deg) < 4.0 * found.sigma_deg + 0.05


def test_growth_is_no_rotation() -> None:
    image = blobs()
    found = registered(image, noisy(moved(image, 5.0, scale=1.08), 0.3))
    assert found.pose.rotation_deg == pytest.approx(5.0, abs=0.2)
    assert found.pose.scale == pytest.approx(1.08, abs=0.02)


@pytest.mark.parametrize("both_deg", [30.0, 90.0, -135.0])
def test_the_rotation_is_the_same_wherever_the_texture_lies(both_deg: float) -> None:
    image = blobs()
    upright = registered(image, TextureMap(WINDOW, moved(image, 6.0)))
    lying = registered(moved(image, both_deg), TextureMap(WINDOW, moved(image, both_deg + 6.0)))
    assert lying.pose.rotation_deg == pytest.approx(upright.pose.rotation_deg, abs=0.1)
    back = register(template_of(moved(image, 6.0)), TextureMap(WINDOW, image), TexturePose())
    assert back.pose.rotation_deg == pytest.approx(-upright.pose.rotation_deg, abs=0.1)


def test_sigma_grows_with_noise_and_covers_the_errors() -> None:
    image, sigmas = blobs(), []
    for noise in (0.3, 1.0, 3.0):
        found = [registered(image, noisy(moved(image, 4.0), noise, seed)) for seed in range(12)]
        assert all(one.declined is None for one in found)
        off = np.array([abs(one.rotation_deg - 4.0) / one.sigma_deg for one in found])
        assert off.max() < 4.0
        sigmas.append(float(np.median([one.sigma_deg for one in found])))
    assert sigmas[0] < sigmas[1] < sigmas[2]


def test_sigma_grows_if_the_middle_rotates_by_itself() -> None:
    image = blobs()
    y, x = np.mgrid[0:160, 0:120]
    middle = np.exp(-((x - CENTER[0]) ** 2 + (y - CENTER[1]) ** 2) / 14.0**2).astype(np.float32)
    sheared = middle * moved(image, 9.0) + (1 - middle) * moved(image, 3.0)
    rigid = registered(image, noisy(moved(image, 3.0), 0.3))
    twisted = registered(image, noisy(np.asarray(sheared, np.float32), 0.3))
    assert twisted.declined is not None or twisted.sigma_deg > 3.0 * rigid.sigma_deg


@pytest.mark.parametrize(
    ("now", "reason"),
    [
        (blobs(99), DeclineReason.CONTACT_CHANGED),
        (np.zeros((160, 120), np.float32), DeclineReason.CONTACT_CHANGED),
    ],
)
def test_another_texture_is_declined_with_finite_numbers(now: Field, reason: str) -> None:
    found = registered(blobs(), noisy(now, 0.5))
    assert found.declined is not None
    assert found.declined.startswith(reason)
    assert np.isfinite([found.pose.rotation_deg, found.sigma_deg, found.alike, found.information]).all()


def test_a_texture_that_has_left_the_image_is_declined() -> None:
    image = blobs()
    now = TextureMap(WINDOW, moved(image, 0.0, (62.0, 0.0)))
    found = register(template_of(image), now, TexturePose(dx_px=62.0))
    assert found.declined is not None
    assert found.declined.startswith(DeclineReason.CONTACT_CHANGED)


@given(st.integers(0, 20), st.floats(-8, 8))
@settings(max_examples=20)
def test_a_plain_dome_is_round(seed: int, rotation_deg: float) -> None:
    y, x = np.mgrid[0:160, 0:120]
    dome = LEVELS * np.exp(-((x - CENTER[0]) ** 2 + (y - CENTER[1]) ** 2) / 400.0)
    found = registered(noisy(np.asarray(dome, np.float32), 0.3, seed).curvature, noisy(dome.astype(np.float32), 0.3))
    assert found.declined is not None
    assert found.declined.startswith(DeclineReason.ROUND)


@pytest.mark.parametrize("number", [2, 3, 4, 6, 12])
def test_the_curve_of_a_gear_with_itself_shows_its_period(number: int) -> None:
    similar = sorted(similar_deg(template_of(teeth(number))))
    period_deg = 360.0 / number
    expected = [k * period_deg for k in range(-(number // 2), (number + 1) // 2) if k]
    assert [abs(one) for one in similar] == pytest.approx([abs(one) for one in expected], abs=2.0 * STEP_DEG)


def test_random_blobs_and_domes_are_similar_to_no_other_rotation() -> None:
    assert not similar_deg(template_of(blobs()))


@pytest.mark.parametrize("rotation_deg", [0.0, 44.0, -130.0, 178.0])
def test_the_curve_peaks_at_the_rotation_of_a_shifted_texture(rotation_deg: float) -> None:
    image = blobs()
    now = TextureMap(WINDOW, moved(image, rotation_deg, (5.0, -4.0)))
    curve = correlation_curve(template_of(image), now, (5.0, -4.0))
    assert curve.shape == (180,)
    assert -1.0 - 1e-5 <= curve.min() <= curve.max() <= 1.0 + 1e-5
    assert maxima_deg(curve, rotation_deg, 180.0)[0] == pytest.approx(rotation_deg, abs=STEP_DEG)


def test_maxima_are_those_near_a_rotation_within_reach() -> None:
    curve = correlation_curve(template_of(teeth(6)), TextureMap(WINDOW, moved(teeth(6), 10.0)), (0.0, 0.0))
    assert sorted(maxima_deg(curve, 0.0, 80.0)) == pytest.approx([-50.0, 10.0, 70.0], abs=STEP_DEG)
    assert sorted(maxima_deg(curve, 350.0, 80.0)) == pytest.approx([310.0, 370.0, 430.0], abs=STEP_DEG)
    assert maxima_deg(np.zeros(180, np.float32), 0.0, 180.0) == []


@pytest.mark.parametrize("share", [0.15, 0.3])
def test_a_part_of_the_texture_that_stays_in_place_is_found(share: float) -> None:
    image = blobs()
    for rotation_deg in (8.0, 12.0):
        now = np.asarray((1.0 - share) * moved(image, rotation_deg) + share * image, np.float32)
        ghost = registered(image, noisy(now, 0.3), rotation_deg).ghost
        assert ghost.shown
        assert ghost.share == pytest.approx(share / (1.0 - share), abs=0.1)
        clean = registered(image, noisy(moved(image, rotation_deg), 0.3), rotation_deg).ghost
        assert abs(clean.share) < 0.06


def test_memory_of_the_gel_is_corrected_once_it_is_certain() -> None:
    memory, ghost = ImprintMemory(), Ghost(0.3, 0.06, 5.0)
    first = memory.corrected(10.0, 0.1, ghost)
    assert first.rotation_deg == 10.0
    assert first.sigma_deg is not None
    assert first.sigma_deg > 0.4  # what memory that is only possible adds
    for _ in range(12):
        memory.update(ghost)
    corrected = memory.corrected(10.0, 0.1, ghost)
    assert memory.certain
    assert corrected.rotation_deg == pytest.approx(11.5, abs=0.05)
    assert corrected.sigma_deg is not None
    assert 0.1 < corrected.sigma_deg < 0.6


def test_frames_that_cannot_show_memory_leave_it_uncertain() -> None:
    memory = ImprintMemory()
    memory.update(Ghost(5.0, 1e6, 0.0, shown=False))
    assert memory.share == pytest.approx(0.0, abs=1e-6)
    for _ in range(60):
        memory.update(Ghost(1.1, 0.05, 0.1, shown=False))
    assert not memory.certain
    for _ in range(12):
        memory.update(Ghost(0.9, 0.05, 5.0))
    assert memory.certain
