"""Proposed labels on real presses: good enough to begin with, never the last word."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slipguard.datasets.recorder import propose_mask

pytestmark = pytest.mark.real
LEAST_OVERLAP = 0.75


def test_the_proposal_covers_what_was_outlined(real_data: Path) -> None:
    """The indenter's frames that the settings were chosen on; the rest of them gives 0.88."""
    folder = real_data / "anytouch2_force2"
    background = cv2.imread(str(folder / "background.png"))
    overlaps = []
    for path in sorted((folder / "frames").glob("*.png")):
        if path.stem > "f0132":
            continue
        proposed = propose_mask(cv2.imread(str(path)), background) > 0
        outlined = cv2.imread(str(folder / "masks" / path.name), cv2.IMREAD_GRAYSCALE) > 0
        overlaps.append((proposed & outlined).sum() / (proposed | outlined).sum())
    assert len(overlaps) > 20
    assert np.mean(overlaps) > LEAST_OVERLAP


def test_gels_at_rest_have_no_proposal(real_data: Path) -> None:
    """Against themselves under a little noise; no two recordings of one untouched unit are there."""
    rng = np.random.default_rng(0)
    for path in sorted((real_data / "backgrounds").glob("*.png"))[:3]:
        image = cv2.imread(str(path))
        noisy = np.clip(image + rng.normal(0.0, 2.9, image.shape), 0, 255).astype(np.uint8)
        assert not propose_mask(noisy, image).any()
