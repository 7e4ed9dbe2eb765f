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
from slipguard.perception.rotation.contour_registration import ContourFit, ContourPose, ContourRegistrar
from slipguard.perception.rotation.contour_template import ContourTemplate, make_contour_template
from slipguard.perception.rotation.fusion import (
    RotationEstimate,
    fuse_rotation,
    is_certain,
    needs_contour,
    widen_for_slip,
)
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
MISFIT_SIGMAS = 1.5
"""If the contour is not the reference's any more, the axis is off too: by this share of the contour's misfit."""
SECOND_START_DEG = 4.0
"""If the axis points further away than this from the registered contour, registration also starts from there."""


@dataclass(frozen=True, slots=True)
class _ContourMeasurement:
    """Rotation by the contour; the axis, widened if the contact has changed; shift in frame pixels right and down."""

    rotation: RotationEstimate
    axis: RotationEstimate
    shift_px: tuple[float, float]


class RotationMeter:
    """Takes the reference and measures every patch against it.

    Args:
        settings: Estimator, reference and limits.
        frame_px: Frame pixels per network pixel.
        axes: Estimates the axes of patches.
        background: The unit's background image, (320, 240, 3) uint8, or None: then the texture is not used.
        noise_bgr: Standard deviation of a pixel, gray levels; None if unknown: sigmas are larger then.
        tracker: Tracks the rotation.
    """

    def __init__(
        self,
        settings: PerceptionSettings,
        frame_px: float,
        axes: AxisEstimation,
        background: NDArray[np.uint8] | None = None,
        noise_bgr: NDArray[np.floating] | None = None,
        tracker: RotationTracker | None = None,
    ) -> None:
        self.reference: Reference | None = None
        self._settings = settings
        self._frame_px = frame_px
        self._axes = axes
        self._reader = None if background is None else TextureMapReader(background, noise_bgr)
        self._tracker = RotationTracker() if tracker is None else tracker
        self._template: ContourTemplate | None = None
        self._pose = ContourPose()
        self._choice = ReferenceSelector(settings.reference == "first")
        self._segmented: SegmentedTexture | None = None
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
        axes = self.take_reference(image, patch, now_s, timer)
        choice.provisional = not stable
        assert self.reference is not None
        return choice.with_carried(self._measure(self.reference, image, patch, now_s, axes, timer))

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
        name = self._settings.estimator
        predicted_deg = self._predicted_deg(reference, now_s)
        axis = rotation_of_axes(reference.axes, axes, predicted_deg)
        self._note_gap(now_s)
        lost = now_s - self._tracker.known_at_s > GAP_S
        center_px = patch.center_px
        center_shift_px = (center_px[0] - reference.center_px[0], center_px[1] - reference.center_px[1])

        if name not in ("fused", "registration"):
            shift = reference.shift.measure(now_s, patch, None, center_shift_px)
            return self._accept(now_s, reference, fuse_rotation(None, None, axis), patch, shift, None, axes)

        (tried_at_s, texture_map, found), self._tried = self._tried, (-math.inf, None, None)
        if tried_at_s != now_s or found is None or found.rotation.rotation_deg is None:
            texture_map, found = self._read_texture(reference, image, patch), None
        elif texture_map is not None and reference.texture is not None:
            reference.texture.take_key_if_due(texture_map, patch, found)
        if texture_map is not None and reference.texture is not None and found is None:
            if lost and not reference.texture.round and reference.texture.period_deg is None:
                found = reference.texture.search_everywhere(texture_map, patch, predicted_deg)
                if found.rotation.rotation_deg is not None:
                    predicted_deg = found.rotation.rotation_deg
                    axis = rotation_of_axes(reference.axes, axes, predicted_deg)
            else:
                found = reference.texture.track(texture_map, patch, predicted_deg, axis)
        timer.mark("relief")  # the texture; the name is a key of the JSON of `bench`
        self._segmented = None
        texture = None if found is None else found.rotation

        remembers = reference.texture is not None and reference.texture.remembers
        remembers = remembers and texture is not None and texture.rotation_deg is not None
        if remembers or not needs_contour(texture, axis):  # memory distorts contour and axis too
            rotation = fuse_rotation(texture, None, axis if name == "fused" and not remembers else None)
            self._note_segmented(now_s, found, rotation)
            shift = reference.shift.measure(now_s, patch, found, center_shift_px)
            return self._accept(now_s, reference, rotation, patch, shift, found, axes, by_texture=True)

        certain = texture is not None and is_certain(texture)
        if not certain:
            axes = self._axes.all(patch, axes, timer)
            axis = rotation_of_axes(reference.axes, axes, predicted_deg)
        near_deg = predicted_deg if texture is None or texture.rotation_deg is None else texture.rotation_deg
        contour = self._measure_contour(reference, patch, axis, near_deg, center_shift_px, from_axis=not certain)
        timer.mark("register")
        if found is not None and texture_map is not None and reference.texture is not None and not lost:
            shape = contour.axis if contour.rotation.rotation_deg is None else contour.rotation
            found = reference.texture.track_again(texture_map, patch, predicted_deg, found, shape, contour.shift_px)
        timer.mark("relief")
        uneven_deg = 0.0 if found is None else found.uneven_deg
        rotation = fuse_rotation(
            None if found is None else found.rotation,
            contour.rotation.widened(uneven_deg),
            contour.axis.widened(uneven_deg) if name == "fused" else None,
            1.0 if found is None else found.deformation,
            uneven_deg,
        )
        self._note_segmented(now_s, found, rotation)
        shift = reference.shift.measure(now_s, patch, found, contour.shift_px)
        return self._accept(now_s, reference, rotation, patch, shift, found, axes)

    def measure_texture(self, image: NDArray[np.uint8], patch: Patch, now_s: float) -> RotationMeasurement | None:
        """Measure by the texture alone, in the contact of an earlier frame; None if that is not enough.

        It is enough while the texture has moved as a whole: neither its scale, its strength nor its correlation with
        the reference have changed since `measure`. If it is not certain, it shows the rotation since then; a round one
        shows the shift since then, and its contact stays round.
        """
        reference, before = self.reference, self._segmented
        if reference is None or reference.texture is None or before is None or self._tracker.offered_deg is not None:
            return None
        if self._settings.estimator not in ("fused", "registration") or self._choice.carries:
            return None
        lost = now_s - self._tracker.known_at_s > GAP_S
        if (lost or self._choice.provisional) and not reference.texture.round:
            return None
        predicted_deg = self._predicted_deg(reference, now_s)
        self._note_gap(now_s)
        texture_map = self._read_texture(reference, image, patch)
        if texture_map is None or (reference.texture.ambiguous and not reference.texture.round):
            return None
        found = reference.texture.track(texture_map, patch, predicted_deg, RotationEstimate(None, None), take_key=False)
        self._tried = now_s, texture_map, found
        rotation = before.rotation_in(found, now_s)
        if rotation is None:
            return None
        shift = reference.shift.follow(now_s, found)
        return self._accept(now_s, reference, rotation, patch, shift, found, {}, by_texture=rotation is found.rotation)

    def _note_segmented(self, now_s: float, found: TrackedTexture | None, fused: RotationEstimate) -> None:
        if found is not None and found.fit is not None:
            self._segmented = SegmentedTexture(now_s, found.fit, found.rotation, fused)

    def take_reference(
        self,
        image: NDArray[np.uint8],
        patch: Patch,
        now_s: float,
        timer: StageTimer,
        rotation_deg: float | None = None,
    ) -> PatchAxes:
        """Make a patch the reference.

        Args:
            image: The frame, (320, 240, 3) uint8 BGR.
            patch: The contact in it.
            now_s: The current time.
            timer: Collects the time per stage.
            rotation_deg: The last known rotation since a stored reference; None: the patch is the current one.

        Returns:
            The patch's axes by every estimator.
        """
        axes = self._axes.all(patch, self._axes.fast(patch, timer), timer)
        self.reference = make_reference(image, patch, axes, self._reader, rotation_deg is not None)
        timer.mark("reference")
        self._tracker.start(now_s, rotation_deg or 0.0)
        self._segmented = None
        self._template = None
        self._pose = ContourPose(rotation_deg or 0.0)
        return axes

    def _predicted_deg(self, reference: Reference, now_s: float) -> float:
        """Return the expected rotation; where periods are counted, by the newest rate, which lags least."""
        if now_s == self._tracker.known_at_s:  # the reference's own frame; the search for a period can wait
            return self._tracker.predicted_deg(now_s)
        if reference.texture is None or reference.texture.period_deg is None:
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
        rotation = widen_for_slip(rotation, twist_deg, reference.contour.smooth)
        rotation = reference.contour.check(rotation, patch, factor, lean, moved_px)
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
        tracker = self._tracker
        self.reference.texture.note_gap(now_s - tracker.known_at_s, tracker.last_rate_deg_s, tracker.unexpected_deg)

    def _read_texture(self, reference: Reference, image: NDArray[np.uint8], patch: Patch) -> TextureMap | None:
        return None if self._reader is None or reference.texture is None else self._reader.read(image, patch)

    def _measure_contour(
        self,
        reference: Reference,
        patch: Patch,
        axis: RotationEstimate,
        near_deg: float,
        center_shift_px: tuple[float, float],
        from_axis: bool,
    ) -> _ContourMeasurement:
        """Register the contour from `near_deg`, and also from where the axis points if `from_axis`."""
        fit = self._register(reference, patch, axis.rotation_deg if from_axis else None, near_deg, center_shift_px)
        rotation, shift_px = RotationEstimate(None, None, fit.declined), center_shift_px
        if fit.contact_changed and axis.rotation_deg is not None and axis.sigma_deg is not None:
            axis = RotationEstimate(axis.rotation_deg, math.hypot(axis.sigma_deg, MISFIT_SIGMAS * fit.misfit_deg))
        if fit.declined is None:
            self._pose = fit.pose
            rotation = RotationEstimate(fit.pose.rotation_deg, fit.sigma_deg)
            shift_px = (fit.pose.dx_px * self._frame_px, fit.pose.dy_px * self._frame_px)
        if reference.texture is not None and reference.texture.ambiguous and axis.rotation_deg is None:
            rotation = RotationEstimate(None, None, DeclineReason.PERIOD_AMBIGUOUS)  # a nut's contour repeats too
        return _ContourMeasurement(rotation, axis, shift_px)

    def _register(
        self,
        reference: Reference,
        patch: Patch,
        axis_deg: float | None,
        near_deg: float,
        center_shift_px: tuple[float, float],
    ) -> ContourFit:
        if self._template is None:  # made on first use: many grasps never need the contour
            self._template = make_contour_template(reference.patch)
        registrar = ContourRegistrar(self._template, patch)
        best = registrar.fit(replace(self._pose, rotation_deg=near_deg))
        if axis_deg is None or abs(axis_deg - best.pose.rotation_deg) < SECOND_START_DEG:
            return best
        dx, dy = center_shift_px
        other = registrar.fit(ContourPose(axis_deg, dx / self._frame_px, dy / self._frame_px))
        better = other.declined is None and (best.declined is not None or other.residual < best.residual)
        return other if better else best
