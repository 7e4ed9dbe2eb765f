"""How far a relief turns until it looks like itself, and whether it can have turned so far unseen.

Teeth, rays, nuts: laid over its reference such a relief tells a turn only up to whole steps. Which step it is, is
counted from frame to frame, and lost where a step may have been missed.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from slipguard.perception.rotation.contour_template import sampled
from slipguard.perception.rotation.texture_registration import TextureTemplate

FURTHEST_DEG = 124.0
"""A triangle repeats at 120 degrees. What repeats at 180 is taken for unturned, as axes are."""
LOOK_DEG = 2.0
SHARE = 0.33
"""A relief whose mean square difference from itself falls below this share of its highest repeats. Teeth and regular
polygons reach 0.02-0.27, other contacts of tools 0.4 (a tapered square's edge, at 90 degrees) and more."""
ACCELERATION_DEG_S2 = 5_000.0
"""What begins to turn unseen is taken to turn no faster: a rod of 8 cm, held at its end with half the force it needs;
held with none it would turn twice as fast. With that the count of fine teeth would not outlive one frame of thirty a
second that is lost."""
LEAP_SHARE = 0.4
"""Found this share of a step or more from where it should be, half a step being the limit, it may be the next one."""
WHOLE_SHARE = 0.9
"""So may it where the way to the next step's place is no longer than what can have been turned unseen; of that way this
share is sure."""


def period_deg(texture: TextureTemplate) -> float | None:
    """The smallest turn after which the relief looks like itself again, degrees, to a degree or two.

    That is, where it differs least from itself after it has differed more. None: there is none up to `FURTHEST_DEG`.
    """
    dx, dy, (centre_x, centre_y) = texture.x_px, texture.y_px, texture.origin_px
    highest = 0.0
    found: tuple[float, float] | None = None
    for rotation_deg in np.arange(LOOK_DEG, FURTHEST_DEG + 0.1, LOOK_DEG):
        c, s = np.float32(math.cos(math.radians(rotation_deg))), np.float32(math.sin(math.radians(rotation_deg)))
        x, y = dx * c + dy * s + np.float32(centre_x), dy * c - dx * s + np.float32(centre_y)
        away = sampled(texture.picture, x, y, cv2.BORDER_REPLICATE) - texture.value
        square = float(away @ away)
        if found is not None and square >= found[0]:
            break
        if square < SHARE * highest:
            found = square, float(rotation_deg)
        highest = max(highest, square)
    return None if found is None else found[1]


def may_be_next(by_deg: float, possible_rotation_deg: float, step_deg: float) -> bool:
    """Whether what was found so far from where it was expected, and may have turned so far unseen, is a step on."""
    return abs(by_deg) >= min(LEAP_SHARE * step_deg, WHOLE_SHARE * step_deg - possible_rotation_deg)


def possible_rotation_deg(since_s: float, rate_deg_s: float) -> float:
    """How far from where it was expected a contact may be that has not been seen for so long, degrees.

    rate_deg_s: what it turned at when it was last seen: it may have stopped at once, or be turning ever faster.
    """
    since_s = max(since_s, 0.0)
    return max(abs(rate_deg_s) * since_s, 0.5 * ACCELERATION_DEG_S2 * since_s**2)
