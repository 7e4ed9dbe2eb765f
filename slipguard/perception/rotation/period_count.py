"""The periods of a periodic texture (teeth, rays, nuts): a texture shows a rotation only up to whole periods.

They are counted from frame to frame. After a gap in which the object may have rotated by a period they are ambiguous.
"""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np

from slipguard.perception.rotation.texture_template import TextureTemplate

PERIOD_MAX_DEG = 124.0
"""A triangle repeats at 120 degrees. A texture with a period of 180 is taken as unrotated, as axes are."""
PERIOD_STEP_DEG = 2.0
PERIOD_POINTS = 600
"""A period is searched with about this many points of the texture."""
PERIODIC_SHARE = 0.33
"""A texture is periodic if its mean square difference from itself falls below this share of the highest. Teeth and
regular polygons reach 0.02-0.27, other contacts of tools 0.4 (a tapered square's edge, at 90 degrees) and more."""
SIMILAR_SHARE = 0.5
"""The same for a texture that is only similar to itself: 0.35-0.47 for a nut of which not all edges touch, a cross and
four pins; 0.53 and more for contacts that are not."""
ACCELERATION_DEG_S2 = 20_000.0
"""Largest assumed acceleration of an object that rotates between two frames: a rod of 8 cm that is held at its end
without any force reaches half of it. Teeth as fine as 26 are counted across one lost frame at 60 Hz, not at 30 Hz."""
UNEXPECTED_FREE_DEG = 0.15
"""Noise of a rotation that is no acceleration."""
PERIOD_SHARE = 0.4
"""Rotation from the expected one, as a share of the period, at which it may be the next one; 0.5 is the limit."""
GAP_SHARE = 0.9
"""It may also be the next one if the way to the next period's place, times this share for its accuracy, is no longer
than the possible rotation in the gap."""


class PeriodCount:
    """Counts the periods of one reference's texture.

    Args:
        template: The texture.
        rotated_unseen: Whether the object may have rotated by any angle since the reference.
    """

    def __init__(self, template: TextureTemplate, rotated_unseen: bool = False) -> None:
        self._template = template
        self.gap_deg = 0.0
        """How far the object may be from its expected rotation."""
        self.ambiguous = rotated_unseen and self.period_deg is not None
        """Whether the rotation may be off by whole periods, until the axis resolves it."""

    @cached_property
    def found(self) -> tuple[float | None, float | None]:
        """The rotations (degrees) after which the texture is similar to itself, and after which it repeats."""
        similar_deg, repeated_deg = repeats_after_deg(self._template, SIMILAR_SHARE, PERIODIC_SHARE)
        return similar_deg, repeated_deg

    @property
    def period_deg(self) -> float | None:
        """The rotation after which the texture repeats or is similar to itself, None if there is none."""
        return self.found[0]

    @property
    def repeats(self) -> bool:
        """Whether the texture repeats, so that only the axis can distinguish the periods."""
        return self.found[1] is not None

    def note_gap(self, gap_s: float, rate_deg_s: float, unexpected_deg: float) -> None:
        """Note the time since the rotation was last known, its rate then, and how much the last one was unexpected."""
        if not self.ambiguous:
            self.gap_deg = possible_rotation_deg(gap_s, rate_deg_s, unexpected_deg)
            self.ambiguous = self.may_be_next(0.0, self.gap_deg)

    def may_be_next(self, by_deg: float, gap_deg: float) -> bool:
        """Return whether a texture found `by_deg` from where it was expected may be a period further on.

        gap_deg: how far the object may be from there.
        """
        if not _reaches_next(by_deg, gap_deg, PERIOD_STEP_DEG):  # not even with the finest period
            return False
        return self.period_deg is not None and _reaches_next(by_deg, gap_deg, self.period_deg)


def repeats_after_deg(template: TextureTemplate, *shares: float) -> list[float | None]:
    """Return the smallest rotations after which the texture repeats, degrees, to a degree or two; None: not periodic.

    That is where it differs least from itself after it has differed more, up to `PERIOD_MAX_DEG`. shares: of that
    larger difference, below which it counts as repeated; one rotation for each.
    """
    some = slice(None, None, max(template.value.size // PERIOD_POINTS, 1))
    dx, dy, value = template.x_px[some], template.y_px[some], template.value[some]
    center_x, center_y = template.origin_px
    rotations_deg = np.arange(PERIOD_STEP_DEG, PERIOD_MAX_DEG + 0.1, PERIOD_STEP_DEG)
    c = np.cos(np.radians(rotations_deg)).astype(np.float32)[:, None]
    s = np.sin(np.radians(rotations_deg)).astype(np.float32)[:, None]
    x, y = c * dx + s * dy + np.float32(center_x), c * dy - s * dx + np.float32(center_y)
    away = cv2.remap(template.image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) - value
    squares = np.einsum("ij,ij->i", away, away).tolist()
    return [_first_repetition(squares, share) for share in shares]


def _first_repetition(squares: list[float], share: float) -> float | None:
    """Return the rotation (degrees) of the first minimum below a share of the highest square before it."""
    highest = 0.0
    lowest: tuple[float, int] | None = None
    for step, square in enumerate(squares, 1):
        if lowest is not None and square >= lowest[0]:
            break
        if square < share * highest:
            lowest = square, step
        highest = max(highest, square)
    return None if lowest is None else PERIOD_STEP_DEG * lowest[1]


def possible_rotation_deg(gap_s: float, rate_deg_s: float, unexpected_deg: float = 0.0) -> float:
    """Return how far an object may be from its expected rotation after a gap, degrees.

    Args:
        gap_s: Time since its rotation was last known.
        rate_deg_s: Its mean rate in the frame before that: it may have stopped at once, or accelerate.
        unexpected_deg: How far the last known rotation was from the expected one. If the acceleration began within that
            frame the rate at its end was higher than the mean rate.
    """
    gap_s = max(gap_s, 0.0)
    begun_deg = max(unexpected_deg - UNEXPECTED_FREE_DEG, 0.0)
    lag_deg_s = min(math.sqrt(2.0 * ACCELERATION_DEG_S2 * begun_deg), 0.5 * ACCELERATION_DEG_S2 * gap_s)
    return max(abs(rate_deg_s) * gap_s, lag_deg_s * gap_s + 0.5 * ACCELERATION_DEG_S2 * gap_s**2)


def _reaches_next(by_deg: float, gap_deg: float, period: float) -> bool:
    return abs(by_deg) >= min(PERIOD_SHARE * period, GAP_SHARE * period - gap_deg)
