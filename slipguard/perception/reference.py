"""The reference: what rotations are measured against, and when a contact becomes it.

A contact that has not become stable in time becomes the reference as it is. While it grows, a later contact replaces
it, and the rotation until then is carried over.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import AxisEstimate, RotationEstimate
from slipguard.perception.patch import Patch
from slipguard.perception.shift_meter import ShiftMeasurement, ShiftMeter
from slipguard.perception.texture_tracker import TextureTracker

STABLE_FRAMES = 5
STABLE_SHARE = 0.05
"""The contact area is stable if the last five frames differ by less than this share of it."""
STABLE_WAIT_S = 0.095
"""A contact that is not stable after this time becomes the reference as it is: in three or six frames, below 0.1 s."""
GROWN = 1.5
CARRIED_SIGMA_DEG = 1.5
"""While the force grows, a reference that was not stable follows: it is replaced when the contact area has grown by
this factor, if the rotation until then is known to this sigma; that rotation is added from then on."""


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
    """

    rotation: RotationEstimate
    shift: ShiftMeasurement | None
    orientation_deg: float | None


class ReferenceSelector:
    """Decides when a contact becomes the reference, and carries the rotation over when one replaces another.

    Args:
        first: Whether the first contact becomes the reference, stable or not.
    """

    def __init__(self, first: bool) -> None:
        self._first = first
        self._areas: deque[int] = deque(maxlen=STABLE_FRAMES)
        self._contact_since_s: float | None = None
        self._carried: RotationMeasurement | None = None
        self.provisional = False
        """Whether the reference was not stable when it was taken, and may still be replaced."""

    @property
    def carried_deg(self) -> float:
        """Rotation up to the present reference; 0 for the first one."""
        return 0.0 if self._carried is None else self._carried.rotation.rotation_deg or 0.0

    def carry(self, found: RotationMeasurement | None) -> None:
        """Set the measurement up to the present reference; None for a first one."""
        self._carried = found

    def note_no_contact(self) -> None:
        """Require a new run of stable frames for a reference that is not taken yet."""
        self._areas.clear()
        self._contact_since_s = None

    def is_stable(self, patch: Patch) -> bool:
        """Return whether a patch may become the reference."""
        self._areas.append(patch.area_px)
        if self._first:
            return True
        largest, smallest = max(self._areas), min(self._areas)
        return len(self._areas) == STABLE_FRAMES and largest - smallest < STABLE_SHARE * largest

    def waited(self, now_s: float) -> bool:
        """Return whether the contact has lasted long enough for a reference although its area still changes."""
        if self._contact_since_s is None or now_s < self._contact_since_s:
            self._contact_since_s = now_s
        return now_s - self._contact_since_s >= STABLE_WAIT_S

    def outgrown(self, reference: Reference, rotation: RotationEstimate, patch: Patch, stable: bool) -> bool:
        """Return whether a reference that was not stable is to be replaced by this patch, which has grown."""
        if not self.provisional:
            return False
        if rotation.sigma_deg is None or rotation.sigma_deg > CARRIED_SIGMA_DEG:
            return False
        self.provisional = not stable
        return patch.area_px > GROWN * reference.patch.area_px

    def with_carried(self, found: RotationMeasurement) -> RotationMeasurement:
        """Add the rotation up to the present reference."""
        if self._carried is None:
            return found
        rotation, before = found.rotation, self._carried.rotation
        before_deg, before_sigma_deg = before.rotation_deg or 0.0, before.sigma_deg or 0.0
        if rotation.rotation_deg is not None and rotation.sigma_deg is not None:
            sigma_deg = math.hypot(rotation.sigma_deg, before_sigma_deg)
            rotation = replace(rotation, rotation_deg=rotation.rotation_deg + before_deg, sigma_deg=sigma_deg)
        shift, before_shift = found.shift, self._carried.shift
        if shift is not None and before_shift is not None:
            if before_shift.shift_px is None:
                shift = replace(shift, shift_px=None, period_px=shift.period_px or before_shift.period_px)
            elif shift.shift_px is not None:
                (dx, dy), (before_x, before_y) = shift.shift_px, before_shift.shift_px
                shift = replace(shift, shift_px=(dx + before_x, dy + before_y))
        return replace(found, rotation=rotation, shift=shift)
