"""A picture in the dark is declined: a few grey levels hold a turn back. Half the light is enough."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.quality.image_quality import DARK
from slipguard.perception.settings import PerceptionSettings
from slipguard.stress.image_families import rotated_grasp

Image = NDArray[np.uint8]


def lit(image: Image, exponent: float, gain: float = 1.0) -> Image:
    return np.asarray(gain * 255.0 * (image / 255.0) ** exponent, np.uint8)


def seen(exponent: float, gain: float) -> list[Estimate]:
    """An egg that turns by 20 degrees, calibrated in the same light."""
    shown = rotated_grasp(0)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), lit(shown.background, exponent, gain), shown.noise_bgr, 18.5)
    frames = (Frame(lit(image, exponent, gain), k / 60, k) for k, image in enumerate(shown.frames))
    return [pipeline.process(frame) for frame in frames]


@pytest.mark.parametrize(("exponent", "gain"), [(5.0**0.75, 1.0), (1.0, 0.15)])
def test_a_contact_in_the_dark_tells_no_turn(exponent: float, gain: float) -> None:
    answers = seen(exponent, gain)
    assert DARK in {one.declined for one in answers}
    assert {one.angle_deg for one in answers} == {None}


def test_half_the_light_is_enough() -> None:
    last = seen(1.0, 0.5)[-1]
    assert abs((last.angle_deg or 0.0) + 20.0) < min(2.0, 4.0 * (last.sigma_deg or 0.0))
