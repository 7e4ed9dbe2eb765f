"""A pipeline that goes on with a reference from before a restart, where what it sees still is what was held then."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.gate import block_means, near_patch
from slipguard.perception.contact.patch import find_patch
from slipguard.perception.estimate import AxisEstimate, Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.stage_timer import StageTimer

MATCHES_AFTER = 3
"""So many turns told against the old reference, and it holds."""
DIFFERS_AFTER = 8
"""So many frames with contact that do not tell one, and it does not."""
CHECKING_STORED_REFERENCE = "recalling the reference"


@dataclass(frozen=True, slots=True, eq=False)
class StoredReference:
    """A finger's reference. image: (320, 240, 3) uint8 BGR, the frame it was taken from.

    rotation_deg: the last one known, from there. earlier_rotation_deg: what had been turned before.
    """

    image: NDArray[np.uint8]
    rotation_deg: float
    earlier_rotation_deg: float = 0.0


class ResumingPipeline(Pipeline):
    """A `Pipeline` whose turn can go on being counted from where it was.

    Until it is known whether the old reference still matches, every turn is declined. Where it does not, the next
    stable contact becomes a new one, and turns count on from the last one known.
    """

    stored_reference_state: Literal["waiting", "matches", "differs"] | None = None
    """What has come of an old reference; None where there was none, or a new one has been asked for since."""
    earlier_rotation_deg = 0.0
    """What is added to turns since the reference: what had been turned before it."""
    _known: StoredReference | None = None
    _told = _untold = 0

    @property
    def reference_image(self) -> NDArray[np.uint8] | None:
        """The frame the reference was taken from; None while there is none, or while it is not known to hold."""
        reference = self._meter.reference
        return None if reference is None or self.stored_reference_state == "waiting" else reference.image

    def recall(self, known: StoredReference, now_s: float) -> None:
        """Try `known` on the frames to come. Raises FrameCorrupt for what is no gel picture."""
        self.reset_reference()
        self.stored_reference_state, self._known, self.earlier_rotation_deg = (
            "waiting",
            known,
            known.earlier_rotation_deg,
        )
        image = self._dead.filled(known.image)
        blocks = block_means(image)
        probability = self._segmenter.segment(image, self._background)
        patch = find_patch(probability, self._threshold, self._settings.min_area_px, self._frame_px)
        if patch is None:
            self._differs(known)
            return
        near = near_patch(patch.full_mask())
        unlike = self._gate.unlike_levels(blocks, near)
        if not math.isfinite(unlike) or self._gate.out_of_focus(blocks, near):
            self._differs(known)
            return
        clock, axes = StageTimer(None), dict[str, AxisEstimate]()

        def axes_of(every: bool) -> dict[str, AxisEstimate]:
            self._add_axes(axes, patch, every, clock)
            return axes

        self._meter.refer_to(image, patch, axes_of, now_s, clock, known.rotation_deg)
        self._reference_unlike = unlike

    def reset_reference(self) -> None:
        """Forget the reference, an old one too; the next stable contact makes a new one, and turns count from it."""
        super().reset_reference()
        self.stored_reference_state, self._known, self.earlier_rotation_deg = None, None, 0.0
        self._told = self._untold = 0

    def process(self, frame: Frame) -> Estimate:
        """Measure one frame. Raises `FrameCorrupt` for a frame that is no gel picture."""
        answer = super().process(frame)
        if self._known is not None and answer.contact:
            self._try(answer, self._known)
        if self.stored_reference_state == "waiting" and answer.contact:
            return replace(
                answer,
                angle_deg=None,
                sigma_deg=None,
                rate_deg_s=None,
                shift_mm=None,
                declined=CHECKING_STORED_REFERENCE,
            )
        if answer.angle_deg is None or not self.earlier_rotation_deg:
            return answer
        return replace(answer, angle_deg=answer.angle_deg + self.earlier_rotation_deg)

    def _try(self, answer: Estimate, known: StoredReference) -> None:
        """Does the old reference tell the turn?"""
        self._told += answer.angle_deg is not None
        self._untold += answer.angle_deg is None
        if self._told >= MATCHES_AFTER:
            self.stored_reference_state, self._known = "matches", None
        elif self._untold >= DIFFERS_AFTER:
            self._differs(known)

    def _differs(self, known: StoredReference) -> None:
        self.reset_reference()
        self.stored_reference_state, self.earlier_rotation_deg = (
            "differs",
            known.earlier_rotation_deg + known.rotation_deg,
        )
