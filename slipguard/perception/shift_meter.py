"""Measures the shift of the object at the grasp axis since the reference, or why it is unknown.

The object rotates about the axis through both fingers, which passes through the middles of their images. A contact lies
anywhere: while the object rotates, the contact's center moves although the object does not slide.

Ribs and threads look the same after a shift by their period, and a frame is long enough for several periods: the shift
is then declined, and only that the object slides is reported. Along a smooth shaft only its ends show a shift.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.perception.estimate import DeclineReason
from slipguard.perception.patch import Patch
from slipguard.perception.texture_map import REDUCTION
from slipguard.perception.texture_template import TextureTemplate
from slipguard.perception.texture_tracker import TrackedTexture

PERIOD_MIN_PX, PERIOD_MAX_PX = 4, 44
"""Searched periods, texture pixels: 0.4 to 4.7 mm."""
OVERLAP_MIN = 0.65
"""Smallest share of the texture that must overlap with itself: two edges of a bar are no period."""
PERIODIC_SHARE = 0.33
"""A texture is periodic if its mean square difference from itself falls below this share of the highest on the way."""
SLIDE_S, SLIDE_SHARE, SMEARED = 0.1, 0.25, 0.1
"""A periodic texture slides if it moves within this time by this share of its period, for that may be several periods,
or is smeared: its correlation with the reference changes by this."""
END_PX = 12.0
"""The ends of a contact whose texture shows a shift count if they have moved by this much more (frame pixels)."""
END_SHARE = 0.02
"""The end of a contact is where this share of it lies beyond."""
GRASP_AXIS_PX = ((FRAME_WIDTH_PX - 1) / 2.0, (FRAME_HEIGHT_PX - 1) / 2.0)
EDGE_PX = 3
"""A contact that comes this close to the edge of the frame is cut there, network pixels."""

Direction = tuple[float, float]
"""Right and down."""


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
        self._recent: deque[tuple[float, float, float]] = deque()
        self._beyond_px = (0.0, 0.0)

    @cached_property
    def period(self) -> Direction | None:
        """The shift after which the texture repeats, texture pixels; None if it does not."""
        return None if self._template is None else shift_period(self._template)

    def measure(
        self, now_s: float, rotation_deg: float, found: TrackedTexture | None, patch: Patch | None
    ) -> ShiftMeasurement:
        """Return the shift at the grasp axis in the frame of `now_s`.

        Args:
            now_s: Capture time of the frame.
            rotation_deg: Rotation since the reference; the last known one, if it is declined.
            found: The texture; None if the reference has none.
            patch: The contact; None if it was not segmented: it has moved as its texture has.
        """
        if patch is self._patch:  # the reference's own frame takes long enough without the search for a period
            return ShiftMeasurement((0.0, 0.0))
        if self.period is not None:
            period_px = REDUCTION * math.hypot(*self.period)
            return ShiftMeasurement(None, period_px, self._slides(now_s, found, self.period, period_px))
        x, y = (found and found.shift_px) or (0.0, 0.0)
        if patch is not None:
            self._beyond_px = self._beyond_texture(patch, rotation_deg, found, (x, y))
        x, y = x + self._beyond_px[0], y + self._beyond_px[1]
        # The center of a contact away from the axis moves on a circle about it.
        before = tuple(axis - center for axis, center in zip(GRASP_AXIS_PX, self._patch.center_px, strict=True))
        after = rotated((before[0], before[1]), rotation_deg)
        return ShiftMeasurement((x + after[0] - before[0], y + after[1] - before[1]))

    def _beyond_texture(
        self, patch: Patch, rotation_deg: float, found: TrackedTexture | None, shift_px: Direction
    ) -> Direction:
        """Return how much further than its texture a contact has moved, frame pixels.

        Without a rotation by its texture, that is the motion of its center. Along a smooth shaft only the ends show a
        shift, and those of a fast one move further in a frame than a texture is searched.
        """
        middle = self._patch.center_px
        center_px = patch.center_px[0] - middle[0], patch.center_px[1] - middle[1]
        beyond = center_px[0] - shift_px[0], center_px[1] - shift_px[1]
        lost = found is None or found.rotation.rotation_deg is None
        smooth = None if self._template is None or lost else self._template.smooth
        has_smooth = smooth is not None
        way = center_px if patch.clipped.any else beyond
        far_px = math.hypot(*way)
        if smooth is not None:
            along = rotated(smooth, rotation_deg)
        elif self._template is None or far_px < END_PX / 2.0:  # the center of a cut shaft moves half as far as its end
            return beyond if lost else (0.0, 0.0)
        else:
            along = way[0] / far_px, way[1] / far_px
            smooth = rotated(along, -rotation_deg)
        ends = zip(_ends_px(patch, along, middle), _ends_px(self._patch, smooth, middle), strict=True)
        moved = [now_px - before_px for now_px, before_px in ends if now_px is not None and before_px is not None]
        further_px = sum(moved) / len(moved) - _along(shift_px, along) if moved else 0.0
        if not moved and (lost or has_smooth):  # the center: a taper shows a shift, a cylinder does not
            further_px = _along(beyond, along)
        elif not has_smooth and abs(further_px) < END_PX:
            return beyond if lost else (0.0, 0.0)
        return further_px * along[0], further_px * along[1]

    def _slides(self, now_s: float, found: TrackedTexture | None, period: Direction, period_px: float) -> bool:
        """Return whether the texture has moved along its period, or smeared, within the last frames."""
        recent = self._recent
        while recent and not 0.0 <= now_s - recent[0][0] <= SLIDE_S:
            recent.popleft()
        if found is None or found.shift_px is None or found.rotation.rotation_deg is None:
            why = "" if found is None else found.rotation.declined or ""
            return bool(recent) and why.startswith(DeclineReason.CONTACT_CHANGED)  # it has just been there
        along = rotated(period, found.rotation.rotation_deg)
        recent.append((now_s, _along(found.shift_px, along) * REDUCTION / period_px, found.best.alike))
        _, ways_px, alike = zip(*recent, strict=True)
        return bool(np.ptp(ways_px) > SLIDE_SHARE * period_px or np.ptp(alike) > SMEARED)


def rotated(direction: Direction, rotation_deg: float) -> Direction:
    """Rotate a direction counter-clockwise as seen in the image."""
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    return c * direction[0] + s * direction[1], c * direction[1] - s * direction[0]


def _along(shift: Direction, direction: Direction) -> float:
    return shift[0] * direction[0] + shift[1] * direction[1]


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


def _ends_px(patch: Patch, along: Direction, middle_px: Direction) -> tuple[float | None, float | None]:
    """Return how far both ends of a contact are from a point, frame pixels; None for one that the frame cuts."""
    rows, columns = np.nonzero(patch.mask[::2, ::2])
    x, y = 2 * columns + patch.left_px, 2 * rows + patch.top_px
    place = x * along[0] + y * along[1]
    beyond = int(END_SHARE * (len(place) - 1))
    low, high = np.partition(place, (beyond, -1 - beyond))[[beyond, -1 - beyond]]
    width, height = patch.image_size
    cut = (x < EDGE_PX) | (x >= width - EDGE_PX) | (y < EDGE_PX) | (y >= height - EDGE_PX)
    first_px, last_px = (float(end) * patch.frame_px - _along(middle_px, along) for end in (low, high))
    return None if cut[place <= low].any() else first_px, None if cut[place >= high].any() else last_px
