"""Patterns that stay in place while a contact rotates bias the registration and increase sigma."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.rotation import texture_registration
from slipguard.perception.rotation.texture_map import TextureMapReader
from slipguard.perception.rotation.texture_registration import (
    STATIC_BIAS_MAX,
    TextureFit,
    TexturePose,
    find_ghost,
    fit_texture,
    sigma_deg,
)
from slipguard.perception.rotation.texture_template import make_texture_template
from slipguard.stress.image_families import IMAGES
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.textured_surfaces import LedLights, contact_map, heights, lettered, shaded_image
from slipguard.stress.trial_family import FamilyResults, generator

ROTATIONS_DEG = (2.0, 4.0, 8.0, 12.0)


def shown(rotation_deg: float, levels: float) -> tuple[NDArray[np.uint8], Patch]:
    """Letters that rotate under dirt that stays where it is."""
    height = heights(lettered, 15.0 + rotation_deg, (120.0, 160.0), 1.0)
    patch = find_patch(contact_map(height), 0.5, 100, 2.0)
    assert patch is not None
    clean = shaded_image(height, LedLights(), 0.0, np.random.default_rng(0)).astype(np.float64)
    rng = np.random.default_rng(5)
    dirt = cv2.GaussianBlur(rng.standard_normal((320, 240, 3)), (0, 0), 4.0)
    noise = 2.0 * np.random.default_rng(int(10 * rotation_deg)).standard_normal(clean.shape)
    return np.clip(np.rint(clean + levels * dirt / dirt.std() + noise), 0, 255).astype(np.uint8), patch


def rotated(levels: float) -> list[TextureFit]:
    reader = TextureMapReader(np.full((320, 240, 3), 100, np.uint8), (2.0, 2.0, 2.0))
    image, patch = shown(0.0, levels)
    reader.learn(image, patch)
    reference = make_texture_template(reader.read(image, patch), patch)
    assert reference is not None
    pose, found = TexturePose(), []
    for rotation in ROTATIONS_DEG:
        image, patch = shown(rotation, levels)
        found.append(fit_texture(reference, reader.read(image, patch), pose))
        pose = found[-1].pose
    return found


def sigmas_off(found: list[TextureFit]) -> float:
    return max(
        abs(a.pose.rotation_deg - rotation) / sigma_deg(a) for a, rotation in zip(found, ROTATIONS_DEG, strict=True)
    )


@pytest.mark.parametrize("levels", [6.0, 7.0])
def test_static_dirt_increases_sigma(levels: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture_registration, "UNEVEN_DEG", 0.0)  # deformation would explain a part of the dirt
    found = rotated(levels)
    with_it = [sigma_deg(estimate) for estimate in found]
    assert sigmas_off(found) < 4.0
    monkeypatch.setattr(texture_registration, "STATIC", 0.0)
    assert sigma_deg(found[-1]) < 0.95 * with_it[-1]


def test_without_a_static_pattern_sigma_is_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    found = rotated(0.0)
    sigmas = [sigma_deg(estimate) for estimate in found]
    monkeypatch.setattr(texture_registration, "STATIC", 0.0)
    assert sigmas == pytest.approx([sigma_deg(estimate) for estimate in found], rel=0.02)


def test_the_bias_equals_the_share_of_the_static_pattern() -> None:
    x = np.linspace(-3.0, 3.0, 600, dtype=np.float32)

    def at(moved: float) -> NDArray[np.float64]:
        return (np.sin(5 * (x - moved)) + np.sin(9 * (x - moved) + 1)) * np.exp(-((x - moved) ** 2))

    value, motion = at(0.0), np.gradient(at(0.0), x)
    share, true = 0.3, 0.1
    measured = (1 - share) * true

    mixed = share * at(-measured) + (1 - share) * at(true - measured)
    motions = np.stack([motion, value], axis=1)
    left = mixed - motions @ np.linalg.lstsq(motions, mixed, rcond=None)[0]

    def bias(residual: NDArray[np.float64]) -> float:
        fields = np.zeros((12, len(x)))
        fields[0], fields[1], fields[5], fields[11] = residual, motion, value, at(-measured)
        return find_ghost(fields @ fields.T, float(len(x)))[1]

    assert bias(left) * measured == pytest.approx(true - measured, rel=0.2)
    assert bias(0 * left) == 0.0
    assert bias(1e3 * left) == STATIC_BIAS_MAX


@pytest.mark.parametrize("seed", [371, 373, 377, 741, 2533, 3817])
def test_static_distortions_give_no_wrong_certain_rotation(seed: int) -> None:
    results = FamilyResults("pictures")
    IMAGES.begin(ProductFunctions())(generator("pictures", seed), seed, results)
    assert not results.failures, results.failures
