"""Proposed labels on real presses are good enough to start from; a person corrects them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slipguard.datasets.recorder import propose_mask
from slipguard.perception.segmenter import Segmenter

pytestmark = pytest.mark.real
LEAST_OVERLAP = 0.85


def test_the_proposal_covers_the_labeled_contact(real_data: Path) -> None:
    folder = real_data / "anytouch2_force2"
    background = cv2.imread(str(folder / "background.png"))
    overlaps = []
    segmenter = Segmenter()
    for path in sorted((folder / "frames").glob("*.png")):
        proposed = propose_mask(segmenter, cv2.imread(str(path)), background) > 0
        outlined = cv2.imread(str(folder / "masks" / path.name), cv2.IMREAD_GRAYSCALE) > 0
        overlaps.append((proposed & outlined).sum() / (proposed | outlined).sum())
    assert len(overlaps) > 20
    assert np.mean(overlaps) > LEAST_OVERLAP


def test_untouched_gels_have_no_proposal(real_data: Path) -> None:
    """Compared with themselves under slight noise; there is only one recording of each untouched unit."""
    rng = np.random.default_rng(0)
    segmenter = Segmenter()
    for path in sorted((real_data / "backgrounds").glob("*.png"))[:3]:
        image = cv2.imread(str(path))
        noisy = np.clip(image + rng.normal(0.0, 2.9, image.shape), 0, 255).astype(np.uint8)
        assert not propose_mask(segmenter, noisy, image).any()
