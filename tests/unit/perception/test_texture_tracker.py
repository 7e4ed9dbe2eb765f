"""Tracking of a changing contact: a key image is used, its uncertainty counts, the reference returns."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.texture_map import ImageWindow, TextureMap, TextureMapReader
from slipguard.perception.rotation.texture_template import make_texture_template
from slipguard.perception.rotation.texture_tracker import TextureTracker, TrackedTexture
from slipguard.stress.textured_surfaces import (
    Heights,
    LedLights,
    Surface,
    contact_map,
    heights,
    lettered,
    plate,
    shaded_image,
)

BACKGROUND = np.full((320, 240, 3), 100, np.uint8)


NOISE = 2.0


NO_AXIS = RotationEstimate(None, None, "round contact")


def becoming(share: float) -> Surface:
    """Letters of which one more and more gives way to another object's edges, which rotate with them."""

    def surface(u: Heights, v: Heights) -> Heights:
        return np.asarray((1.0 - share) * lettered(u, v) + share * plate(u, v), np.float32)

    return surface


class Held:
    """One contact followed frame by frame. way_deg: how it lies at first."""

    def __init__(self, surface: Surface = lettered, way_deg: float = 15.0) -> None:
        self._way_deg = way_deg
        self._reader = TextureMapReader(BACKGROUND, (NOISE, NOISE, NOISE))
        self._frames = 0
        image, patch = self._shown(surface, 0.0, (120.0, 160.0))
        self._reader.learn(image, patch)
        texture = make_texture_template(self._reader.read(image, patch), patch)
        assert texture is not None
        self._track = TextureTracker(texture)
        self._last_deg = 0.0

    def see(self, surface: Surface, rotation_deg: float, at: tuple[float, float] = (120.0, 160.0)) -> TrackedTexture:
        image, patch = self._shown(surface, rotation_deg, at)
        found = self._track.track(self._reader.read(image, patch), patch, self._last_deg, NO_AXIS)
        self._last_deg = self._last_deg if found.rotation.rotation_deg is None else found.rotation.rotation_deg
        return found

    def _shown(self, surface: Surface, rotation_deg: float, at: tuple[float, float]) -> tuple[np.ndarray, Patch]:
        self._frames += 1
        height = heights(surface, self._way_deg + rotation_deg, at, 1.0)
        patch = find_patch(contact_map(height), 0.5, 100, 2.0)
        assert patch is not None
        return shaded_image(height, LedLights(), NOISE, np.random.default_rng(self._frames)), patch


def shaft(u: Heights, v: Heights) -> Heights:
    """Longer than the image, and the same all along."""
    away = np.maximum(np.abs(v) - 20, 0)
    return np.asarray(9.0 * np.exp(-away * away / 120.0) + 0.0 * u, np.float32)


SHARES = [0.05 * k for k in range(19)]


def test_a_changing_contact_is_tracked_further_by_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    def measured() -> list[TrackedTexture]:
        held = Held()
        return [held.see(becoming(share), 15.0 * share, (120.0 + 6 * share, 160.0)) for share in SHARES]

    with_key = measured()
    monkeypatch.setattr(TextureTracker, "_take_key", lambda *_: None)
    without = measured()
    assert sum(one.rotation.rotation_deg is not None for one in with_key) > sum(
        one.rotation.rotation_deg is not None for one in without
    )
    for share, one in zip(SHARES, with_key, strict=True):
        if one.rotation.rotation_deg is not None and one.rotation.sigma_deg is not None:
            assert abs(one.rotation.rotation_deg - 15.0 * share) < max(4.0 * one.rotation.sigma_deg, 0.5)


def test_the_reference_is_used_again_after_a_key() -> None:
    held = Held()
    for share in SHARES:
        held.see(becoming(share), 0.0)
    back = [held.see(lettered, 0.0) for _ in range(3)][-1]
    assert back.rotation.rotation_deg == pytest.approx(0.0, abs=0.15)
    assert back.deformation < 1.6


def test_a_changing_contact_increases_sigma() -> None:
    held = Held()
    measured = [held.see(becoming(share), 0.0) for share in SHARES[:8]]
    sigmas = [one.rotation.sigma_deg for one in measured if one.rotation.sigma_deg is not None]
    assert sigmas[-1] > 3.0 * sigmas[0]
    assert sum(later < before for before, later in pairwise(sigmas)) <= 2


def test_shift_is_in_frame_pixels() -> None:
    held = Held()
    found = [held.see(lettered, 2.0 * k, (120.0 + 2 * k, 160.0 - k)) for k in range(1, 6)][-1]
    assert found.shift_px == pytest.approx((10.0, -5.0), abs=0.5)


def test_a_shaft_cut_by_the_frame_shows_no_shift_along_itself() -> None:
    """At 70 degrees: along (0.34, -0.94), across (0.94, 0.34) right and down. It slides along, unseen, and across."""
    held = Held(shaft, 70.0)
    for k in range(1, 121):
        found = held.see(
            shaft, 0.05 * k, (120.0 + 0.05 * 0.94 * k + 0.1 * 0.34 * k, 160.0 + 0.05 * 0.34 * k - 0.1 * 0.94 * k)
        )
        assert found.rotation.rotation_deg == pytest.approx(0.05 * k, abs=0.3)
    assert found.shift_px is not None
    assert found.smooth is not None
    along = np.array(found.smooth)
    assert abs(along @ (np.cos(np.radians(76.0)), -np.sin(np.radians(76.0)))) == pytest.approx(1.0, abs=1e-3)
    assert found.shift_px == pytest.approx((6 * 0.94, 6 * 0.34), abs=1.5)


def test_a_texture_with_a_face_shows_every_shift() -> None:
    found = Held().see(lettered, 1.0, (121.0, 160.0))
    assert found.smooth is None
    assert found.shift_px == pytest.approx((1.0, 0.0), abs=0.3)


def coin(rotation_deg: float, lean: float) -> TextureMap:
    """The rim stays as it is, stronger on one side by the light or a tilt; only the fine letters show the rotation."""
    y, x = np.mgrid[-79.5:80.5, -59.5:60.5].astype(np.float32)
    radius = np.hypot(x, y)
    rim = (np.exp(-((radius - 30) ** 2) / 8) - 0.7 * np.exp(-((radius - 34) ** 2) / 8)) * (1 + lean * x / 30)
    letters = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(160, 120)), (0, 0), 1.5)
    letters *= np.exp(-((radius / 20) ** 4)) / letters.std()
    letters = cv2.warpAffine(letters, cv2.getRotationMatrix2D((59.5, 79.5), rotation_deg, 1), (120, 160))
    noise = np.random.default_rng(round(rotation_deg)).normal(0.0, 0.5, (160, 120))
    curvature = cv2.GaussianBlur(10 * rim + 8 * letters + noise, (0, 0), 1.0)
    return TextureMap(ImageWindow(0, 0, 120, 160), np.asarray(curvature, np.float32), 0.3)


@pytest.mark.parametrize("lean", [0.3, 0.9])
def test_a_coin_whose_rim_fits_at_many_rotations_is_uncertain(lean: float) -> None:
    """Its letters had rotated too far between two frames; by its rim it was 10 sigma off."""
    y, x = np.mgrid[-79.5:80.5, -59.5:60.5]
    patch = find_patch(np.asarray(np.hypot(x, y) < 33, np.float32), 0.5, 100, 2.0)
    assert patch is not None
    template = make_texture_template(coin(0.0, lean), patch)
    assert template is not None
    near, far = (TextureTracker(template).track(coin(deg, lean), patch, 2.0, NO_AXIS) for deg in (10.0, 45.0))
    assert near.rotation.rotation_deg == pytest.approx(10.0, abs=0.5)
    assert near.rotation.sigma_deg is not None
    assert near.rotation.sigma_deg < 6.0
    error_deg = abs((far.rotation.rotation_deg or 0.0) - 45.0)
    assert far.rotation.sigma_deg is None or error_deg < 2.0 * far.rotation.sigma_deg
