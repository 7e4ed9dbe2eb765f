"""Rotation by the texture in a contact, under lights that stay in place; round textures are declined."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.rotation import texture_map as height_map
from slipguard.perception.rotation.texture_map import TextureMapReader
from slipguard.perception.rotation.texture_registration import (
    TextureFit,
    TexturePose,
    TextureTemplate,
    fit_texture,
    sigma_deg,
)
from slipguard.perception.rotation.texture_template import make_texture_template

Height = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


LIGHTS_DEG = (270.0, 150.0, 30.0)


NOISE = 2.0


def dome(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """A ball pressed in, heights and lengths in frame pixels."""
    return 12.0 * np.exp(-(u**2 + v**2) / (2.0 * 26.0**2))


def lettered(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """A round contact with a bar and a dot on it."""
    bar = np.exp(-(np.maximum(np.abs(u + 10) - 3, 0) ** 2 + np.maximum(np.abs(v) - 22, 0) ** 2) / 18.0)
    dot = np.exp(-((u - 18) ** 2 + (v - 9) ** 2) / 60.0)
    return dome(u, v) + 4.0 * bar + 4.0 * dot


def gear(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twelve ribs around."""
    radius = np.hypot(u, v)
    return dome(u, v) + 3.0 * np.cos(12 * np.arctan2(v, u)) * np.exp(-((radius - 40.0) ** 2) / 120.0)


def pressed(
    height: Height,
    rotation_deg: float,
    *,
    at: tuple[float, float] = (120.0, 160.0),
    force: float = 1.0,
    gains: tuple[float, float, float] = (1.0, 1.0, 1.0),
    lights_deg: tuple[float, float, float] = LIGHTS_DEG,
    seed: int = 0,
) -> tuple[NDArray[np.uint8], Patch]:
    """A frame of a surface under three lights that stay where they are, on level 100, and its patch."""
    rows, columns = np.mgrid[0:320, 0:240].astype(np.float64)
    x, y = columns - at[0], at[1] - rows
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    surface = force * height(c * x + s * y, c * y - s * x)
    down, right = np.gradient(surface)
    azimuth = np.radians(lights_deg)
    # The gel is pushed towards the camera: what faces a light slopes down towards it.
    change = [-60.0 * g * (right * np.cos(a) - down * np.sin(a)) for g, a in zip(gains, azimuth, strict=True)]
    noise = np.random.default_rng(seed).normal(0.0, NOISE, (320, 240, 3))
    image = np.clip(np.rint(100.0 + np.stack(change, -1) + noise), 0, 255).astype(np.uint8)
    patch = find_patch((1.0 / (1.0 + np.exp(-(surface[::2, ::2] - 3.0)))).astype(np.float32), 0.5, 100, 2.0)
    assert patch is not None
    return image, patch


def background() -> NDArray[np.uint8]:
    return np.full((320, 240, 3), 100, np.uint8)


def referenced(height: Height, **how: object) -> tuple[TextureMapReader, TextureTemplate]:
    reader = TextureMapReader(background())
    image, patch = pressed(height, 20.0, **how)  # type: ignore[arg-type]
    reader.learn(image, patch)
    texture = make_texture_template(reader.read(image, patch), patch)
    assert texture is not None
    return reader, texture


def followed(height: Height, rotations: list[float], growth: float = 0.0, **how: object) -> list[TextureFit]:
    reader, texture = referenced(height, **how)
    pose, estimates = TexturePose(), []
    for k, rotation in enumerate(rotations, start=1):
        force = 1.0 + growth * k / len(rotations)
        at = (120.0 + 0.6 * k, 160.0 - 0.4 * k)
        image, patch = pressed(height, 20.0 + rotation, at=at, force=force, seed=k, **how)  # type: ignore[arg-type]
        estimates.append(fit_texture(texture, reader.read(image, patch), pose))
        pose = estimates[-1].pose
    return estimates


ROTATIONS = [3.0 * k for k in range(1, 11)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("growth", [0.0, 1.2])
def test_a_round_contact_with_texture_is_tracked_while_the_force_rises(sign: float, growth: float) -> None:
    rotations = [sign * rotation for rotation in ROTATIONS]
    for rotation, last_estimate in zip(rotations, followed(lettered, rotations, growth), strict=True):
        assert last_estimate.declined is None
        assert abs(last_estimate.pose.rotation_deg - rotation) < 0.4
        assert abs(last_estimate.pose.rotation_deg - rotation) < 5.0 * sigma_deg(last_estimate)


def test_the_shift_is_that_of_the_object() -> None:
    pose = followed(lettered, ROTATIONS)[-1].pose
    assert (pose.dx_px, pose.dy_px) == pytest.approx((3.0, -2.0), abs=0.25)


def worst_deg(gains: tuple[float, float, float]) -> float:
    estimates = followed(lettered, ROTATIONS, gains=gains)
    return max(abs(a.pose.rotation_deg - rotation) for a, rotation in zip(estimates, ROTATIONS, strict=True))


@pytest.mark.parametrize("gains", [(1.0, 0.6, 1.5), (0.5, 1.0, 1.0), (0.15, 1.0, 1.0)])
def test_lights_of_unequal_strength_are_learned(
    gains: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    learnt = worst_deg(gains)
    assert learnt < 0.5
    monkeypatch.setattr(height_map, "NOMINAL_WEIGHT", 1e6)  # nothing is learnt
    assert learnt < 0.75 * worst_deg(gains)


def test_lights_in_the_other_sense_are_recognized() -> None:
    estimates = followed(lettered, ROTATIONS, lights_deg=(270.0, 30.0, 150.0))
    assert all(last_estimate.declined is None for last_estimate in estimates)
    assert max(abs(a.pose.rotation_deg - rotation) for a, rotation in zip(estimates, ROTATIONS, strict=True)) < 0.6


@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0), (1.0, 0.6, 1.5)])
def test_a_plain_ball_declines_under_any_light(gains: tuple[float, float, float]) -> None:
    assert {
        (last_estimate.declined or "").partition(":")[0] for last_estimate in followed(dome, ROTATIONS, gains=gains)
    } == {"round contact"}


def test_the_texture_of_another_object_declines() -> None:
    reader, texture = referenced(lettered)
    image, patch = pressed(gear, 0.0)
    last_estimate = fit_texture(texture, reader.read(image, patch), TexturePose())
    assert last_estimate.declined is not None or sigma_deg(last_estimate) > 1.0


def test_a_contact_that_left_the_image_declines() -> None:
    reader, texture = referenced(lettered)
    image, patch = pressed(lettered, 20.0, at=(236.0, 160.0))
    last_estimate = fit_texture(texture, reader.read(image, patch), TexturePose(dx_px=58.0))
    assert last_estimate.declined == "clipped by the frame: 43% of the texture is visible, limit 45%"


def test_an_image_without_any_texture_gives_finite_numbers() -> None:
    reader, texture = referenced(lettered)
    _, patch = pressed(lettered, 20.0)
    last_estimate = fit_texture(texture, reader.read(background(), patch), TexturePose())
    assert last_estimate.declined is not None
    assert np.isfinite([last_estimate.pose.rotation_deg, sigma_deg(last_estimate), last_estimate.alike]).all()
