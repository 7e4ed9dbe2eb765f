"""Takes the reference and measures rotation and shift of later contacts against it.

A contact that has not become stable in time becomes the reference as it is. While it grows, a later contact replaces
it, and the rotation until then is carried over.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.axis import estimate_axis, rotation_between_axes, wrap_axial_deg
from slipguard.perception.estimate import AxisEstimate, DeclineReason, RotationEstimate, explain
from slipguard.perception.patch import Patch
from slipguard.perception.registration import Registration
from slipguard.perception.rotation_filter import Hypothesis, RotationFilter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.shift_meter import ShiftMeasurement, ShiftMeter
from slipguard.perception.texture_map import TextureMapReader
from slipguard.perception.texture_template import make_texture_template
from slipguard.perception.texture_tracker import TextureTracker, TrackedTexture

STABLE_FRAMES = 5
STABLE_SHARE = 0.05
"""The contact area is stable if the last five frames differ by less than this share of it."""
STABLE_WAIT_S = 0.095
"""A contact that is not stable after this time becomes the reference as it is: in three or six frames, below 0.1 s."""
GROWN = 1.5
CARRIED_SIGMA_DEG = 1.5
"""While the force grows, a reference that was not stable follows: it is replaced when the contact area has grown by
this factor, if the rotation until then is known to this sigma; that rotation is added from then on."""
ALIKE, ROTATION_DEG, SHIFT_PX = 0.03, 8.0, 3.0
"""Changes up to which a contact moves as a whole since it was segmented: correlation with the reference, rotation, and
shift (texture pixels). Beyond, the network runs again."""
SMOOTH_S = 0.02
"""Along a smooth shaft only the ends show a shift, which the network finds: it runs on every second frame at 60 Hz, so
that a slide is seen one frame later at most."""

Mark = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What rotations are measured against.

    image: the reference frame, (320, 240, 3) uint8. axis: the patch's axis. texture: follows the texture in the
    contact; None without a background image, for a single axis estimator, or if the contact has too little texture.
    shift: measures the shift since then.
    """

    image: NDArray[np.uint8]
    patch: Patch
    axis: AxisEstimate
    texture: TextureTracker | None
    shift: ShiftMeter

    def prepare(self) -> None:
        """Compute one thing that later frames may need, if any is missing; called in frames that take little time."""
        for owner, name in ((self.shift, "period"), (self.texture, "similar_deg")):
            if owner is not None and name not in vars(owner):
                getattr(owner, name)
                return


@dataclass(frozen=True, slots=True)
class RotationMeasurement:
    """Rotation since the reference, its shift (None without a reference), and the orientation of the contact's axis.

    orientation_deg: axial, in (-90, 90], counter-clockwise in the image; None if the rotation or the axis is unknown.
    rate_deg_s: None if the rotation or its rate is unknown.
    """

    rotation: RotationEstimate
    shift: ShiftMeasurement | None
    orientation_deg: float | None
    rate_deg_s: float | None = None

    def plus(self, before: RotationMeasurement | None) -> RotationMeasurement:
        """Add rotation and shift up to the present reference."""
        if before is None:
            return self
        rotation, shift, earlier = self.rotation, self.shift, before.shift
        if rotation.rotation_deg is not None:
            rotation_deg = rotation.rotation_deg + (before.rotation.rotation_deg or 0.0)
            sigma_deg = math.hypot(rotation.sigma_deg or 0.0, before.rotation.sigma_deg or 0.0)
            rotation = RotationEstimate(rotation_deg, sigma_deg)
        if shift is not None and earlier is not None and shift.shift_px is not None:
            x, y = earlier.shift_px or (0.0, 0.0)
            known = earlier.shift_px is not None
            shift = replace(
                shift,
                shift_px=(shift.shift_px[0] + x, shift.shift_px[1] + y) if known else None,
                period_px=shift.period_px or earlier.period_px,
            )
        return replace(self, rotation=rotation, shift=shift)


class ReferenceSelector:
    """Decides when a contact becomes the reference. first: whether the first one does, stable or not."""

    def __init__(self, first: bool) -> None:
        self._first = first
        self._areas: deque[int] = deque(maxlen=STABLE_FRAMES)
        self._contact_since_s: float | None = None
        self.provisional = False
        """Whether the reference was not stable when it was taken, and may still be replaced."""

    def note_no_contact(self) -> None:
        """Require a new run of stable frames for a reference that is not taken yet."""
        self._areas.clear()
        self._contact_since_s = None

    def accepts(self, patch: Patch, now_s: float, reference: Reference | None, rotation: RotationEstimate) -> bool:
        """Return whether a patch becomes the reference; rotation: since the present one."""
        self._areas.append(patch.area_px)
        if self._contact_since_s is None or now_s < self._contact_since_s:
            self._contact_since_s = now_s
        largest, smallest = max(self._areas), min(self._areas)
        stable = len(self._areas) == STABLE_FRAMES and largest - smallest < STABLE_SHARE * largest
        if reference is None:
            self.provisional = not (stable or self._first)
            return not self.provisional or now_s - self._contact_since_s >= STABLE_WAIT_S
        if not self.provisional or rotation.sigma_deg is None or rotation.sigma_deg > CARRIED_SIGMA_DEG:
            return False
        self.provisional = not stable
        return patch.area_px > GROWN * reference.patch.area_px


class RotationMeter:
    """Takes the reference and measures every patch against it.

    Args:
        settings: Estimator, reference and limits.
        background: The unit's background image, (320, 240, 3) uint8, or None: then the axis of the mask is used.
        noise_bgr: Standard deviation of a pixel, gray levels; None if unknown.
    """

    def __init__(
        self,
        settings: PerceptionSettings,
        background: NDArray[np.uint8] | None = None,
        noise_bgr: NDArray[np.floating] | None = None,
    ) -> None:
        self.reference: Reference | None = None
        self._settings = settings
        registers = settings.estimator == "registration"
        self._axis_estimator = "moments" if registers else str(settings.estimator)
        self._reader = TextureMapReader(background, noise_bgr) if registers and background is not None else None
        self._rotations = RotationFilter()
        self._choice = ReferenceSelector(settings.reference == "first")
        self._carried: RotationMeasurement | None = None
        """Rotation and shift from the first reference to the present one; None for the first one."""
        self._segmented: tuple[float, Registration] | None = None
        self._tracked: tuple[float, TrackedTexture] | None = None

    @property
    def carried_deg(self) -> float:
        """Rotation up to the present reference, which is part of every rotation; 0 for the first reference."""
        return 0.0 if self._carried is None else self._carried.rotation.rotation_deg or 0.0

    def rate_deg_s(self, now_s: float) -> float | None:
        """Return the rotation rate at `now_s`; None if unknown."""
        return self._rotations.rate_deg_s(now_s)

    def note_no_contact(self) -> None:
        """Require a new run of stable frames for a reference that is not taken yet."""
        self._choice.note_no_contact()

    def note_unchanged(self, now_s: float) -> None:
        """Note that the image at `now_s` shows no change: the rotation is still the last one."""
        self._rotations.unchanged(now_s)

    def note_kept(self, now_s: float) -> None:
        """Note that the frame of `now_s` is not measured, and that its rotation is known to be unchanged."""
        self._rotations.note_kept(now_s)

    def measure(self, image: NDArray[np.uint8], patch: Patch, now_s: float, mark: Mark) -> RotationMeasurement:
        """Measure rotation and shift since the reference, which this patch may become.

        Args:
            image: The frame, (320, 240, 3) uint8 BGR.
            patch: The contact in it.
            now_s: Its capture time.
            mark: Called at the end of a stage with its name.
        """
        found = RotationMeasurement(RotationEstimate(None, None, DeclineReason.NO_REFERENCE), None, None)
        if self.reference is not None:
            found = self._measure(self.reference, image, patch, now_s, mark)
        if self._choice.accepts(patch, now_s, self.reference, found.rotation):
            self._carried = None if self.reference is None else found
            reference = self.take_reference(image, patch, now_s, mark)
            found = self._measure(reference, image, patch, now_s, mark)
        return found

    def measure_texture(self, image: NDArray[np.uint8], patch: Patch, now_s: float) -> RotationMeasurement | None:
        """Measure by the texture alone, in the contact of an earlier frame; None if that is not enough.

        It is enough while the texture has moved as a whole since `measure`. A round one shows the shift since then, and
        its contact stays round.
        """
        reference, before = self.reference, self._segmented
        self._tracked = None
        if reference is None or reference.texture is None or before is None or self._choice.provisional:
            return None
        found = self._track(reference.texture, image, patch, now_s)
        self._tracked = now_s, found
        if found.rotation.declined is not None and not reference.texture.round:
            return None
        segmented_s, then = before
        pose, last = found.best.pose, then.pose
        if (
            found.best.alike < then.alike - ALIKE
            or abs(pose.rotation_deg - last.rotation_deg) > ROTATION_DEG
            or math.hypot(pose.dx_px - last.dx_px, pose.dy_px - last.dy_px) > SHIFT_PX
            or (reference.texture.smooth and now_s - segmented_s > SMOOTH_S)
        ):
            return None
        reference.prepare()  # this frame takes little time
        return self._checked(reference, found.rotation, now_s, found, None)

    def take_reference(
        self,
        image: NDArray[np.uint8],
        patch: Patch,
        now_s: float,
        mark: Mark,
        rotation_deg: float | None = None,
    ) -> Reference:
        """Make a patch the reference and return it.

        Args:
            image: The frame, (320, 240, 3) uint8 BGR.
            patch: The contact in it.
            now_s: The current time.
            mark: Called at the end of a stage with its name.
            rotation_deg: The last known rotation since a stored reference; None: the patch is the current one.
        """
        axis = self._axis(patch, mark)
        template = None
        if self._reader is not None:
            self._reader.learn(image, patch)
            template = make_texture_template(self._reader.read(image, patch), patch)
        texture = None if template is None else TextureTracker(template, self._rotations)
        self.reference = Reference(image, patch, axis, texture, ShiftMeter(template, patch))
        self._rotations.start(now_s, rotation_deg or 0.0, unseen=rotation_deg is not None)
        self._segmented = self._tracked = None
        mark("reference")
        return self.reference

    def _measure(
        self,
        reference: Reference,
        image: NDArray[np.uint8],
        patch: Patch,
        now_s: float,
        mark: Mark,
    ) -> RotationMeasurement:
        """Measure rotation and shift since the reference."""
        self._segmented = None
        found: TrackedTexture | None = None
        if reference.texture is not None:
            tracked_s, found = self._tracked or (-math.inf, None)
            if found is None or tracked_s != now_s:
                found = self._track(reference.texture, image, patch, now_s)
            rotation, self._segmented = found.rotation, (now_s, found.best)
        elif self._reader is not None:
            rotation = RotationEstimate(None, None, DeclineReason.CONTACT_TOO_SMALL)
        else:
            rotation = self._rotation_of_axis(reference, self._axis(patch, mark), now_s)
        return self._checked(reference, rotation, now_s, found, patch)

    def _axis(self, patch: Patch, mark: Mark) -> AxisEstimate:
        axis = estimate_axis(patch, self._axis_estimator, self._settings.round_aspect)
        mark("angle")
        return axis

    def _track(self, texture: TextureTracker, image: NDArray[np.uint8], patch: Patch, now_s: float) -> TrackedTexture:
        assert self._reader is not None
        return texture.track(self._reader.read(image, patch), patch.center_px, now_s)

    def _rotation_of_axis(self, reference: Reference, axis: AxisEstimate, now_s: float) -> RotationEstimate:
        """Return the rotation by the mask's axis, which is known up to half a revolution."""
        rotation = rotation_between_axes(axis, reference.axis, self._rotations.predicted_deg(now_s))
        if rotation.rotation_deg is None:
            return rotation
        half_revolutions = [Hypothesis(rotation.rotation_deg + by_deg, 0.0) for by_deg in (0.0, 180.0, -180.0)]
        found = self._rotations.update(now_s, half_revolutions)
        return found if found.rotation_deg is None else replace(found, sigma_deg=rotation.sigma_deg)

    def _checked(
        self,
        reference: Reference,
        rotation: RotationEstimate,
        now_s: float,
        found: TrackedTexture | None,
        patch: Patch | None,
    ) -> RotationMeasurement:
        """Return rotation, unless too uncertain, and shift since the first reference. patch: None if not segmented."""
        limit = self._settings.sigma_max_deg
        if rotation.sigma_deg is not None and rotation.sigma_deg > limit:
            detail = f"sigma {rotation.sigma_deg:.1f} deg, limit {limit:g} deg"
            rotation = RotationEstimate(None, None, explain(DeclineReason.UNCERTAIN, detail))
        orientation_deg = rate_deg_s = None
        if rotation.rotation_deg is not None:
            rate_deg_s = self.rate_deg_s(now_s)
            if reference.axis.angle_deg is not None:
                orientation_deg = wrap_axial_deg(reference.axis.angle_deg + rotation.rotation_deg)
        # While the rotation is declined, it is taken to be the last one: a jump would look like a slip.
        shift = reference.shift.measure(now_s, self._rotations.last_deg, found, patch)
        return RotationMeasurement(rotation, shift, orientation_deg, rate_deg_s).plus(self._carried)
