"""An indenter that is pressed and sheared but never rotates: the rotation that the pipeline estimates. Test part."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slipguard.devices import Frame
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from tests.campaigns.real_frames import TUNING_INDENTER_LAST

pytestmark = pytest.mark.real
FRAMES_APART = 4
"""Every fourth frame of the video is labeled."""
PX_PER_MM = 18.5


def measured(folder: Path, frames: list[Path], begin: int) -> list[float]:
    """Absolute rotations estimated from frame `begin` on, since the first contact, which sigma must describe."""
    background = cv2.imread(str(folder / "background.png"))
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, None, PX_PER_MM)
    rotations, sigmas = [], []
    for index, path in enumerate(frames):
        estimate = pipeline.process(Frame(cv2.imread(str(path)), index * FRAMES_APART / 60.0, index))
        if index >= begin and estimate.rotation_deg is not None and estimate.sigma_deg is not None:
            rotations.append(abs(estimate.rotation_deg))
            sigmas.append(rotations[-1] / estimate.sigma_deg)
            assert sigmas[-1] <= 3.0, path.name
    within = [np.mean(np.array(sigmas) <= limit) for limit in (1.0, 2.0)]
    print(
        f"{len(rotations)} of {len(frames) - begin} estimated, p95 {np.percentile(rotations, 95):.2f}°, "
        f"largest {max(rotations):.2f}°; {within[0]:.0%} within 1 sigma, {within[1]:.0%} within 2"
    )
    assert within[0] >= 0.6
    assert within[1] >= 0.93
    return rotations


def test_tracked_from_the_first_press_it_hardly_rotates(real_data: Path) -> None:
    folder = real_data / "anytouch2_force2"
    frames = sorted((folder / "frames").glob("*.png"))
    begin = sum(path.stem <= TUNING_INDENTER_LAST for path in frames)
    rotations = measured(folder, frames, begin)
    assert len(rotations) >= 26
    # Larger than for the 19 frames that were answered when sigma was three times as wide: the sheared ones are hard.
    assert np.percentile(rotations, 95) <= 5.2


def test_started_in_the_middle_of_the_shear_on_the_test_frames(real_data: Path) -> None:
    folder = real_data / "anytouch2_force2"
    frames = [path for path in sorted((folder / "frames").glob("*.png")) if path.stem > TUNING_INDENTER_LAST]
    rotations = measured(folder, frames, 0)
    assert len(rotations) >= 17  # the texture of the others has changed too much
    assert np.percentile(rotations, 95) <= 2.0
