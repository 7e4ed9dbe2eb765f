"""Measures rotation and shift of a contact since the reference."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.estimate import StageTimer
from slipguard.perception.rotation.axis import AxisEstimation, PatchAxes, rotation_of_axes
from slipguard.perception.rotation.fusion import (
    RotationEstimate,
    fuse_rotation,
    is_certain,
    needs_contour,
    widen_for_slip,
)
from slipguard.perception.rotation.lasting_twist import LastingTwist
from slipguard.perception.rotation.reference import Reference, ReferenceSelector, RotationMeasurement, make_reference
from slipguard.perception.rotation.rotation_tracker import GAP_S, RotationTracker
from slipguard.perception.rotation.segmented_texture import SegmentedTexture
from slipguard.perception.rotation.shift_meter import ShiftMeasurement
from slipguard.perception.rotation.texture_map import TextureMap, TextureMapReader
from slipguard.perception.rotation.texture_tracker import TrackedTexture
from slipguard.perception.settings import PerceptionSettings

UNKNOWN_SIGMAS = 2.0
"""Factor on sigma without a background image."""
GROWTH_SIGMAS = 2.0
"""Factor on sigma for each doubling or halving of the contact area since the reference, for contacts without edges and
without a background image: force changes their contour in other ways than a rotation."""


@dataclass(frozen=True, slots=True, eq=False)
class _Contact:
    """A segmented contact in the frame of `now_s`, to be measured against the reference.

    texture_map: its texture; None where that is not used. axes: by the fast estimator. predicted_deg: the expected
    rotation. center_shift_px: how far its center has moved, frame pixels right and down. lost: whether the rotation has
    been unknown for longer than `GAP_S`.
    """

    now_s: float
    patch: Patch
    texture_map: TextureMap | None
    axes: PatchAxes
    predicted_deg: float
    center_shift_px: tuple[float, float]
    lost: bool


@dataclass(frozen=True, slots=True)
class _Fused:
    """Rotation by texture, contour and axis; the texture; the contour's shift in frame pixels; the axes used."""

    rotation: RotationEstimate
    found: TrackedTexture | None
    contour_shift_px: tuple[float, float]
    axes: PatchAxes
    by_texture: bool


class RotationMeter:
    """Takes the reference and measures every patch against it.

    Args:
        settings: Estimator, reference and limits.
        axes: Estimates the axes of patches.
        background: The unit's background image, (320, 240, 3) uint8, or None: then the texture is not used.
        noise_bgr: Standard deviation of a pixel, gray levels; None if unknown: sigmas are larger then.
        tracker: Tracks the rotation.
    """

    def __init__(
        self,
        settings: PerceptionSettings,
        axes: AxisEstimation,
        background: NDArray[np.uint8] | None = None,
        noise_bgr: NDArray[np.floating] | None = None,
        tracker: RotationTracker | None = None,
    ) -> None:
        self.reference: Reference | None = None
        self._settings = settings
        self._fuses_axis = settings.estimator == "fused"
        self._registers = self._fuses_axis or settings.estimator == "registration"
        self._axes = axes
        self._reader = None if background is None else TextureMapReader(background, noise_bgr)
        self._tracker = RotationTracker() if tracker is None else tracker
        self._choice = ReferenceSelector(settings.reference == "first")
        self._segmented: SegmentedTexture | None = None
        self._twist = LastingTwist()
        self._tried: tuple[float, TextureMap | None, TrackedTexture | None] = (-math.inf, None, None)

    @property
    def carried_deg(self) -> float:
        """Rotation up to the present reference, which is part of every rotation; 0 for the first reference."""
        return self._choice.carried_deg

    def rate_deg_s(self, now_s: float) -> float | None:
        """Return the rotation rate at `now_s`; None if unknown."""
        return self._tracker.rate_deg_s(now_s)

    def note_no_contact(self) -> None:
        """Require a new run of stable frames for a reference that is not taken yet."""
        self._choice.note_no_contact()

    def note_unchanged(self, now_s: float) -> None:
        """Note that the image at `now_s` shows no change: the rotation is still the last one."""
        self._tracker.unchanged(now_s)

    def note_kept(self, now_s: float) -> None:
        """Note that the frame of `now_s` is not measured, and that its rotation is known to be unchanged."""
        self._note_gap(now_s)
        self._tracker.note_kept(now_s)

    def measure(self, image: NDArray[np.uint8], patch: Patch, now_s: float, timer: StageTimer) -> RotationMeasurement:
        """Measure rotation and shift since the reference, which this patch may become.

        The texture and the fast axis are measured first. Contour and further axes follow only if these two are not
        enough (`needs_contour`); then the texture is searched again near the contour. `fuse_rotation` combines them.

        Args:
            image: The frame, (320, 240, 3) uint8 BGR.
            patch: The contact in it.
            now_s: Its capture time.
            timer: Collects the time per stage.
        """
        choice = self._choice
        stable = choice.is_stable(patch)
        if self.reference is not None:
            found = self._measure(self.reference, image, patch, now_s, self._axes.fast(patch, timer), timer)
            if not choice.outgrown(self.reference, found.rotation, patch, stable):
                return choice.with_carried(found)
            choice.carry(choice.with_carried(found))
        elif stable or choice.waited(now_s):
            choice.carry(None)
        else:
            axes = self._axes.fast(patch, timer)
            return RotationMeasurement(RotationEstimate(None, None, DeclineReason.NO_REFERENCE), None, axes)
        reference = self.take_reference(image, patch, now_s, timer)
        choice.provisional = not stable
        return choice.with_carried(self._measure(reference, image, patch, now_s, reference.fast_axes, timer))

    def _measure(
        self,
        reference: Reference,
        image: NDArray[np.uint8],
        patch: Patch,
        now_s: float,
        axes: PatchAxes,
        timer: StageTimer,
    ) -> RotationMeasurement:
        """Measure rotation and shift since the reference."""
        predicted_deg = self._predicted_deg(reference, now_s)
        self._note_gap(now_s)
        texture_map, found = self._texture_in(reference, image, patch, now_s)
        (x, y), (before_x, before_y) = patch.center_px, reference.patch.center_px
        lost = now_s - self._tracker.known_at_s > GAP_S
        contact = _Contact(now_s, patch, texture_map, axes, predicted_deg, (x - before_x, y - before_y), lost)
        fused = self._fuse(reference, contact, found, timer)
        if fused.found is not None and fused.found.fit is not None:
            self._segmented = SegmentedTexture(now_s, fused.found.fit, fused.found.rotation, fused.rotation)
        shift = reference.shift.measure(now_s, patch, fused.found, fused.contour_shift_px)
        return self._accept(now_s, reference, fused.rotation, patch, shift, fused.found, fused.axes, fused.by_texture)

    def _texture_in(
        self, reference: Reference, image: NDArray[np.uint8], patch: Patch, now_s: float
    ) -> tuple[TextureMap | None, TrackedTexture | None]:
        """Return the texture map, and what `measure_texture` has found in this frame if that is certain."""
        self._segmented = None
        (tried_at_s, texture_map, found), self._tried = self._tried, (-math.inf, None, None)
        if tried_at_s != now_s or texture_map is None or found is None or found.rotation.rotation_deg is None:
            return self._read_texture(reference, image, patch), None
        if reference.texture is not None:
            reference.texture.take_key_if_due(texture_map, patch, found)
        return texture_map, found

    def _fuse(self, reference: Reference, contact: _Contact, found: TrackedTexture | None, timer: StageTimer) -> _Fused:
        """Return the rotation by what the setting asks for; the contour follows if texture and axis are not enough.

        found: the texture if it has been found already.
        """
        axis = rotation_of_axes(reference.fast_axes, contact.axes, contact.predicted_deg)
        if not self._registers:
            return _Fused(fuse_rotation(None, None, axis), None, contact.center_shift_px, contact.axes, False)
        if found is None:
            found = self._find_texture(reference, contact, axis)
        if contact.lost and found is not None and found.rotation.rotation_deg is not None:
            contact = replace(contact, predicted_deg=found.rotation.rotation_deg)
            axis = rotation_of_axes(reference.fast_axes, contact.axes, contact.predicted_deg)
        timer.mark("relief")  # the texture; the name is a key of the JSON of `bench`
        texture = None if found is None else found.rotation

        remembers = reference.texture is not None and reference.texture.remembers
        if remembers or not needs_contour(texture, axis):  # memory distorts contour and axis too, and uncorrected
            rotation = fuse_rotation(texture, None, axis if self._fuses_axis and not remembers else None)
            return _Fused(rotation, found, contact.center_shift_px, contact.axes, True)
        return self._fuse_with_contour(reference, contact, found, axis, timer)

    def _find_texture(self, reference: Reference, contact: _Contact, axis: RotationEstimate) -> TrackedTexture | None:
        texture, texture_map = reference.texture, contact.texture_map
        if texture is None or texture_map is None:
            return None
        if (contact.lost or texture.periods.ambiguous) and not (texture.round or texture.periods.repeats):
            return texture.search_everywhere(texture_map, contact.patch, contact.predicted_deg, contact.now_s)
        return texture.track(texture_map, contact.patch, contact.predicted_deg, axis)

    def _fuse_with_contour(
        self,
        reference: Reference,
        contact: _Contact,
        found: TrackedTexture | None,
        axis: RotationEstimate,
        timer: StageTimer,
    ) -> _Fused:
        """Register the contour, from where texture or axis point; then search the texture again near the contour."""
        axes, patch, predicted_deg = contact.axes, contact.patch, contact.predicted_deg
        texture = None if found is None else found.rotation
        certain = texture is not None and is_certain(texture)
        if not certain:
            axes = reference.axes if patch is reference.patch else self._axes.all(patch, axes, timer)
            axis = rotation_of_axes(reference.axes, axes, predicted_deg)
        near_deg = predicted_deg if texture is None or texture.rotation_deg is None else texture.rotation_deg
        contour = reference.contour.measure(patch, axis, near_deg, contact.center_shift_px, from_axis=not certain)
        by_contour = contour.rotation
        if reference.texture is not None and reference.texture.periods.ambiguous and axis.rotation_deg is None:
            by_contour = RotationEstimate(None, None, DeclineReason.PERIOD_AMBIGUOUS)  # a nut's contour repeats too
        timer.mark("register")
        if found is not None and contact.texture_map is not None and reference.texture is not None and not contact.lost:
            shape = contour.axis if by_contour.rotation_deg is None else by_contour
            found = reference.texture.track_again(
                contact.texture_map, patch, predicted_deg, found, shape, contour.shift_px
            )
        timer.mark("relief")
        shared_deg = 0.0 if found is None else found.shared_deg
        rotation = fuse_rotation(
            None if found is None else found.rotation,
            by_contour.widened(shared_deg),
            contour.axis.widened(shared_deg) if self._fuses_axis else None,
            1.0 if found is None else found.deformation,
            shared_deg,
        )
        return _Fused(rotation, found, contour.shift_px, axes, False)

    def measure_texture(self, image: NDArray[np.uint8], patch: Patch, now_s: float) -> RotationMeasurement | None:
        """Measure by the texture alone, in the contact of an earlier frame; None if that is not enough.

        It is enough while the texture has moved as a whole: neither its scale, its strength nor its correlation with
        the reference have changed since `measure`. If it is not certain, it shows the rotation since then; a round one
        shows the shift since then, and its contact stays round.
        """
        reference, before = self.reference, self._segmented
        if reference is None or reference.texture is None or before is None or self._tracker.offered_deg is not None:
            return None
        if not self._registers or self._choice.carries:
            return None
        lost = now_s - self._tracker.known_at_s > GAP_S
        if (lost or self._choice.provisional) and not reference.texture.round:
            return None
        predicted_deg = self._predicted_deg(reference, now_s)
        self._note_gap(now_s)
        texture_map = self._read_texture(reference, image, patch)
        if texture_map is None or (reference.texture.periods.ambiguous and not reference.texture.round):
            return None
        no_axis = RotationEstimate(None, None)
        found = reference.texture.track(texture_map, patch, predicted_deg, no_axis, own_patch=False)
        self._tried = now_s, texture_map, found
        rotation = before.rotation_in(found, now_s)
        if rotation is None:
            return None
        shift = reference.shift.follow(now_s, found)
        reference.prepare()  # this frame takes little time
        return self._accept(now_s, reference, rotation, patch, shift, found, {}, by_texture=rotation is found.rotation)

    def take_reference(
        self,
        image: NDArray[np.uint8],
        patch: Patch,
        now_s: float,
        timer: StageTimer,
        rotation_deg: float | None = None,
    ) -> Reference:
        """Make a patch the reference and return it.

        Args:
            image: The frame, (320, 240, 3) uint8 BGR.
            patch: The contact in it.
            now_s: The current time.
            timer: Collects the time per stage.
            rotation_deg: The last known rotation since a stored reference; None: the patch is the current one.
        """
        axes = self._axes.fast(patch, timer)
        self.reference = make_reference(image, patch, self._axes, axes, self._reader, rotation_deg)
        self._twist = LastingTwist()
        timer.mark("reference")
        self._tracker.start(now_s, rotation_deg or 0.0)
        self._segmented = None
        return self.reference

    def _predicted_deg(self, reference: Reference, now_s: float) -> float:
        """Return the expected rotation; where periods are counted, by the newest rate, which lags least."""
        if now_s == self._tracker.known_at_s:  # the reference's own frame; the search for a period can wait
            return self._tracker.predicted_deg(now_s)
        if reference.texture is None or reference.texture.periods.period_deg is None:
            return self._tracker.predicted_deg(now_s)
        return self._tracker.extrapolated_deg(now_s)

    def _accept(
        self,
        now_s: float,
        reference: Reference,
        rotation: RotationEstimate,
        patch: Patch,
        contact_shift: ShiftMeasurement,
        found: TrackedTexture | None,
        axes: PatchAxes,
        by_texture: bool = False,
    ) -> RotationMeasurement:
        """Decline a rotation that is too uncertain, implausible or the gel's own; add it to the history otherwise."""
        shift = reference.shift.at_axis(contact_shift, rotation.rotation_deg or 0.0)
        growth = patch.area_px / max(reference.patch.area_px, 1)
        factor = GROWTH_SIGMAS ** abs(math.log2(max(growth, 1e-3)))
        moved_px = 0.0 if shift.shift_px is None else math.hypot(*shift.shift_px)
        twist_deg, lean = (0.0, 0.0) if found is None else (found.twist_deg, found.lean)
        if rotation.rotation_deg is not None:
            rate_deg_s = self._tracker.rate_deg_s(now_s)
            twist_deg = self._twist.largest_deg(now_s, twist_deg, rotation.rotation_deg, rate_deg_s)
        rotation = widen_for_slip(rotation, twist_deg, reference.gel_contour.smooth)
        rotation = reference.gel_contour.check(rotation, patch, factor, lean, moved_px)
        if self._reader is None and rotation.sigma_deg is not None:
            rotation = replace(rotation, sigma_deg=UNKNOWN_SIGMAS * factor * rotation.sigma_deg)
        limit = self._settings.sigma_max_deg
        if rotation.sigma_deg is not None and rotation.sigma_deg > limit:
            detail = f"sigma {rotation.sigma_deg:.1f} deg, limit {limit:g} deg"
            rotation = RotationEstimate(None, None, explain(DeclineReason.UNCERTAIN, detail))
        rotation = self._tracker.accept(now_s, rotation, by_texture)
        # While the rotation is declined, the axis is taken to be where it last was: a jump would look like a slip.
        return RotationMeasurement(rotation, reference.shift.at_axis(contact_shift, self._tracker.last_deg), axes)

    def _note_gap(self, now_s: float) -> None:
        """Pass on the time since the rotation was last known: a periodic texture may have rotated by a period."""
        if self.reference is None or self.reference.texture is None:
            return
        tracker, periods = self._tracker, self.reference.texture.periods
        periods.note_gap(now_s - tracker.known_at_s, tracker.last_rate_deg_s, tracker.unexpected_deg)

    def _read_texture(self, reference: Reference, image: NDArray[np.uint8], patch: Patch) -> TextureMap | None:
        if self._reader is None or reference.texture is None or not self._registers:
            return None
        return reference.texture_map if image is reference.image else self._reader.read(image, patch)
