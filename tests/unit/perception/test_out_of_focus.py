"""A camera that has lost its focus shows the gel's own pattern less than a faint contact needs: no turn is told."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.gate import BLOCKS_HIGH, BLOCKS_WIDE, ContactGate, block_means, near_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.quality.image_quality import BLURRED
from slipguard.perception.settings import PerceptionSettings
from slipguard.stress.image_families import rotated_grasp

NEAR = near_patch(np.pad(np.ones((40, 40), np.uint8), ((60, 60), (40, 40))))


def blurred(image: NDArray[np.uint8], sigma_px: float) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.uint8)


def noisy(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    noise = 2.5 * np.random.default_rng(3).standard_normal(image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("number", [12, 17, 20])
def test_a_blurred_faint_contact_tells_no_turn_and_makes_no_reference(number: int) -> None:
    shown = rotated_grasp(number)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), shown.background, shown.noise_bgr, 18.5)
    answers = [pipeline.process(Frame(blurred(one, 9.3), k / 60, k)) for k, one in enumerate(shown.frames)]
    assert {answer.declined for answer in answers if answer.contact} == {BLURRED}
    assert not [answer for answer in answers if answer.angle_deg is not None]
    assert not pipeline.has_reference
    sharp = [pipeline.process(Frame(one, (20 + k) / 60, 20 + k)) for k, one in enumerate(shown.frames)]
    assert sharp[-1].angle_deg == pytest.approx(shown.rotations_deg[-1], abs=3.0)


@pytest.mark.parametrize("sigma_px", [0.0, 1.5, 3.0, 9.0, 15.0])
def test_noise_does_not_hide_that_the_gel_is_out_of_focus(sigma_px: float) -> None:
    background = rotated_grasp(0).background
    image = noisy(blurred(background, sigma_px) if sigma_px else background)
    assert ContactGate(background).out_of_focus(block_means(image), NEAR) == (sigma_px > 5.0)


@pytest.mark.parametrize("gain", [0.7, 0.85, 1.3])
@pytest.mark.parametrize("offset", [-20.0, 0.0, 20.0])
def test_another_light_is_not_out_of_focus(gain: float, offset: float) -> None:
    background = rotated_grasp(0).background
    lit = np.clip(np.rint(background * gain + offset), 0, 255).astype(np.uint8)
    assert not ContactGate(background).out_of_focus(block_means(noisy(lit)), NEAR)


@pytest.mark.parametrize("quality", [90, 50, 20])
def test_a_compressed_picture_is_not_out_of_focus(quality: int) -> None:
    shown = rotated_grasp(0)
    packed = cv2.imencode(".jpg", shown.frames[0], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), np.uint8)
    assert not ContactGate(shown.background).out_of_focus(block_means(image), NEAR)


def test_where_the_gel_is_hardly_seen_nothing_is_said_of_the_focus() -> None:
    background = rotated_grasp(0).background
    blocks = block_means(blurred(background, 12.0))
    assert ContactGate(background).out_of_focus(blocks, NEAR)
    assert not ContactGate(None).out_of_focus(blocks, NEAR)
    covered = np.ones((BLOCKS_HIGH, BLOCKS_WIDE), np.bool_)
    covered[:, 0] = False
    assert not ContactGate(background).out_of_focus(blocks, covered.ravel())


def test_a_gel_without_any_pattern_is_never_out_of_focus() -> None:
    background = np.full((320, 240, 3), 100, np.uint8)
    assert not ContactGate(background).out_of_focus(block_means(background), NEAR)
