"""One finger's perception: from a gel frame to an estimate of the object's rotation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import FrameCorrupt, FrameTorn, InputError
from slipguard.perception.axis import wrap_axial_deg
from slipguard.perception.background import DeadLines
from slipguard.perception.estimate import DeclineReason, Estimate, explain
from slipguard.perception.image_quality import REFUSED_MAX_S, ImageQuality, find_tear
from slipguard.perception.patch import Patch, find_patch, resize_mask_to_frame
from slipguard.perception.rotation_meter import RotationMeasurement, RotationMeter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.shift_meter import ShiftMeasurement
from slipguard.perception.skipping import (
    ALL_SKIPS,
    BLOCKS_HIGH,
    BLOCKS_WIDE,
    UNCHANGED,
    Blocks,
    ChangeDetector,
    ContactGate,
    Skips,
    block_means,
    blocks_near,
)

SEGMENT_S = 0.2
"""The network runs again after this time at the latest: on every twelfth frame at 60 Hz."""


class ContactSegmenter(Protocol):
    """What the pipeline needs of a segmentation network."""

    @property
    def threshold(self) -> float: ...

    @property
    def input_size(self) -> tuple[int, int]: ...

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]: ...


@dataclass(frozen=True, slots=True, eq=False)
class _WholeContact:
    """The last segmented contact.

    blocks: (1200, 3) block means. near: (1200,) bool, the blocks in and next to it. away: (1200,) float32, 0 for these
    and the blocks next to them, which it may reach until the next one, 1 elsewhere.
    """

    blocks: Blocks
    near: NDArray[np.bool_]
    away: NDArray[np.float32]
    segmented_s: float


class Pipeline:
    """Estimates one finger's contact, frame after frame. Not thread-safe: one worker per finger.

    The first stable contact becomes the reference, and rotations are counted from there:

    >>> from slipguard.datasets.rendered_grasps import render_grasp
    >>> from slipguard.perception import Pipeline
    >>> from slipguard.perception.segmenter import Segmenter
    >>> grasp = render_grasp("wrench", seed=1)
    >>> pipeline = Pipeline(Segmenter(), PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
    >>> estimates = [pipeline.process(shot.frame) for shot in grasp.shots]
    >>> estimates[0].declined
    'no contact'
    >>> abs(estimates[80].rotation_deg - grasp.shots[80].rotation_deg) < 3.0 * estimates[80].sigma_deg
    True

    Args:
        segmenter: The segmentation network.
        settings: The section `[perception]` of the configuration.
        background: The unit's background image, (320, 240, 3) uint8, or None: then every frame runs the network.
        noise: Standard deviation of a pixel, gray levels: (3,) B G R, or an array that averages to it; or None.
        px_per_mm: Scale of the frame.
        mounting_deg: Counter-clockwise rotation of the sensor's mounting, one of 0, 90, 180, 270; it applies to the
            reported orientation and shift.
        timer: Returns seconds, for `Estimate.stage_ms`; None leaves it empty.
        skips: Stages that may be skipped; all, except for measurements.

    Raises:
        InputError: A parameter is out of range, or the background image is not one of a gel.
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
            raise InputError(f"mounting_deg is {mounting_deg}; set 0, 90, 180 or 270")
        if not px_per_mm > 0.0:
            raise InputError(f"px_per_mm is {px_per_mm}; set the scale of the frame, about 18.5 for a DIGIT")
        try:
            dead_lines = DeadLines(background)
            self._dead_lines = dead_lines if dead_lines.rows or dead_lines.columns else None
            background = None if background is None else dead_lines.interpolate(background)
            self._gate = ContactGate(background, noise, settings.gate_noise_factor)
        except FrameCorrupt as error:
            raise InputError(f"background image: {error}") from error
        self._quality = ImageQuality(background)
        self._previous: tuple[NDArray[np.uint8], float] | None = None
        """The last frame that was not refused as torn, and its capture time."""
        self._segmenter = segmenter
        self._settings = settings
        self._background = background
        self._px_per_mm = px_per_mm
        self._mounting_deg = mounting_deg
        self._timer = timer
        self._threshold: float = segmenter.threshold if settings.threshold is None else settings.threshold
        self._frame_px = FRAME_WIDTH_PX / segmenter.input_size[0]
        self._skips = skips
        self._skips_unchanged = settings.skip_unchanged and skips.unchanged and self._gate.noise_known
        self._changes = ChangeDetector(self._gate)
        self._patch: Patch | None = None
        self._measured: Estimate | None = None
        self._whole: _WholeContact | None = None
        self.reset_reference()

    def reset_reference(self) -> None:
        """Forget the reference; the next stable contact becomes a new one."""
        noise_bgr = self._gate.noise_bgr if self._gate.noise_known else None
        self._meter = RotationMeter(self._settings, self._background, noise_bgr)
        self._forget_measured()

    @property
    def calibrated(self) -> bool:
        """Whether there is a background image: without one, rotations are only those of the mask's axis."""
        return self._background is not None

    @property
    def has_reference(self) -> bool:
        return self._meter.reference is not None

    @property
    def reference_image(self) -> NDArray[np.uint8] | None:
        """The reference frame, (320, 240, 3) uint8; None without a reference."""
        return None if self._meter.reference is None else self._meter.reference.image

    @property
    def carried_deg(self) -> float:
        """Rotation before the reference, part of every estimate; 0 unless the reference followed a growing contact."""
        return self._meter.carried_deg

    @property
    def last_patch(self) -> Patch | None:
        """The last contact, at the network's resolution; None without contact."""
        return self._patch

    @property
    def last_mask(self) -> NDArray[np.uint8]:
        """The last contact, (320, 240) uint8, 0 or 1: of the enlarged probability, which gives a finer contour."""
        if self._patch is None:
            return np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.uint8)
        coarse = self._patch.full_mask()
        near = cv2.dilate(coarse, np.ones((3, 3), np.uint8)) * self._patch.full_probability()  # without other regions
        fine = np.asarray(cv2.resize(near, (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)) > self._threshold, np.uint8)
        return fine if fine.any() else resize_mask_to_frame(coarse)

    def process(self, frame: Frame) -> Estimate:
        """Estimate contact and rotation in one frame.

        Raises:
            FrameCorrupt: The frame is not a gel image.
            FrameTorn: Its two parts are from different captures.
        """
        timer = StageTimer(self._timer)
        image, now_s = self._repaired(frame.image), frame.captured_at_s
        blocks = block_means(image)
        if not math.isfinite(now_s):
            raise FrameCorrupt(f"frame {frame.sequence} has no capture time ({now_s}); the frame is skipped")
        previous, self._previous = self._previous, (image, now_s)
        unchanged = self._skips_unchanged and self._changes.unchanged(blocks)
        timer.mark("gate")
        if unchanged and self._may_repeat(now_s):
            return self._repeated(frame, timer)
        by_texture = self._measure_texture(image, blocks, frame, timer)
        if by_texture is not None:  # even in a torn frame: a texture that has moved as a whole is in between its parts
            return self._note_measured(blocks, None if self._whole is None else self._whole.near, unchanged, by_texture)
        if self._skips.no_contact and not self._gate.may_be_contact(blocks):
            self._forget_measured()
            self._patch = None
            unusable = self._quality.check(image, blocks, None)
            timer.mark("gate")
            no_contact = str(DeclineReason.NO_CONTACT)
            return self._declined(frame, unusable or no_contact, timer, None if unusable else no_contact)
        if previous is not None and 0.0 <= now_s - previous[1] < REFUSED_MAX_S:
            tear = find_tear(image, previous[0])
            timer.mark("gate")
            if tear is not None:
                self._previous = previous
                parts = f"frame {frame.sequence} is torn at {tear}: its parts are from different captures"
                raise FrameTorn(f"{parts}; it is skipped")
        return self._measure_segmented(image, blocks, frame, unchanged, timer)

    def _measure_segmented(
        self, image: NDArray[np.uint8], blocks: Blocks, frame: Frame, unchanged: bool, timer: StageTimer
    ) -> Estimate:
        """Return the estimate by the network's contact."""
        self._whole = None
        patch = self._patch = self._find_patch(image, timer)
        near = np.zeros(len(blocks), np.bool_) if patch is None else blocks_near(patch.full_mask())
        unusable = self._quality.check(image, blocks, near)
        timer.mark("regions")
        if unusable is not None:
            self._forget_measured()
            return self._declined(frame, unusable, timer)
        if patch is None:
            return self._note_measured(blocks, None, unchanged, self._declined(frame, DeclineReason.NO_CONTACT, timer))
        measurement = self._meter.measure(image, patch, frame.captured_at_s, timer.mark)
        timer.mark("relief")  # the texture
        estimate = self._estimate(frame, patch, measurement, timer)
        timer.mark("track")
        measured = estimate.rotation_deg is not None or estimate.decline_reason == DeclineReason.ROUND
        if measured and measurement.shift is not None:
            away = (~blocks_near(near.reshape(BLOCKS_HIGH, BLOCKS_WIDE).astype(np.uint8))).astype(np.float32)
            self._whole = _WholeContact(blocks, near, away, frame.captured_at_s)
        return self._note_measured(blocks, near, unchanged, estimate)

    def _find_patch(self, image: NDArray[np.uint8], timer: StageTimer) -> Patch | None:
        probability = self._segmenter.segment(image, self._background)
        timer.mark("segment")
        return find_patch(probability, self._threshold, self._settings.min_area_px, self._frame_px)

    def _measure_texture(
        self, image: NDArray[np.uint8], blocks: Blocks, frame: Frame, timer: StageTimer
    ) -> Estimate | None:
        """Return the estimate by the texture alone, if the contact has only moved since it was segmented."""
        whole, patch, now_s = self._whole, self._patch, frame.captured_at_s
        if whole is None or patch is None or not self._skips.whole or not 0.0 <= now_s - whole.segmented_s < SEGMENT_S:
            return None
        if self._gate.changed(blocks, whole.blocks, whole.away):
            return None
        measurement = self._meter.measure_texture(image, patch, now_s)
        timer.mark("relief")
        if measurement is None or measurement.shift is None:
            return None
        estimate = self._estimate(frame, patch, measurement, timer)
        timer.mark("track")
        return replace(estimate, segmented=False)

    def _estimate(self, frame: Frame, patch: Patch, measurement: RotationMeasurement, timer: StageTimer) -> Estimate:
        rotation, shift, axis_deg = measurement.rotation, measurement.shift, measurement.orientation_deg
        now_s = frame.captured_at_s
        return Estimate(
            sequence=frame.sequence,
            captured_at_s=now_s,
            measured_at_s=now_s,
            contact=True,
            contact_area_px=patch.area_px,
            contact_radius_mm=self._radius_mm(patch),
            method=self._settings.estimator,
            rotation_deg=rotation.rotation_deg,
            sigma_deg=rotation.sigma_deg,
            orientation_deg=None if axis_deg is None else wrap_axial_deg(axis_deg + self._mounting_deg),
            rate_deg_s=measurement.rate_deg_s,
            shift_mm=None if shift is None or shift.shift_px is None else self._shift_mm(shift.shift_px),
            shift_declined=None if shift is None else self._shift_declined(shift),
            slides=shift is not None and shift.slides,
            declined=None if rotation.declined is None else str(rotation.declined),
            stage_ms=timer.stage_ms,
        )

    def keep_estimate(self, captured_at_s: float) -> None:
        """Note a frame that is not processed because the other finger showed that nothing rotates."""
        self._meter.note_kept(captured_at_s)

    def restore_reference(self, image: NDArray[np.uint8], now_s: float, rotation_deg: float) -> bool:
        """Make a stored image the reference.

        Args:
            image: (320, 240, 3) uint8 BGR.
            now_s: The current time.
            rotation_deg: The last known rotation since that image.

        Returns:
            False if it shows no contact, or not this unit's gel in focus: then there is no reference.

        Raises:
            FrameCorrupt: It is not a gel image.
        """
        self.reset_reference()
        image = self._repaired(image)
        blocks = block_means(image)
        timer = StageTimer(None)
        patch = self._find_patch(image, timer)
        if patch is None or self._quality.check(image, blocks, blocks_near(patch.full_mask())) is not None:
            return False
        self._meter.take_reference(image, patch, now_s, timer.mark, rotation_deg)
        return True

    def _repaired(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return image if self._dead_lines is None else self._dead_lines.interpolate(image)

    def _may_repeat(self, now_s: float) -> bool:
        """Return whether the last estimate is recent, and its contact clear and at rest."""
        last = self._measured
        if last is None or not 0.0 <= now_s - last.measured_at_s < self._settings.refresh_s:
            return False
        if last.contact and not self.has_reference:
            return False  # a reference needs measured frames
        return self._changes.at_rest(now_s, with_rotation=last.rotation_deg is not None)

    def _repeated(self, frame: Frame, timer: StageTimer) -> Estimate:
        """Return the last estimate for an unchanged image."""
        last, now_s = self._measured, frame.captured_at_s
        assert last is not None
        rate_deg_s = last.rate_deg_s
        if last.rotation_deg is not None:
            self._meter.note_unchanged(now_s)
            rate_deg_s = self._meter.rate_deg_s(now_s)
        return replace(
            last,
            sequence=frame.sequence,
            captured_at_s=now_s,
            rate_deg_s=rate_deg_s,
            skipped=UNCHANGED,
            stage_ms=timer.stage_ms,
        )

    def _declined(self, frame: Frame, declined: str, timer: StageTimer, skipped: str | None = None) -> Estimate:
        """Return an estimate without a rotation; a reference that is not taken yet needs a new run of stable frames."""
        self._meter.note_no_contact()
        return Estimate(
            sequence=frame.sequence,
            captured_at_s=frame.captured_at_s,
            measured_at_s=frame.captured_at_s,
            contact=self._patch is not None,
            contact_area_px=0 if self._patch is None else self._patch.area_px,
            contact_radius_mm=None if self._patch is None else self._radius_mm(self._patch),
            method=self._settings.estimator,
            skipped=skipped,
            declined=str(declined),
            stage_ms=timer.stage_ms,
        )

    def _note_measured(
        self, blocks: Blocks, near: NDArray[np.bool_] | None, unchanged: bool, estimate: Estimate
    ) -> Estimate:
        self._measured = estimate
        if self._skips_unchanged:
            self._changes.add(blocks, near, estimate.captured_at_s, unchanged)
        return estimate

    def _forget_measured(self) -> None:
        self._measured, self._whole = None, None
        self._changes.reset()

    def _shift_declined(self, shift: ShiftMeasurement) -> str | None:
        if shift.period_px is None:
            return None
        return explain(DeclineReason.SHIFT_AMBIGUOUS, f"by {shift.period_px / self._px_per_mm:.2f} mm")

    def _radius_mm(self, patch: Patch) -> float:
        return math.sqrt(patch.area_px / math.pi) / self._px_per_mm

    def _shift_mm(self, shift_px: tuple[float, float]) -> tuple[float, float]:
        """Convert frame pixels right and down to millimeters right and up, corrected for the mounting."""
        c, s = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[self._mounting_deg]
        right, up = shift_px[0] / self._px_per_mm, -shift_px[1] / self._px_per_mm
        return (c * right - s * up, s * right + c * up)


class StageTimer:
    """Collects milliseconds per pipeline stage. The stage names are keys of `bench`'s JSON.

    clock: returns seconds; None leaves `stage_ms` empty.
    """

    def __init__(self, clock: Callable[[], float] | None) -> None:
        self._clock = clock
        self.stage_ms: dict[str, float] = {}
        self._since_s = 0.0 if clock is None else clock()

    def mark(self, stage: str) -> None:
        """Add the time since the last mark to `stage`; a stage may be marked more than once."""
        if self._clock is None:
            return
        now_s = self._clock()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now_s - self._since_s)
        self._since_s = now_s
