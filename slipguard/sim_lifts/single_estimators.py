"""The rotation by each single estimator, computed from the contact patches of a lift."""

from __future__ import annotations

from dataclasses import dataclass

from slipguard.devices import Frame
from slipguard.perception.axis import ESTIMATORS, estimate_axis, rotation_between_axes
from slipguard.perception.estimate import Estimate
from slipguard.perception.patch import Patch
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stored_reference import ResumingPipeline
from slipguard.sim_lifts.lift_record import IMAGE_SIGN, EstimatedRotation

SIGMA_MAX_DEG = PerceptionSettings().sigma_max_deg


@dataclass(frozen=True, slots=True, eq=False)
class TimedPatch:
    """A contact patch and when its frame was captured."""

    finger: str
    captured_at_s: float
    patch: Patch


class PatchRecorder:
    """A pipeline that appends every measured patch to a list."""

    def __init__(self, finger: str, pipeline: Pipeline | ResumingPipeline, patches: list[TimedPatch]) -> None:
        self._finger = finger
        self._pipeline = pipeline
        self._patches = patches

    def process(self, frame: Frame) -> Estimate:
        result = self._pipeline.process(frame)
        patch = self._pipeline.last_patch
        if patch is not None and result.skipped is None and result.segmented and self._pipeline.has_reference:
            self._patches.append(TimedPatch(self._finger, frame.captured_at_s, patch))
        return result

    def keep_estimate(self, captured_at_s: float) -> None:
        """Keep the last estimate for a frame that is skipped because the other finger shows no rotation."""
        self._pipeline.keep_estimate(captured_at_s)

    def reset_reference(self) -> None:
        self._pipeline.reset_reference()

    @property
    def last_patch(self) -> Patch | None:
        return self._pipeline.last_patch


def rotations_by_estimator(
    seen: list[TimedPatch], from_s: float, to_s: float
) -> dict[str, list[list[EstimatedRotation]]]:
    """Return, per estimator and finger, the unwrapped rotation since the first patch, in the left image's sign.

    As in the pipeline, there is no entry where an estimator declines or its sigma exceeds `sigma_max_deg`, and none at
    all if it declines for the reference.
    """
    patches = {
        finger: [one for one in seen if one.finger == finger and from_s <= one.captured_at_s <= to_s]
        for finger in IMAGE_SIGN
    }
    return {
        name: [_rotations(patches[finger], name, sign) for finger, sign in IMAGE_SIGN.items()] for name in ESTIMATORS
    }


def _rotations(seen: list[TimedPatch], name: str, sign: float) -> list[EstimatedRotation]:
    if not seen:
        return []
    reference = estimate_axis(seen[0].patch, name)
    rotations: list[EstimatedRotation] = []
    near_deg = 0.0
    for one in seen:
        rotation = rotation_between_axes(estimate_axis(one.patch, name), reference, near_deg)
        if rotation.rotation_deg is None or rotation.sigma_deg is None or rotation.sigma_deg > SIGMA_MAX_DEG:
            continue
        near_deg = rotation.rotation_deg
        rotations.append(EstimatedRotation(one.captured_at_s, sign * rotation.rotation_deg, rotation.sigma_deg))
    return rotations
