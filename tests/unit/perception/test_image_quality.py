"""Images on which a rotation would be wrong without a larger sigma are declined; healthy images are not."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.estimate import DeclineReason, Estimate
from slipguard.perception.image_quality import LIMITS, ImageQuality, pixel_figures
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import BLOCKS_HIGH, BLOCKS_WIDE, DEFAULT_NOISE_BGR, block_means, blocks_near
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit
from slipguard.stress.grasps import rotated_grasp
from slipguard.stress.image_distortions import DISTORTIONS
from slipguard.stress.run import cases
from slipguard.stress.trial import ProductFunctions, run_trial

Image = NDArray[np.uint8]


QUIET_BGR = (0.3, 0.3, 0.3)


NEAR = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((60, 60), (40, 40))))


SHOWN = 10


"""A grasp of `slipguard.stress` whose rotation is measured well on undistorted images."""


def with_levels(image: Image, step: int) -> Image:
    """The image with every `step`-th gray level only."""
    return np.asarray(image // step * step, np.uint8)


def compressed(image: Image, quality: int) -> Image:
    decoded = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded, np.uint8)


def blurred(image: Image, sigma_px: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8)


def with_camera_noise(image: Image) -> Image:
    noise = 2.5 * np.random.default_rng(3).standard_normal(image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def with_light(image: Image, exponent: float, gain: float = 1.0) -> Image:
    return np.asarray(gain * 255.0 * (image / 255.0) ** exponent, np.uint8)


def shades(*levels: NDArray[np.int64]) -> list[Image]:
    return [np.repeat(level.astype(np.uint8)[..., None], 3, axis=2) for level in levels]


def measured(background: Image, frames: list[Image], noise_bgr: tuple[float, ...]) -> tuple[Pipeline, list[Estimate]]:
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, noise_bgr, 18.5)
    return pipeline, [pipeline.process(Frame(image, k / 60, k)) for k, image in enumerate(frames)]


def estimates_in_light(exponent: float, gain: float) -> list[Estimate]:
    """An egg that rotates by 20 degrees, calibrated in the same light."""
    shown = rotated_grasp(0)
    frames = [with_light(image, exponent, gain) for image in shown.frames]
    return measured(with_light(shown.background, exponent, gain), frames, shown.noise_bgr)[1]


def beyond(image: Image) -> set[str]:
    """The rows of the table that the pixels of an image exceed."""
    return {what for what, value in pixel_figures(image) if LIMITS[what].is_beyond(value)}


def unusable(quality: ImageQuality, image: Image, near: NDArray[np.bool_] | None) -> str:
    """Why an image says nothing; empty if it is good."""
    return quality.check(image, block_means(image), near) or ""


def out_of_focus(background: Image | None, image: Image, near: NDArray[np.bool_]) -> bool:
    return "detail" in unusable(ImageQuality(background), image, near)


def why(estimates: list[Estimate]) -> str:
    """What is unusual in the images of the estimates, one line."""
    return "; ".join(sorted({one.declined or "" for one in estimates if one.unusable}))


def whole_frame() -> NDArray[np.uint8]:
    noise = np.random.default_rng(1).integers((90, 60, 120), (100, 70, 130), (320, 240, 3))
    return (noise + np.linspace(0, 80, 240).astype(np.int64)[:, np.newaxis]).astype(np.uint8)


SPOILS: dict[str, tuple[tuple[Callable[[Image], Image], ...], tuple[Callable[[Image], Image], ...]]] = {
    "step": (
        (lambda image: with_levels(image, 4),),
        (lambda image: with_levels(image, 16), lambda image: with_hot_pixels(with_levels(image, 32))),
    ),
    "noise": (
        (lambda image: DISTORTIONS["noise"](image, 7 / 64, np.random.default_rng(0)),),
        (lambda image: DISTORTIONS["noise"](image, 16 / 64, np.random.default_rng(0)),),
    ),
    "compression": (
        (lambda image: compressed(image, 90), lambda image: compressed(image, 75)),
        (lambda image: compressed(image, 16), lambda image: compressed(image, 1)),
    ),
}
"""Distortions by the row of the table that they concern: those within the limit, and those beyond."""


def with_hot_pixels(image: Image) -> Image:
    image[::97, ::53] = 101
    return image


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("what", SPOILS)
def test_distortions_are_detected_and_healthy_units_have_none(what: str, number: int) -> None:
    rng = np.random.default_rng(number)
    unit, thing = random_unit(rng), find_object(object_names("train")[number])
    view = GelView(thing.name, rng.uniform(-2, 2), rng.uniform(-3, 3), rng.uniform(-180, 180), thing.press_mm)
    cameras = [GelCamera(one, seed=number) for one in (unit, replace(unit, noise_bgr=QUIET_BGR))]
    fine, coarse = SPOILS[what]
    for image in [image for camera in cameras for image in (camera.draw(view), camera.no_contact())]:
        assert not beyond(image)
        assert not any(what in beyond(spoil(image)) for spoil in fine)
        assert all(what in beyond(spoil(image)) for spoil in coarse)


def test_edges_and_shades_are_neither_noise_nor_compression() -> None:
    y, x = np.mgrid[0:320, 0:240]
    for image in shades(x // 3 + y // 4, 255 * (x // 16 % 2), np.full((320, 240), 90)):
        assert not beyond(image) & {"noise", "compression"}


@pytest.mark.parametrize("calibrated_with_it", [True, False])
@pytest.mark.parametrize(
    ("what", "why_not"), [("step", "steps of"), ("noise", "are noise"), ("compression", "blockiness")]
)
def test_a_contact_beyond_a_limit_is_declined_and_one_within_is_measured(
    what: str, why_not: str, calibrated_with_it: bool
) -> None:
    shown = rotated_grasp(SHOWN)
    for declined, spoil in enumerate((SPOILS[what][0][-1], SPOILS[what][1][0])):
        background = spoil(shown.background) if calibrated_with_it and what != "noise" else shown.background
        frames = [spoil(image) for image in shown.frames]
        pipeline, estimates = measured(background, frames, shown.noise_bgr)
        assert pipeline.has_reference is not bool(declined)
        if declined:
            assert why_not in why(estimates)
        else:
            assert estimates[-1].rotation_deg == pytest.approx(shown.rotations_deg[-1], abs=2.0)


@pytest.mark.parametrize("name", ["JPEG", "few levels", "noise"])
def test_no_certain_rotation_is_wrong_because_of_blocks_levels_or_noise(name: str) -> None:
    for case in cases([name], 0, ProductFunctions())[:6]:
        assert not run_trial(case).failures, case


@pytest.mark.parametrize(("exponent", "gain"), [(5.0**0.75, 1.0), (1.0, 0.15)])
def test_a_contact_in_the_dark_is_declined(exponent: float, gain: float) -> None:
    estimates = estimates_in_light(exponent, gain)
    assert "minimum 25" in why(estimates)
    assert {one.rotation_deg for one in estimates} == {None}


def test_half_the_light_is_enough() -> None:
    last = estimates_in_light(1.0, 0.5)[-1]
    assert abs((last.rotation_deg or 0.0) + 20.0) < min(2.0, 4.0 * (last.sigma_deg or 0.0))


@pytest.mark.parametrize("number", [12, 17, 20])
def test_a_blurred_faint_contact_is_declined_and_makes_no_reference(number: int) -> None:
    shown = rotated_grasp(number)
    pipeline, estimates = measured(shown.background, [blurred(image, 9.3) for image in shown.frames], shown.noise_bgr)
    assert {one.decline_reason for one in estimates if one.contact} == {DeclineReason.IMAGE}
    assert "detail" in why(estimates)
    assert not [one for one in estimates if one.rotation_deg is not None]
    assert not pipeline.has_reference
    sharp = [pipeline.process(Frame(one, (20 + k) / 60, 20 + k)) for k, one in enumerate(shown.frames)]
    assert pipeline.has_reference
    assert sharp[-1].rotation_deg == pytest.approx(shown.rotations_deg[-1], abs=3.0)


@pytest.mark.parametrize("sigma_px", [0.0, 1.5, 3.0, 9.0, 15.0])
def test_a_blurred_image_is_out_of_focus_whatever_the_noise(sigma_px: float) -> None:
    background = rotated_grasp(0).background
    image = with_camera_noise(blurred(background, sigma_px) if sigma_px else background)
    assert out_of_focus(background, image, NEAR) == (sigma_px > 5.0)


def test_neither_light_nor_compression_counts_as_out_of_focus() -> None:
    shown = rotated_grasp(0)
    for gain, offset in itertools.product((0.7, 0.85, 1.3), (-20.0, 0.0, 20.0)):
        image = np.clip(np.rint(shown.background * gain + offset), 0, 255).astype(np.uint8)
        assert not out_of_focus(shown.background, with_camera_noise(image), NEAR)
    assert not any(out_of_focus(shown.background, compressed(shown.frames[0], one), NEAR) for one in (90, 50, 20))


def test_focus_is_not_checked_without_background_or_with_little_gel_outside_the_contact() -> None:
    background = rotated_grasp(0).background
    image = blurred(background, 12.0)
    assert out_of_focus(background, image, NEAR)
    assert not out_of_focus(None, image, NEAR)
    covered = np.ones((BLOCKS_HIGH, BLOCKS_WIDE), np.bool_)
    covered[:, 0] = False
    assert not out_of_focus(background, image, covered.ravel())

    flat = np.full((320, 240, 3), 100, np.uint8)  # a gel without any pattern
    assert not out_of_focus(flat, flat, NEAR)


def test_a_contact_that_fills_the_image_is_declined() -> None:
    quality = ImageQuality(whole_frame())
    mask = np.ones((160, 120), np.uint8)
    assert "contact over 1.00 of the image" in unusable(quality, whole_frame(), blocks_near(mask))
    mask[:, :40] = 0
    assert not unusable(quality, whole_frame(), blocks_near(mask))


@pytest.mark.parametrize(
    ("part", "levels", "good"),
    [
        (np.s_[:], 20, True),  # brighter
        (np.s_[..., 1], 6, True),  # one lamp
        (np.s_[..., 1], 20, True),
        (np.s_[..., 1], 45, False),
        (np.s_[130:190, 90:150], 90, True),  # a press
        (np.s_[:, :120], 40, False),  # another pattern
    ],
)
def test_light_may_drift_up_to_a_limit(part: Any, levels: int, good: bool) -> None:
    image = whole_frame()
    image[part] += np.uint8(levels)
    assert (not unusable(ImageQuality(whole_frame()), image, NEAR)) == good


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (0, 2, 1), (1, 2, 0), (2, 0, 1)])
def test_swapped_colors_are_detected_even_with_a_large_contact(order: tuple[int, int, int]) -> None:
    shown = rotated_grasp(2)
    gate = ImageQuality(shown.background)
    near = blocks_near(np.pad(np.ones((120, 100), np.uint8), ((20, 20), (10, 10))))
    for image in shown.frames:
        assert not unusable(gate, image, near)
        assert unusable(gate, np.ascontiguousarray(image[..., order]), near)


@pytest.mark.parametrize("level", [0, 255])
def test_a_contact_under_a_glare_or_a_dead_spot_is_declined(level: int) -> None:
    spotted = whole_frame()
    spotted[150:200, 110:160] = level
    away = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((10, 110), (10, 70))))
    gate = ImageQuality(spotted)
    assert unusable(gate, spotted, NEAR)
    assert not unusable(gate, spotted, away)


def test_a_rotation_in_an_almost_dark_image_is_not_skipped() -> None:
    shown = rotated_grasp(0)
    dark = [np.asarray(image // 16, np.uint8) for image in shown.frames]
    background = np.asarray(shown.background // 16, np.uint8)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, DEFAULT_NOISE_BGR, 18.5)
    estimates = [pipeline.process(Frame(image, k / 60, k)) for k, image in enumerate(dark)]
    assert not [one for one in estimates if one.contact and one.skipped]


@pytest.mark.parametrize(("what", "strength"), [("swapped colors", 1.0), ("negative", 0.5), ("crushed", 0.5)])
def test_other_light_gives_no_rotation_and_no_reference(what: str, strength: float) -> None:
    shown = rotated_grasp(0)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), shown.background, None, 18.5)
    rng = np.random.default_rng(0)
    estimates = [
        pipeline.process(Frame(DISTORTIONS[what](image, strength, rng), k / 60, k))
        for k, image in enumerate(shown.frames)
    ]
    assert {last_estimate.decline_reason for last_estimate in estimates if last_estimate.contact} <= {
        DeclineReason.IMAGE
    }
    assert not [last_estimate for last_estimate in estimates if last_estimate.rotation_deg is not None]
    assert not pipeline.has_reference
    clean = [pipeline.process(Frame(image, (20 + k) / 60, 20 + k)) for k, image in enumerate(shown.frames)]
    assert clean[-1].rotation_deg == pytest.approx(shown.rotations_deg[-1], abs=3.0)


@pytest.mark.parametrize("number", range(3))
def test_a_pressed_gel_shows_contact_or_nothing_in_any_light(number: int) -> None:
    """No light makes the pipeline report that a pressed gel is free."""
    camera, item = GelCamera(random_unit(np.random.default_rng(number)), seed=number), object_names("train")[number]
    pressed = camera.draw(GelView(item, depth_mm=find_object(item).press_mm)).astype(np.float64)
    segmenter = Segmenter()
    for gain in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.02, 0.0, 1.3, 2.0, 8.0):
        for colors in (slice(None), 0, 1, 2):
            image = np.zeros_like(pressed)
            image[..., colors] = gain * pressed[..., colors]
            pipeline = Pipeline(segmenter, PerceptionSettings(), camera.no_contact(), None, 18.5)
            estimate = pipeline.process(Frame(np.clip(np.rint(image), 0, 255).astype(np.uint8), 0.0, 0))
            assert estimate.unusable or estimate.contact
            assert estimate.unusable or (colors == slice(None) and 0.55 <= gain <= 1.5)
