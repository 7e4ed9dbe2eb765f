"""The daemon's pipeline: it needs a background image, and resumes with a stored reference after a restart."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.estimate import DeclineReason, Estimate, explain
from slipguard.perception.patch import Patch
from slipguard.perception.pipeline import Pipeline

MATCHES_AFTER = 3
"""The stored reference matches after this many rotations measured against it."""
DIFFERS_AFTER = 8
"""It differs after this many frames with contact but without a rotation."""
NO_BACKGROUND = explain(DeclineReason.NO_BACKGROUND, "run `slipguard calibrate` with the jaws open and empty")
"""Why a finger that is not calibrated gives no rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredReference:
    """A finger's reference. image: (320, 240, 3) uint8 BGR, the reference frame.

    rotation_deg: the last known rotation since then. earlier_rotation_deg: the rotation before this reference.
    """

    image: NDArray[np.uint8]
    rotation_deg: float
    earlier_rotation_deg: float = 0.0


class ResumingPipeline:
    """A `Pipeline` that can continue with a stored reference, and declines every rotation without a background image.

    While it is unknown whether the stored reference matches, every rotation is declined. If it does not match, the next
    stable contact becomes a new reference, and rotations continue from the last known one.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._stored: StoredReference | None = None
        self._matching_frames = self._differing_frames = 0
        self.stored_reference_state: Literal["waiting", "matches", "differs"] | None = None
        """Result of the check; None without a stored reference, or after `reset_reference`."""
        self.earlier_rotation_deg = 0.0
        """Rotation before the reference, added to every estimate."""

    @property
    def last_patch(self) -> Patch | None:
        """The last contact, at the network's resolution; None without contact."""
        return self._pipeline.last_patch

    @property
    def has_reference(self) -> bool:
        return self._pipeline.has_reference

    @property
    def reference_image(self) -> NDArray[np.uint8] | None:
        """The reference frame; None without a reference, or while a stored one is being checked."""
        return None if self.stored_reference_state == "waiting" else self._pipeline.reference_image

    @property
    def carried_deg(self) -> float:
        """Rotation before the reference that the pipeline itself adds to every estimate."""
        return self._pipeline.carried_deg

    def resume(self, stored: StoredReference, now_s: float) -> None:
        """Check `stored` on the next frames.

        Raises:
            FrameCorrupt: Its image is not a gel image.
        """
        self.reset_reference()
        self.stored_reference_state, self._stored = "waiting", stored
        self.earlier_rotation_deg = stored.earlier_rotation_deg
        if not self._pipeline.restore_reference(stored.image, now_s, stored.rotation_deg):
            self._replace_reference(stored)

    def reset_reference(self) -> None:
        """Forget the reference, a stored one too; the next stable contact becomes a new one, with rotation 0."""
        self._pipeline.reset_reference()
        self.stored_reference_state, self._stored, self.earlier_rotation_deg = None, None, 0.0
        self._matching_frames = self._differing_frames = 0

    def process(self, frame: Frame) -> Estimate:
        """Estimate contact and rotation in one frame.

        Raises:
            FrameCorrupt: The frame is not a gel image.
        """
        estimate = self._pipeline.process(frame)
        if estimate.contact and not self._pipeline.calibrated:
            return replace(estimate.without_motion(NO_BACKGROUND), shift_declined=None)
        if self._stored is not None and estimate.contact:
            self._check(estimate, self._stored)
        if self.stored_reference_state == "waiting" and estimate.contact:
            declined = estimate.without_motion(explain(DeclineReason.NO_REFERENCE, "checking the stored one"))
            return replace(declined, shift_declined=None)
        if estimate.rotation_deg is None:
            return estimate
        return replace(estimate, rotation_deg=estimate.rotation_deg + self.earlier_rotation_deg)

    def keep_estimate(self, captured_at_s: float) -> None:
        """Note a frame that is not processed because the other finger showed that nothing rotates."""
        self._pipeline.keep_estimate(captured_at_s)

    def _check(self, estimate: Estimate, stored: StoredReference) -> None:
        """Count whether rotations can be measured against the stored reference, and decide."""
        self._matching_frames += estimate.rotation_deg is not None
        self._differing_frames += estimate.rotation_deg is None
        if self._matching_frames >= MATCHES_AFTER:
            self.stored_reference_state, self._stored = "matches", None
        elif self._differing_frames >= DIFFERS_AFTER:
            self._replace_reference(stored)

    def _replace_reference(self, stored: StoredReference) -> None:
        self.reset_reference()
        self.stored_reference_state = "differs"
        self.earlier_rotation_deg = stored.earlier_rotation_deg + stored.rotation_deg
