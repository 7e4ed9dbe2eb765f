"""A million frames through registration and track: what has come back to where it was is told so."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.rotation.rotation_meter import RotationMeter
from slipguard.perception.rotation.tracker import RotationEstimate
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stage_timer import StageTimer
from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.product_functions import FRAME_S, MAP_PX, THRESHOLD, ProductFunctions
from slipguard.stress.shapes import ELONGATED, ShapePose, roughness, soft

DRIFT = "drift of the tracked turn"
DRIFT_DEG = 0.1
STRETCH_FRAMES = 1000
"""The object swings there and back over every seam within so many frames."""
SWING_DEG = 200.0
REFERENCE_DEG = 37
VARIANTS = 3
"""Every whole degree is drawn so many times, each with another wrong outline."""
ROUGH_PX = 0.2
"""Of the outline, network pixels; the shipped network's is about 0.3."""
MIN_AREA_PX = 200.0
SHAPE = ELONGATED["hook"]
_NO_PICTURE: NDArray[np.uint8] = np.zeros((1, 1, 3), np.uint8)


class _RotatedContacts:
    """The contact turned to whole degrees, with its axes: drawn when first asked for."""

    def __init__(self, product: ProductFunctions) -> None:
        self._product = product
        self._known: dict[tuple[int, int], tuple[Patch, dict[str, AxisEstimate]]] = {}

    def at(self, angle_deg: int, variant: int) -> tuple[Patch, dict[str, AxisEstimate]]:
        """variant: 0 for a clean outline. The same for the same numbers."""
        key = (angle_deg % 360, variant)
        if key not in self._known:
            rough = roughness(np.random.default_rng(key), ROUGH_PX if variant else 0.0)
            shown = soft(SHAPE, ShapePose(float(key[0])), rough)
            patch = self._product.find_patch(shown, THRESHOLD, MIN_AREA_PX, MAP_PX)
            if patch is None:
                raise ValueError(f"no patch at {angle_deg} degrees")
            self._known[key] = (patch, {"moments": self._product.estimate(patch, "moments")})
        return self._known[key]


def _begin(product: ProductFunctions) -> TrialFunction:
    contacts = _RotatedContacts(product)
    # Outlines alone: reliefs, keys and left-out frames are those of the family `holding`.
    meter = RotationMeter(PerceptionSettings(reference="first", estimator="registration"), MAP_PX)
    meter.tracker = product.tracker()
    frame = 0

    def measured(angle_deg: int, variant: int) -> RotationEstimate:
        patch, axes = contacts.at(angle_deg, variant)

        def axes_of(every: bool) -> Mapping[str, AxisEstimate]:
            return axes

        return meter.measure(_NO_PICTURE, patch, axes_of, frame * FRAME_S, StageTimer(None))[0]

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        nonlocal frame
        if frame == 0:
            results.call("meter", measured, REFERENCE_DEG, 0)
        errors = []
        for variant in rng.integers(1, VARIANTS + 1, STRETCH_FRAMES):
            frame += 1
            truth = round(SWING_DEG * math.sin(2.0 * math.pi * frame / STRETCH_FRAMES))
            rotation = results.call("meter", measured, REFERENCE_DEG + truth, int(variant))
            if rotation is None:
                return
            error = results.check_angle("meter", rotation.rotation_deg, rotation.sigma_deg, float(truth), axial=False)
            if error is not None and rotation.rotation_deg is not None:
                errors.append(rotation.rotation_deg - truth)
        if errors:
            results.check_limit(DRIFT, abs(float(np.mean(errors))), DRIFT_DEG)

    return trial


TRACKING = TrialFamily(
    "drift",
    "a million frames that swing over every seam, through registration and track",
    1000,
    270.0,
    _begin,
    STRETCH_FRAMES,
    continuous=True,
    min_answered_share=0.95,
)
