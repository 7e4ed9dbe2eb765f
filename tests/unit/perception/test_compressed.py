"""Blocks of a coarse compression stay while the contact turns: such a picture tells no turn; a finer one does."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.quality.compressed import coarsely_compressed
from slipguard.perception.quality.image_quality import COMPRESSED
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit
from slipguard.stress.image_families import IMAGES, rotated_grasp
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.trial_family import FamilyResults, generator

Image = NDArray[np.uint8]
QUIET_BGR = (0.3, 0.3, 0.3)


def packed(image: Image, quality: int) -> Image:
    unpacked = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    assert unpacked is not None
    return np.asarray(unpacked, np.uint8)


def pictures(number: int) -> list[Image]:
    """A contact and no contact of one random unit, noisy as it is and nearly without noise."""
    rng = np.random.default_rng(number)
    unit = random_unit(rng)
    thing = find_object(object_names("train")[number])
    view = GelView(thing.name, rng.uniform(-2, 2), rng.uniform(-3, 3), rng.uniform(-180, 180), thing.press_mm)
    cameras = [GelCamera(one, seed=number) for one in (unit, replace(unit, noise_bgr=QUIET_BGR))]
    return [image for camera in cameras for image in (camera.draw(view), camera.no_contact())]


@pytest.mark.parametrize("number", range(8))
def test_blocks_are_seen_at_a_coarse_quality_and_never_at_that_of_a_camera(number: int) -> None:
    for image in pictures(number):
        assert not coarsely_compressed(image)
        assert not coarsely_compressed(packed(image, 90))
        assert not coarsely_compressed(packed(image, 75))
        assert coarsely_compressed(packed(image, 16))
        assert coarsely_compressed(packed(image, 1))


def test_a_picture_without_detail_is_not_called_compressed() -> None:
    y, x = np.mgrid[0:320, 0:240]
    for level in (np.full((320, 240), 90), x // 3 + y // 4, (x + y) % 2 * 255, 255 * (x // 16 % 2)):
        assert not coarsely_compressed(np.repeat(level.astype(np.uint8)[..., None], 3, axis=2))


@pytest.mark.parametrize("spoiled_background", [True, False])
def test_a_coarsely_compressed_contact_tells_no_turn_and_a_finer_one_does(spoiled_background: bool) -> None:
    shown = rotated_grasp(12)
    for quality, declined in ((16, True), (75, False)):
        background = packed(shown.background, quality) if spoiled_background else shown.background
        pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, shown.noise_bgr, 18.5)
        answers = [pipeline.process(Frame(packed(image, quality), k / 60, k)) for k, image in enumerate(shown.frames)]
        assert pipeline.has_reference is not declined
        if declined:
            assert {answer.declined for answer in answers} == {COMPRESSED}
        else:
            assert answers[-1].angle_deg == pytest.approx(shown.rotations_deg[-1], abs=2.0)


@pytest.mark.parametrize("seed", [821, 3063])
def test_no_confident_turn_is_held_back_by_blocks(seed: int) -> None:
    results = FamilyResults("pictures")
    IMAGES.begin(ProductFunctions())(generator("pictures", seed), seed, results)
    assert not results.failures, results.failures
