"""So much noise hides where a contact's outline and relief are: such a picture tells no turn; a grainy one does."""

from __future__ import annotations

import numpy as np
import pytest

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.quality.image_quality import NOISY
from slipguard.perception.quality.noisy import noisy
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.sensor_unit import random_unit
from slipguard.stress.image_distortions import DISTORTIONS
from slipguard.stress.image_families import IMAGES, rotated_grasp
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.trial_family import FamilyResults, generator


@pytest.mark.parametrize("number", range(8))
def test_noise_is_seen_and_a_healthy_unit_has_little(number: int) -> None:
    rng = np.random.default_rng(number)
    image = GelCamera(random_unit(rng), seed=number).no_contact()
    assert not noisy(image)
    assert not noisy(DISTORTIONS["noise"](image, 7 / 64, rng))
    assert noisy(DISTORTIONS["noise"](image, 13 / 64, rng))


def test_edges_are_no_noise() -> None:
    y, x = np.mgrid[0:320, 0:240]
    for level in (x // 3 + y // 4, 255 * (x // 16 % 2), 255 * (y % 2)):
        assert not noisy(np.repeat(level.astype(np.uint8)[..., None], 3, axis=2))


def test_a_contact_in_noise_tells_no_turn_and_a_grainy_one_does() -> None:
    shown, rng = rotated_grasp(12), np.random.default_rng(0)
    for level, declined in ((16.0, True), (4.0, False)):
        pipeline = Pipeline(Segmenter(), PerceptionSettings(), shown.background, shown.noise_bgr, 18.5)
        frames = [DISTORTIONS["noise"](image, level / 64.0, rng) for image in shown.frames]
        answers = [pipeline.process(Frame(image, k / 60, k)) for k, image in enumerate(frames)]
        assert pipeline.has_reference is not declined
        if declined:
            assert NOISY in {answer.declined for answer in answers}
        else:
            assert answers[-1].angle_deg == pytest.approx(shown.rotations_deg[-1], abs=2.0)


def test_no_confident_turn_is_told_in_noise() -> None:
    results = FamilyResults("pictures")
    IMAGES.begin(ProductFunctions())(generator("pictures", 5344), 5344, results)
    assert not results.failures, results.failures
