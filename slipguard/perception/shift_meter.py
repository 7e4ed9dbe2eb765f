"""Measures the shift of the object at the grasp axis since the reference, or why it is unknown.

The object rotates about the axis through both fingers, which passes through the middles of their images. A contact lies
anywhere: while the object rotates, the contact's center moves although the object does not slide.

Ribs and threads look the same after a shift by their period, and a frame is long enough for several periods: the shift
is then declined, and only that the object slides is reported. Along a smooth shaft only its ends show a shift.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.perception.estimate import DeclineReason
from slipguard.perception.patch import Patch
from slipguard.perception.texture_map import REDUCTION
from slipguard.perception.texture_template import TextureTemplate
from slipguard.perception.texture_tracker import TrackedTexture, rotated

PERIOD_MIN_PX, PERIOD_MAX_PX = 4, 44
"""Searched periods, texture pixels: 0.4 to 4.7 mm."""
OVERLAP_MIN = 0.65
"""Smallest share of the texture that must overlap with itself: two edges of a bar are no period."""
SLIDE_S = 0.1
SLIDE_PX = 5.5
SLIDE_SHARE = 0.25
"""A periodic texture slides if it moves within SLIDE_S by SLIDE_PX (frame pixels; 3 mm/s), or by this share of its
period: what looks like part of a period may be several."""
SMEARED = 0.1
"""It also slides if it is smeared: its correlation with the reference changes by this within SLIDE_S."""
PERIODIC_SHARE = 0.33
"""A texture is periodic if its mean square difference from itself falls below this share of the highest on the way."""
CENTER_PX, END_PX = 6.0, 12.0
"""The ends of a contact are measured if its center has moved by this much more than its texture (frame pixels), or both
by this much while the frame cuts the contact. They count if they have moved by this much more than the texture: a fast
shaft moves further in a frame than its texture is searched."""
END_SHARE = 0.02
"""The end of a contact is where this share of it lies beyond."""
GRASP_AXIS_PX = ((FRAME_WIDTH_PX - 1) / 2.0, (FRAME_HEIGHT_PX - 1) / 2.0)
EDGE_PX = 3
"""A contact that comes this close to the edge of the frame is cut there, network pixels."""

Direction = tuple[float, float]
"""Right and down, of length 1."""


@dataclass(frozen=True, slots=True)
class ShiftMeasurement:
    """Shift of the object at the grasp axis since the reference, frame pixels right and down; None if it is unknown.

    period_px: the shift is ambiguous by multiples of this. slides: the texture moves by an unknown number of periods.
    """

    shift_px: tuple[float, float] | None
    period_px: float | None = None
    slides: bool = False


class ShiftMeter:
    """Measures the shift against one reference. template: its texture, or None."""

    def __init__(self, template: TextureTemplate | None, patch: Patch) -> None:
        self._template = template
        self._patch = patch
        self._center_px = patch.center_px
        self._recent: deque[tuple[float, float, float]] = deque()
        self._beyond_px = (0.0, 0.0)

    @cached_property
    def period(self) -> tuple[float, float] | None:
        """The shift (right, down) after which the texture repeats, texture pixels; None if it does not."""
        return None if self._template is None else shift_period(self._template)

    def measure(self, now_s: float, patch: Patch, found: TrackedTexture | None) -> ShiftMeasurement:
        """Return the shift of the reference contact's center at `now_s`.

        Args:
            now_s: Capture time of the frame.
            patch: The contact in it.
            found: Its texture; None if the reference has none.
        """
        measured = self._measure(now_s, patch, found)
        (x, y), (own_x, own_y) = measured.shift_px or (0.0, 0.0), (found and found.shift_px) or (0.0, 0.0)
        self._beyond_px = (x - own_x, y - own_y)
        return measured

    def _measure(self, now_s: float, patch: Patch, found: TrackedTexture | None) -> ShiftMeasurement:
        (x, y), (before_x, before_y) = patch.center_px, self._center_px
        center_px = (x - before_x, y - before_y)
        if patch is self._patch:  # the reference's own frame takes long enough without the search for a period
            return ShiftMeasurement((0.0, 0.0))
        if self.period is not None:
            period_px = REDUCTION * math.hypot(*self.period)
            return ShiftMeasurement(None, period_px, slides=self._slides(now_s, found, self.period, period_px))
        if self._template is None or found is None:
            return ShiftMeasurement(center_px)
        rotation_deg, shift_px = found.rotation.rotation_deg, found.shift_px
        if rotation_deg is None or shift_px is None:
            rotation_deg, shift_px = rotation_deg or 0.0, center_px
        along = found.smooth or self._suspect_direction(patch, shift_px)
        if along is None:
            return ShiftMeasurement(shift_px)
        offset_px = end_offset_px(self._patch, patch, shift_px, along, rotation_deg)
        if found.smooth is None and (offset_px is None or abs(offset_px) < END_PX):
            return ShiftMeasurement(shift_px)
        if offset_px is None:  # only the center is left: a taper shows a shift, a cylinder does not
            offset_px = (center_px[0] - shift_px[0]) * along[0] + (center_px[1] - shift_px[1]) * along[1]
        return ShiftMeasurement((shift_px[0] + offset_px * along[0], shift_px[1] + offset_px * along[1]))

    def follow(self, now_s: float, found: TrackedTexture) -> ShiftMeasurement:
        """Return the shift in a frame without a segmented contact, which has moved with its texture since then."""
        if self.period is not None:
            period_px = REDUCTION * math.hypot(*self.period)
            return ShiftMeasurement(None, period_px, slides=self._slides(now_s, found, self.period, period_px))
        x, y = found.shift_px or (0.0, 0.0)
        return ShiftMeasurement((x + self._beyond_px[0], y + self._beyond_px[1]))

    def at_axis(self, shift: ShiftMeasurement, rotation_deg: float) -> ShiftMeasurement:
        """Return the shift at the grasp axis from that of the reference contact's center, for a rotation since then."""
        if shift.shift_px is None:
            return shift
        (x, y), center_px = shift.shift_px, self._center_px
        before = (GRASP_AXIS_PX[0] - center_px[0], GRASP_AXIS_PX[1] - center_px[1])
        after = rotated(before, rotation_deg)
        return replace(shift, shift_px=(x + after[0] - before[0], y + after[1] - before[1]))

    def _suspect_direction(self, patch: Patch, shift_px: tuple[float, float]) -> Direction | None:
        """Return the direction in which the ends are to be measured: the center has moved differently, or is cut."""
        (x, y), (before_x, before_y) = patch.center_px, self._center_px
        beyond = (x - before_x - shift_px[0], y - before_y - shift_px[1])
        for way in (beyond, shift_px) if patch.clipped.any else (beyond,):
            length_px = math.hypot(*way)
            if length_px >= CENTER_PX:
                return way[0] / length_px, way[1] / length_px
        return None

    def _slides(
        self, now_s: float, found: TrackedTexture | None, period: tuple[float, float], period_px: float
    ) -> bool:
        """Return whether the texture has moved along its period, or smeared, within the last frames."""
        recent = self._recent
        while recent and not 0.0 <= now_s - recent[0][0] <= SLIDE_S:
            recent.popleft()
        if found is None or found.shift_px is None or found.rotation.rotation_deg is None:
            why = "" if found is None else found.rotation.declined or ""
            return bool(recent) and why.startswith(DeclineReason.CONTACT_CHANGED)  # it has just been there
        along = rotated(period, found.rotation.rotation_deg)
        moved_px = (found.shift_px[0] * along[0] + found.shift_px[1] * along[1]) * REDUCTION / period_px
        recent.append((now_s, moved_px, found.best.alike))
        way_px = max(one[1] for one in recent) - min(one[1] for one in recent)
        smeared = max(one[2] for one in recent) - min(one[2] for one in recent)
        return way_px > min(SLIDE_PX, SLIDE_SHARE * period_px) or smeared > SMEARED


def shift_period(template: TextureTemplate) -> tuple[float, float] | None:
    """Return the smallest shift (right, down; texture pixels) after which the texture repeats; None: not periodic.

    That is where it differs least from itself after it has differed more on the way there.
    """
    away = _difference_when_shifted(template)
    middle = PERIOD_MAX_PX
    highest = float(away[np.isfinite(away)].max(initial=0.0))
    lowest = cv2.erode(
        np.where(np.isfinite(away), away, np.float32(3e38)).astype(np.float32), np.ones((3, 3), np.uint8)
    )
    rows, columns = np.nonzero((away <= lowest) & (away < PERIODIC_SHARE * highest))
    found: tuple[float, float] | None = None
    for row, column in zip(rows, columns, strict=True):
        dx, dy = float(column - middle), float(row - middle)
        if math.hypot(dx, dy) < PERIOD_MIN_PX or (found is not None and math.hypot(dx, dy) >= math.hypot(*found)):
            continue
        # The nearby lowest, for the way may pass a narrow ridge (a straight edge) at a pixel's distance.
        way = np.linspace(0.0, 1.0, 2 * int(math.hypot(dx, dy)), endpoint=False)
        on_way = lowest[np.rint(middle + way * dy).astype(int), np.rint(middle + way * dx).astype(int)]
        if float(away[row, column]) < PERIODIC_SHARE * float(on_way.max()):
            found = dx, dy
    return found


def _difference_when_shifted(template: TextureTemplate) -> NDArray[np.float32]:
    """Return the mean square difference of the texture from itself by shift, infinite where too little overlaps.

    The middle element is for no shift. Computed by correlations: (f - g)^2 = f^2 + g^2 - 2 f g.
    """
    inside = template.mask.astype(np.float32)
    value = np.asarray(template.image * inside, np.float32)
    rows, columns = (cv2.getOptimalDFTSize(size + PERIOD_MAX_PX) for size in value.shape)
    spectra = [np.fft.rfft2(one, (rows, columns)).astype(np.complex64) for one in (inside, value, np.square(value))]

    def by_shift(spectrum: NDArray[np.complex64] | NDArray[np.floating]) -> NDArray[np.float32]:
        whole = np.fft.irfft2(spectrum, (rows, columns))
        index = np.arange(-PERIOD_MAX_PX, PERIOD_MAX_PX + 1)
        return np.asarray(whole[np.ix_(index, index)], np.float32)

    mask, values, squares = spectra
    overlap = by_shift(mask * np.conj(mask))
    square = by_shift(2.0 * (np.real(squares * np.conj(mask)) - np.square(np.abs(values))))
    enough = overlap >= OVERLAP_MIN * float(inside.sum())
    return np.where(enough, square / np.maximum(overlap, 1.0), np.float32(np.inf)).astype(np.float32)


def end_offset_px(
    reference: Patch, patch: Patch, shift_px: tuple[float, float], along: Direction, rotation_deg: float
) -> float | None:
    """Return how much further than by `shift_px` the ends of a contact have moved; None if no end is visible in both.

    Args:
        reference: The contact in the reference.
        patch: The contact now.
        shift_px: Shift of the reference's center, frame pixels.
        along: Direction in which the ends lie now.
        rotation_deg: Rotation since the reference.
    """
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    before = (c * along[0] - s * along[1], c * along[1] + s * along[0])
    center_px = reference.center_px
    moved = [
        now_px - before_px
        for now_px, before_px in zip(
            _ends_px(patch, along, (center_px[0] + shift_px[0], center_px[1] + shift_px[1])),
            _ends_px(reference, before, center_px),
            strict=True,
        )
        if now_px is not None and before_px is not None
    ]
    return sum(moved) / len(moved) if moved else None


def _ends_px(patch: Patch, along: Direction, center_px: tuple[float, float]) -> tuple[float | None, float | None]:
    """Return how far both ends of a contact are from a point, frame pixels; None for one that the frame cuts."""
    rows, columns = np.nonzero(patch.mask[::2, ::2])
    x, y = 2 * columns + patch.left_px, 2 * rows + patch.top_px
    place = x * along[0] + y * along[1]
    beyond = int(END_SHARE * (len(place) - 1))
    low, high = np.partition(place, (beyond, -1 - beyond))[[beyond, -1 - beyond]]
    width, height = patch.image_size
    cut = (x < EDGE_PX) | (x >= width - EDGE_PX) | (y < EDGE_PX) | (y >= height - EDGE_PX)
    center = center_px[0] * along[0] + center_px[1] * along[1]
    first_px, last_px = (float(end) * patch.frame_px - center for end in (low, high))
    return None if cut[place <= low].any() else first_px, None if cut[place >= high].any() else last_px
