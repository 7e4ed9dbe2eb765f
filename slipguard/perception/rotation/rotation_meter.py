"""The turn and shift of a patch since the reference, and when a patch becomes the reference."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.rotation.contour_registration import NOT_SAME, ContourFit, ContourPose, ContourRegistrar
from slipguard.perception.rotation.contour_template import ContourTemplate, make_contour_template
from slipguard.perception.rotation.period import possible_rotation_deg
from slipguard.perception.rotation.texture_map import TextureMap, TextureMapReader
from slipguard.perception.rotation.texture_registration import make_texture_template
from slipguard.perception.rotation.texture_tracker import AMBIGUOUS_PERIOD, TextureTracker, TrackedTexture
from slipguard.perception.rotation.tracker import (
    AGREE_SIGMA,
    RotationEstimate,
    RotationTracker,
    agree,
    checked,
    combined,
    less_sure,
    pooled,
    rotation_between_axes,
)
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stage_timer import StageTimer

STABLE_FRAMES = 5
STABLE_SHARE = 0.05
"""The contact area is stable when the last five frames differ by less than this share of it."""
MISFIT_SIGMAS = 1.5
"""An axis whose outline is not the reference's any more is off by so many times the turn that fits the misfit."""
SURE_DEG = 0.8
"""A turn told by the relief this surely, and not contradicted by the patch's axis, needs no outline."""
AGAIN_DEG = 4.0
"""An outline turned by so much more than the relief tells where the relief is looked for once more."""
NO_RELIEF = "no relief without a no-contact image"
NO_REFERENCE = "no reference yet"
UNSURE = "too uncertain"


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What turns are measured against. axes: by estimator. Centre and area in frame pixels.

    image: the frame it was taken from, (320, 240, 3) uint8. relief: follows the relief in the contact; None without a
    no-contact image.
    """

    image: NDArray[np.uint8]
    axes: Mapping[str, AxisEstimate]
    patch: Patch
    relief: TextureTracker | None
    center_px: tuple[float, float]
    area_px: int


class RotationMeter:
    """Takes the reference and measures every patch against it.

    frame_px: frame pixels per network pixel. background: the unit's no-contact image, (320, 240, 3) uint8, or None.
    noise_bgr: standard deviation of a pixel, grey levels; None where it is not known: sigmas are larger then.
    """

    def __init__(
        self,
        settings: PerceptionSettings,
        frame_px: float,
        background: NDArray[np.uint8] | None = None,
        noise_bgr: NDArray[np.floating] | None = None,
    ) -> None:
        self._settings = settings
        self._frame_px = frame_px
        self._reader = None if background is None else TextureMapReader(background, noise_bgr)
        self.reference: Reference | None = None
        self.tracker = RotationTracker()
        self._template: ContourTemplate | None = None
        self._pose = ContourPose()
        self._lost_count = False
        self._unseen_deg = 0.0
        self._stands_at_s = -math.inf
        self._areas: deque[int] = deque(maxlen=STABLE_FRAMES)

    def lost(self) -> None:
        """There is no contact: a reference not yet taken needs a new run of stable frames."""
        self._areas.clear()

    def keep_estimate(self, now_s: float) -> None:
        """The frame of `now_s` is not measured, and the turn is known to be as it was: a count goes on."""
        self._keep_count(now_s)
        self._stands_at_s = now_s

    def measure(
        self,
        image: NDArray[np.uint8],
        patch: Patch,
        axes_of: Callable[[bool], Mapping[str, AxisEstimate]],
        now_s: float,
        clock: StageTimer,
    ) -> tuple[RotationEstimate, tuple[float, float] | None]:
        """Turn and shift (frame pixels right and down) since the reference, which this patch may become.

        image: the frame, (320, 240, 3) uint8 BGR. axes_of: the patch's axes; called with False for the plainest one
        alone, with True for those of every estimator asked for; each is compared with its own answer for the reference.
        """
        self._take_reference(image, patch, axes_of, now_s, clock)
        reference = self.reference
        if reference is None:
            return RotationEstimate(None, None, NO_REFERENCE), None
        predicted = self.tracker.predicted_deg(now_s)
        rotation = self._axial(reference, axes_of(False), predicted)
        self._keep_count(now_s)
        followed = TrackedTexture(None, None, None, 1.0, NO_RELIEF)
        relief: TextureMap | None = None
        if self._settings.estimator in ("fused", "registration"):
            relief = self._read(reference, image, patch)
            followed = self._by_relief(reference, relief, patch, predicted, rotation)
            clock.mark("relief")
        by_relief = RotationEstimate(followed.rotation_deg, followed.sigma_deg, followed.declined)
        shift_px = followed.shift(lambda: _difference(_centre_px(patch), reference.center_px))
        sure = by_relief.sigma_deg is not None and by_relief.sigma_deg <= SURE_DEG
        if sure and agree(by_relief, rotation):
            rotation = combined(by_relief, rotation) if self._settings.estimator == "fused" else by_relief
        else:
            # A sure relief needs but one witness against the axis: its own turn, tried on the outline.
            rotation = rotation if sure else self._axial(reference, axes_of(True), predicted)
            by_outline = rotation
            if self._settings.estimator in ("fused", "registration"):
                near = predicted if by_relief.rotation_deg is None else by_relief.rotation_deg
                by_outline, laid, outline_shift_px = self._by_outline(reference, patch, rotation, near, only_near=sure)
                clock.mark("register")
                followed = self._again(reference, relief, patch, predicted, followed, laid, outline_shift_px)
                by_relief = RotationEstimate(followed.rotation_deg, followed.sigma_deg, followed.declined)
                clock.mark("relief")
                shift_px = followed.shift(lambda: outline_shift_px)
            rotation = combined(by_relief, less_sure(by_outline, followed.unlike))
        if rotation.sigma_deg is not None and rotation.sigma_deg > self._settings.sigma_max_deg:
            rotation = RotationEstimate(None, None, UNSURE)
        return self.tracker.accept(now_s, rotation), shift_px

    def _take_reference(
        self,
        image: NDArray[np.uint8],
        patch: Patch,
        axes_of: Callable[[bool], Mapping[str, AxisEstimate]],
        now_s: float,
        clock: StageTimer,
    ) -> None:
        if self.reference is not None:
            return
        self._areas.append(patch.area_px)
        if self._settings.reference == "stable":
            largest, smallest = max(self._areas), min(self._areas)
            if len(self._areas) < STABLE_FRAMES or largest - smallest >= STABLE_SHARE * largest:
                return
        self.refer_to(image, patch, axes_of, now_s, clock)

    def refer_to(
        self,
        image: NDArray[np.uint8],
        patch: Patch,
        axes_of: Callable[[bool], Mapping[str, AxisEstimate]],
        now_s: float,
        clock: StageTimer,
        rotation_deg: float | None = None,
    ) -> None:
        """This patch is the reference from now on.

        rotation_deg: how far the object had turned when it was last seen, where that is an old patch; None: it is as now.
        """
        relief = None
        if self._reader is not None:
            self._reader.learn(image, patch)
            texture = make_texture_template(self._reader.read(image, patch), patch)
            relief = None if texture is None else TextureTracker(texture)
        clock.mark("reference")
        axes = dict(axes_of(True))
        self.reference = Reference(image, axes, patch, relief, _centre_px(patch), patch.area_px)
        clock.mark("reference")
        self.tracker.start(now_s, rotation_deg or 0.0)
        self._template = None
        self._pose = ContourPose(rotation_deg or 0.0)
        self._lost_count = rotation_deg is not None and relief is not None and relief.period_deg is not None
        self._stands_at_s = -math.inf

    def _axial(self, reference: Reference, axes: Mapping[str, AxisEstimate], predicted_deg: float) -> RotationEstimate:
        known = reference.axes
        return pooled([_between(known[name], axis, predicted_deg) for name, axis in axes.items() if name in known])

    def _keep_count(self, now_s: float) -> None:
        """What repeats itself may have turned by a step since it was last seen: its count is lost."""
        relief = None if self.reference is None else self.reference.relief
        if relief is None or self._lost_count:
            return
        tracker = self.tracker
        known_at_s = tracker.known_at_s
        if known_at_s < self._stands_at_s <= now_s:
            known_at_s = self._stands_at_s
        self._unseen_deg = possible_rotation_deg(now_s - known_at_s, tracker.rate_deg_s(tracker.known_at_s) or 0.0)
        self._lost_count = relief.leaps(0.0, self._unseen_deg)

    def _read(self, reference: Reference, image: NDArray[np.uint8], patch: Patch) -> TextureMap | None:
        """The relief in the contact, None where the reference has none."""
        return None if self._reader is None or reference.relief is None else self._reader.read(image, patch)

    def _by_relief(
        self,
        reference: Reference,
        relief: TextureMap | None,
        patch: Patch,
        predicted_deg: float,
        axial: RotationEstimate,
    ) -> TrackedTexture:
        """The turn by the relief in the contact, from where the track leads, or the axis where a count is lost."""
        track = reference.relief
        if relief is None or track is None:
            return TrackedTexture(None, None, None, 1.0, NO_RELIEF)
        if not self._lost_count:
            return track.follow(relief, patch, predicted_deg, possible_rotation_deg=self._unseen_deg)
        step_deg = track.period_deg or 0.0
        if axial.rotation_deg is None or axial.sigma_deg is None or AGREE_SIGMA * axial.sigma_deg >= 0.5 * step_deg:
            return TrackedTexture(None, None, None, 1.0, AMBIGUOUS_PERIOD)
        found = track.follow(relief, patch, axial.rotation_deg)
        self._lost_count = found.rotation_deg is None
        return found

    def _again(
        self, reference: Reference, relief: TextureMap | None, patch: Patch, predicted_deg: float, found: TrackedTexture,
        outline: RotationEstimate, shift_px: tuple[float, float],
    ) -> TrackedTexture:  # fmt: skip
        """The relief looked for once more where the outline is, where that is far from where it was looked for."""
        track = reference.relief
        before_deg = predicted_deg if found.rotation_deg is None else found.rotation_deg
        if relief is None or track is None or self._lost_count or outline.rotation_deg is None:
            return found
        if abs(outline.rotation_deg - before_deg) <= AGAIN_DEG:
            return found
        again = track.follow(
            relief, patch, predicted_deg, (outline.rotation_deg, shift_px), possible_rotation_deg=self._unseen_deg
        )
        if again.sigma_deg is None or again.sigma_deg >= (found.sigma_deg or 180.0):
            return found
        return again

    def _by_outline(
        self, reference: Reference, patch: Patch, rotation: RotationEstimate, near_deg: float, only_near: bool
    ) -> tuple[RotationEstimate, RotationEstimate, tuple[float, float]]:
        """The turn by the outline, checked by the one that the axes show; unchecked, or the axes' alone; the shift.

        near_deg: where to look for it first. only_near: and not from where the axes point.
        """
        shift_px = _difference(_centre_px(patch), reference.center_px)
        laid = self._laid_over(reference, patch, RotationEstimate(None, None) if only_near else rotation, near_deg)
        registered = RotationEstimate(None, None, laid.declined)
        if laid.declined == NOT_SAME and rotation.rotation_deg is not None and rotation.sigma_deg is not None:
            # An outline that has become another one has moved its axis too.
            rotation = RotationEstimate(
                rotation.rotation_deg, math.hypot(rotation.sigma_deg, MISFIT_SIGMAS * laid.misfit_deg)
            )
        if laid.declined is None:
            self._pose = laid.pose
            registered = RotationEstimate(laid.pose.rotation_deg, laid.sigma_deg)
            shift_px = (laid.pose.dx_px * self._frame_px, laid.pose.dy_px * self._frame_px)
        if self._lost_count and rotation.rotation_deg is None:
            registered = RotationEstimate(None, None, AMBIGUOUS_PERIOD)  # a nut's outline repeats with its relief
        only = self._settings.estimator == "registration"
        laid_rotation = rotation if registered.rotation_deg is None else registered
        return registered if only else checked(registered, rotation), laid_rotation, shift_px

    def _laid_over(self, reference: Reference, patch: Patch, rotation: RotationEstimate, near_deg: float) -> ContourFit:
        """The patch laid over the reference, from a turn that is likely or from where its axis points."""
        if self._template is None:  # made when it is first needed: many grasps never ask for the outline
            self._template = make_contour_template(reference.patch)
        registrar = ContourRegistrar(self._template, patch)
        best = registrar.fit(replace(self._pose, rotation_deg=near_deg))
        if rotation.rotation_deg is None or abs(rotation.rotation_deg - best.pose.rotation_deg) < 4.0:
            return best
        dx, dy = _difference(_centre_px(patch), reference.center_px)
        other = registrar.fit(ContourPose(rotation.rotation_deg, dx / self._frame_px, dy / self._frame_px))
        better = other.declined is None and (best.declined is not None or other.residual < best.residual)
        return other if better else best


def _between(reference: AxisEstimate, now: AxisEstimate, near_deg: float) -> RotationEstimate:
    """The turn between two answers of one estimator."""
    if reference.angle_deg is None or reference.sigma_deg is None:
        return RotationEstimate(None, None, reference.declined)
    if now.angle_deg is None or now.sigma_deg is None:
        return RotationEstimate(None, None, now.declined)
    return rotation_between_axes(now.angle_deg, now.sigma_deg, reference.angle_deg, reference.sigma_deg, near_deg)


def _centre_px(patch: Patch) -> tuple[float, float]:
    """Centre of the patch in frame pixels, right and down."""
    m = cv2.moments(patch.mask, True)
    return patch.to_frame(m["m10"] / m["m00"], m["m01"] / m["m00"])


def _difference(now: tuple[float, float], before: tuple[float, float]) -> tuple[float, float]:
    return (now[0] - before[0], now[1] - before[1])
