"""Why no turn may be measured on a picture of a contact, in words; and what other light than the reference's adds."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.gate import Blocks, ContactGate
from slipguard.perception.quality.compressed import coarsely_compressed
from slipguard.perception.quality.few_levels import few_levels
from slipguard.perception.quality.noisy import noisy
from slipguard.perception.rotation.tracker import RotationEstimate

UNLIKE = "picture unlike the no-contact image"
BLURRED = "picture out of focus"
COMPRESSED = "picture coarsely compressed"
FEW_LEVELS = "picture of too few grey levels"
NOISY = "picture noisy"
DARK = "picture too dark"
DARK_LEVELS = 25.0
"""Mean grey level, over the picture and its colours. Real gels have 90 and more; at 9, the three lights spread over a
few levels, a relief turns back by a fifth."""
LIGHT_FREE_LEVELS = 1.0
LIGHT_DEG = 0.6
"""Light that changes after the reference was taken moves outlines: one standard deviation of the turn a grey level of
mean difference from the no-contact image, from the first on. A slope of 6 levels over the picture gives 2."""


def image_defect(
    gate: ContactGate, image: NDArray[np.uint8], blocks: Blocks, near_patch: NDArray[np.bool_]
) -> tuple[str | None, float]:
    """Why a picture is not fit to be measured, None where it is; and its `ContactGate.unlike_levels`.

    image: (320, 240, 3) uint8 BGR. blocks: its `block_means`. near_patch: (1200,) bool, in and near the contact.
    """
    unlike = gate.unlike_levels(blocks, near_patch)
    if not math.isfinite(unlike):
        return UNLIKE, unlike
    if gate.out_of_focus(blocks, near_patch):
        return BLURRED, unlike
    if blocks.mean() < DARK_LEVELS:
        return DARK, unlike
    if coarsely_compressed(image):
        return COMPRESSED, unlike
    if few_levels(image):
        return FEW_LEVELS, unlike
    return (NOISY if noisy(image) else None), unlike


def in_other_light(rotation: RotationEstimate, levels: float) -> RotationEstimate:
    """A turn whose picture is further from the no-contact image than the reference's was: the network errs apart."""
    if rotation.rotation_deg is None or rotation.sigma_deg is None or levels <= LIGHT_FREE_LEVELS:
        return rotation
    return RotationEstimate(
        rotation.rotation_deg, math.hypot(rotation.sigma_deg, LIGHT_DEG * (levels - LIGHT_FREE_LEVELS))
    )
