"""One finger's way from a gel frame to an estimate: gate, segment, regions, thin, angle, register, track."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.perception.contact.change_detector import ChangeDetector
from slipguard.perception.contact.gate import Blocks, ContactGate, block_means, near_patch
from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.estimate import AxisEstimate, Estimate
from slipguard.perception.quality.dead_lines import DeadLines
from slipguard.perception.quality.image_quality import image_defect, in_other_light
from slipguard.perception.rotation.axial_angle import wrap_axial_deg
from slipguard.perception.rotation.axis import estimate, fuse, skeleton_orientation
from slipguard.perception.rotation.rotation_meter import RotationMeter
from slipguard.perception.rotation.skeleton import middle_line
from slipguard.perception.settings import ALL_SKIPS, PerceptionSettings, Skips
from slipguard.perception.stage_timer import StageTimer

NO_CONTACT = "no contact"
UNCHANGED = "unchanged"


class ContactSegmenter(Protocol):
    """What the pipeline needs of a segmentation network."""

    @property
    def threshold(self) -> float: ...

    @property
    def input_size(self) -> tuple[int, int]: ...

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]: ...


class Pipeline:
    """Estimates one finger's contact, frame after frame. Not thread-safe: one worker per finger.

    background: the unit's no-contact image, (320, 240, 3) uint8, or None (then no frame skips the network for lack of
    contact). noise: standard deviation of a pixel, grey levels, (3,) B G R or anything that averages to it; or None.
    px_per_mm: scale of the frame. rotation_deg: how far the sensor is mounted turned counter-clockwise, one of 0, 90,
    180, 270; it turns the reported orientation and shift. timer: seconds, for `Estimate.stage_ms`; None leaves it
    empty. skips: what may be left out, all but for measurements.
    """

    def __init__(
        self,
        segmenter: ContactSegmenter,
        settings: PerceptionSettings,
        background: NDArray[np.uint8] | None,
        noise: Sequence[float] | NDArray[np.floating] | None,
        px_per_mm: float,
        mounting_deg: int = 0,
        timer: Callable[[], float] | None = None,
        skips: Skips = ALL_SKIPS,
    ) -> None:
        if mounting_deg not in (0, 90, 180, 270):
            raise InputError(f"rotation_deg is {mounting_deg}; a sensor is mounted at 0, 90, 180 or 270")
        if not px_per_mm > 0.0:
            raise InputError(f"px_per_mm is {px_per_mm}; the scale of a DIGIT frame is about 18.5")
        try:
            self._dead = DeadLines(background)
            background = None if background is None else self._dead.filled(background)
            self._gate = ContactGate(background, noise, settings.gate_sigma)
        except FrameCorrupt as error:
            raise InputError(f"no-contact image: {error}") from error
        self._segmenter = segmenter
        self._settings = settings
        self._background = background
        self._px_per_mm = px_per_mm
        self._mounting_deg = mounting_deg
        self._timer = timer
        self._threshold: float = segmenter.threshold if settings.threshold is None else settings.threshold
        self._frame_px = FRAME_WIDTH_PX / segmenter.input_size[0]
        self._patch: Patch | None = None
        self._skeleton: NDArray[np.uint8] | None = None
        self._skips = skips
        self._still: ChangeDetector | None = None
        if settings.skip_unchanged and skips.unchanged and self._gate.noise_known:
            self._still = ChangeDetector(self._gate.per_std, self._gate.background)
        self._measured: Estimate | None = None
        self.reset_reference()

    def reset_reference(self) -> None:
        """Forget the reference; the next stable contact makes a new one."""
        noise_bgr = self._gate.noise_bgr if self._gate.noise_known else None
        self._meter = RotationMeter(self._settings, self._frame_px, self._background, noise_bgr)
        self._reference_unlike = 0.0
        self._forget()

    @property
    def has_reference(self) -> bool:
        return self._meter.reference is not None

    @property
    def reference_area_px(self) -> int | None:
        """Contact area of the reference in frame pixels."""
        return None if self._meter.reference is None else self._meter.reference.area_px

    @property
    def last_patch(self) -> Patch | None:
        """The contact found last, at the network's resolution; None without contact."""
        return self._patch

    @property
    def last_mask(self) -> NDArray[np.uint8]:
        """The contact found last, (320, 240) uint8, 0 or 1: of the probability enlarged, its outline is finer."""
        if self._patch is None:
            return np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.uint8)
        coarse = self._patch.full_mask()
        near = cv2.dilate(coarse, np.ones((3, 3), np.uint8)) * self._patch.full_probability()  # no speck beside it
        fine = np.asarray(cv2.resize(near, (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)) > self._threshold, np.uint8)
        return fine if fine.any() else resize_mask_to_frame(coarse)

    @property
    def last_skeleton(self) -> NDArray[np.uint8]:
        """The thinned contact found last, (320, 240) uint8, 0 or 1; thinned now where the turn did not need it."""
        if self._patch is None:
            return np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.uint8)
        if self._skeleton is None:
            self._skeleton = middle_line(self._patch).skeleton
        return resize_mask_to_frame(replace(self._patch, mask=self._skeleton).full_mask())

    def process(self, frame: Frame) -> Estimate:
        """Measure one frame. Raises `FrameCorrupt` for a frame that is no gel picture."""
        clock = StageTimer(self._timer)
        now_s = frame.captured_at_s
        image = self._dead.filled(frame.image)
        blocks = block_means(image)
        if not math.isfinite(now_s):
            raise FrameCorrupt(f"frame {frame.sequence} has no capture time ({now_s}); it is left out")
        if self._skips.no_contact and not self._gate.may_be_contact(blocks):
            self._forget()
            clock.mark("gate")
            return self._without_contact(frame, NO_CONTACT, clock)
        unchanged = self._still is not None and self._still.unchanged(blocks)
        if self._still is not None and self._still.restored:
            self._measured = None
        reused = self._reused(frame) if unchanged else None
        clock.mark("gate")
        if reused is not None:
            return replace(reused, stage_ms=clock.stage_ms)
        probability = self._segmenter.segment(image, self._background)
        clock.mark("segment")
        patch = find_patch(probability, self._threshold, self._settings.min_area_px, self._frame_px)
        self._patch, self._skeleton = patch, None
        clock.mark("regions")
        if patch is None:
            answer = self._without_contact(frame, None, clock)
            self._note(blocks, None, unchanged, answer)
            return answer
        near = near_patch(patch.full_mask())
        why, unlike = image_defect(self._gate, image, blocks, near)
        if why is not None:
            return self._unfit(frame, patch, why, clock)
        axes: dict[str, AxisEstimate] = {}

        def axes_of(every: bool) -> dict[str, AxisEstimate]:
            self._add_axes(axes, patch, every, clock)
            return axes

        had_reference = self.has_reference
        rotation, shift_px = self._meter.measure(image, patch, axes_of, now_s, clock)
        if not had_reference:
            self._reference_unlike = unlike
        rotation = in_other_light(rotation, unlike - self._reference_unlike)
        shown = fuse(list(axes_of(False).values())).angle_deg
        answer = Estimate(
            sequence=frame.sequence,
            captured_at_s=now_s,
            measured_at_s=now_s,
            contact=True,
            contact_area_px=patch.area_px,
            method=self._settings.estimator,
            angle_deg=rotation.rotation_deg,
            sigma_deg=rotation.sigma_deg,
            orientation_deg=None if shown is None else wrap_axial_deg(shown + self._mounting_deg),
            rate_deg_s=None if rotation.rotation_deg is None else self._meter.tracker.rate_deg_s(now_s),
            shift_mm=None if shift_px is None else self._shift_mm(shift_px),
            declined=rotation.declined,
            stage_ms=clock.stage_ms,
        )
        clock.mark("track")
        self._note(blocks, near, unchanged, answer)
        return answer

    def keep_estimate(self, captured_at_s: float) -> None:
        """A frame that is not handed in, the other finger's having shown that nothing turns."""
        self._meter.keep_estimate(captured_at_s)

    def _note(self, blocks: Blocks, near: NDArray[np.bool_] | None, unchanged: bool, answer: Estimate) -> None:
        self._measured = answer
        if self._still is not None:
            self._still.note(blocks, near, answer.captured_at_s, unchanged)

    def _forget(self) -> None:
        self._measured = None
        if self._still is not None:
            self._still.forget()

    def _unfit(self, frame: Frame, patch: Patch, why: str, clock: StageTimer) -> Estimate:
        """Contact perhaps, but nothing to measure on, and no reference to take."""
        self._forget()
        return self._unmeasured(frame, patch, why, None, clock)

    def _without_contact(self, frame: Frame, skipped: str | None, clock: StageTimer) -> Estimate:
        self._patch, self._skeleton = None, None
        return self._unmeasured(frame, None, NO_CONTACT, skipped, clock)

    def _unmeasured(
        self, frame: Frame, patch: Patch | None, declined: str, skipped: str | None, clock: StageTimer
    ) -> Estimate:
        self._meter.lost()
        return Estimate(
            sequence=frame.sequence,
            captured_at_s=frame.captured_at_s,
            measured_at_s=frame.captured_at_s,
            contact=patch is not None,
            contact_area_px=0 if patch is None else patch.area_px,
            method=self._settings.estimator,
            skipped=skipped,
            declined=declined,
            stage_ms=clock.stage_ms,
        )

    def _reused(self, frame: Frame) -> Estimate | None:
        """The last answer for an unchanged picture, where it is young, the contact clear and long at rest."""
        answer, still, now_s = self._measured, self._still, frame.captured_at_s
        if answer is None or still is None or not 0.0 <= now_s - answer.measured_at_s < self._settings.refresh_s:
            return None
        if answer.contact and self._meter.reference is None:
            return None  # a reference needs measured frames
        if not still.at_rest(now_s) or (answer.contact and not still.telling(answer.angle_deg is not None)):
            return None
        rate = answer.rate_deg_s
        if answer.angle_deg is not None:
            self._meter.tracker.unchanged(frame.captured_at_s)
            rate = self._meter.tracker.rate_deg_s(frame.captured_at_s)
        return replace(
            answer, sequence=frame.sequence, captured_at_s=frame.captured_at_s, rate_deg_s=rate, skipped=UNCHANGED
        )

    def _add_axes(self, axes: dict[str, AxisEstimate], patch: Patch, every: bool, clock: StageTimer) -> None:
        """The patch's axis by the plainest estimator, or by every one that the setting asks for.

        What is there already is not measured again; a patch without an axis is not thinned.
        """
        name, aspect = str(self._settings.estimator), self._settings.round_aspect
        if name == "skeleton":
            if not axes:
                axes["skeleton"] = self._skeleton_axis(patch, clock)
            return
        plain = "moments" if name in ("fused", "registration") else name
        if plain not in axes:
            axes[plain] = estimate(patch, plain, aspect)
            clock.mark("angle")
        readable = axes[plain].declined is None
        if name != "fused" or not every or "skeleton" in axes:
            return
        if readable:
            axes["ellipse"] = estimate(patch, "ellipse", aspect)
            clock.mark("angle")
        if readable or not self._skips.round:
            axes["skeleton"] = self._skeleton_axis(patch, clock)

    def _skeleton_axis(self, patch: Patch, clock: StageTimer) -> AxisEstimate:
        line = middle_line(patch)
        self._skeleton = line.skeleton
        clock.mark("thin")
        axis = skeleton_orientation(patch, line, self._settings.round_aspect)
        clock.mark("angle")
        return axis

    def _shift_mm(self, shift_px: tuple[float, float]) -> tuple[float, float]:
        """Frame pixels right and down to millimetres right and up, as the mounting turns them."""
        c, s = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[self._mounting_deg]
        right, up = shift_px[0] / self._px_per_mm, -shift_px[1] / self._px_per_mm
        return (c * right - s * up, s * right + c * up)


def resize_mask_to_frame(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A mask of the network's resolution as (320, 240) uint8."""
    size = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)
    return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
