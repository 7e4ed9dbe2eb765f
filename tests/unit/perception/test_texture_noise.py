"""Known camera noise neither looks like deformation nor hides it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.rotation.texture_map import ImageWindow, TextureMapReader
from slipguard.perception.rotation.texture_registration import (
    TextureFit,
    TexturePose,
    fit_texture,
    parts_deg,
    sigma_deg,
)
from slipguard.perception.rotation.texture_template import make_texture_template
from slipguard.sim.camera_noise import CameraNoise
from slipguard.sim.sensor_unit import NOISE_STD_BGR
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


NO_STRIPES = (0.0, 0.0, 0.0)


def shown(surface: Surface, rotation_deg: float, noise: CameraNoise) -> tuple[NDArray[np.uint8], Patch]:
    """A frame with the sensor's own noise, and its patch."""
    height = heights(surface, 15.0 + rotation_deg, (120.0, 160.0), 1.0)
    patch = find_patch(contact_map(height), 0.5, 100, 2.0)
    assert patch is not None
    clean = shaded_image(height, LedLights(), 0.0, np.random.default_rng(0)).astype(np.float32)
    return np.clip(np.rint(clean + noise.next()), 0, 255).astype(np.uint8), patch


def rotated(surface: Surface, known: bool) -> list[TextureFit]:
    """Letters that have rotated by 6 degrees and become another surface, seen ten times."""
    noise = CameraNoise(NOISE_STD_BGR, NO_STRIPES, 3)
    reader = TextureMapReader(BACKGROUND, NOISE_STD_BGR if known else None)
    image, patch = shown(lettered, 0.0, noise)
    reader.learn(image, patch)
    reference = make_texture_template(reader.read(image, patch), patch)
    assert reference is not None
    found = []
    for _ in range(10):
        image, patch = shown(surface, 6.0, noise)
        found.append(fit_texture(reference, reader.read(image, patch), TexturePose(rotation_deg=5.0)))
    return found


def partly(u: Heights, v: Heights) -> Heights:
    return np.asarray(0.75 * lettered(u, v) + 0.25 * plate(u, v), np.float32)


def sigma(found: list[TextureFit]) -> float:
    return float(np.median([sigma_deg(estimate) for estimate in found]))


@pytest.mark.parametrize("std", [NOISE_STD_BGR, (0.9, 0.5, 0.7), (4.6, 2.4, 3.8)])
def test_the_noise_of_the_texture_map_is_that_of_untouched_frames(std: tuple[float, float, float]) -> None:
    noise = CameraNoise(std, NO_STRIPES, 5)
    reader = TextureMapReader(BACKGROUND, std)
    patch = find_patch(np.pad(np.ones((80, 60), np.float32), ((40, 40), (30, 30))), 0.5, 100, 2.0)
    assert patch is not None
    reliefs = [reader.read(np.clip(np.rint(100.0 + noise.next()), 0, 255).astype(np.uint8), patch) for _ in range(12)]
    measured = float(np.std([one.curvature for one in reliefs]))
    assert reliefs[0].window == ImageWindow.around(patch)
    assert reliefs[0].noise == pytest.approx(measured, rel=0.12)


def test_known_noise_lowers_sigma_of_a_contact_that_only_rotated() -> None:
    known = rotated(lettered, known=True)
    assert sigma(known) < 0.8 * sigma(rotated(lettered, known=False))
    assert all(abs(estimate.pose.rotation_deg - 6.0) < 4.0 * sigma_deg(estimate) for estimate in known)


def test_known_noise_does_not_lower_sigma_of_a_deformed_contact() -> None:
    known = rotated(partly, known=True)
    assert sigma(known) > 0.85 * sigma(rotated(partly, known=False))
    assert sigma(known) > 2.0 * sigma(rotated(lettered, known=True))
    assert all(abs(estimate.pose.rotation_deg - 6.0) < 4.0 * sigma_deg(estimate) for estimate in known)


def test_unknown_noise_is_not_subtracted() -> None:
    assert all(parts_deg(estimate)[1] == 0.0 for estimate in rotated(lettered, known=False))
