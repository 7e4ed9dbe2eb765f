"""Edges between few grey levels stay while the contact turns: such a picture tells no turn; one of 64 levels does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.quality.few_levels import few_levels, level_step
from slipguard.perception.quality.image_quality import FEW_LEVELS
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.sensor_unit import random_unit
from slipguard.stress.image_families import IMAGES, rotated_grasp
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.trial_family import FamilyResults, generator

Image = NDArray[np.uint8]


def stepped(image: Image, step: int) -> Image:
    return np.asarray(image // step * step, np.uint8)


@pytest.mark.parametrize("number", range(8))
def test_steps_are_seen_and_a_healthy_unit_has_none(number: int) -> None:
    unit = random_unit(np.random.default_rng(number))
    for one in (unit, replace(unit, noise_bgr=(0.3, 0.3, 0.3))):
        image = GelCamera(one, seed=number).no_contact()
        assert not few_levels(image)
        assert not few_levels(stepped(image, 4))
        assert few_levels(stepped(image, 16))
        hot = stepped(image, 32)
        hot[::97, ::53] = 101  # a hot pixel here and there fills no gap
        assert few_levels(hot)


def test_an_even_picture_has_no_steps() -> None:
    assert level_step(np.full((80, 60), 128, np.uint8)) == 0.0
    assert level_step(np.arange(256, dtype=np.uint8).repeat(10).reshape(-1, 64)) == 1.0


def test_a_contact_in_few_levels_tells_no_turn_and_one_in_64_does() -> None:
    shown = rotated_grasp(12)
    for step, declined in ((16, True), (4, False)):
        pipeline = Pipeline(Segmenter(), PerceptionSettings(), stepped(shown.background, step), shown.noise_bgr, 18.5)
        answers = [pipeline.process(Frame(stepped(image, step), k / 60, k)) for k, image in enumerate(shown.frames)]
        assert pipeline.has_reference is not declined
        if declined:
            assert {answer.declined for answer in answers} == {FEW_LEVELS}
        else:
            assert answers[-1].angle_deg == pytest.approx(shown.rotations_deg[-1], abs=2.0)


@pytest.mark.parametrize("seed", [6649, 7545])
def test_no_confident_turn_is_held_back_by_edges_of_levels(seed: int) -> None:
    results = FamilyResults("pictures")
    IMAGES.begin(ProductFunctions())(generator("pictures", seed), seed, results)
    assert not results.failures, results.failures
