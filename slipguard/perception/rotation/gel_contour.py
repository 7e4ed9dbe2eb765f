"""Recognizes contours that are the gel's own: a flat face pressed lightly into a domed gel touches it in an ellipse.

That ellipse shows the dome, not the object, and stays when the object rotates. Balls, large cylinders and smooth ends
touch in an ellipse too; it shows the sum of both curvatures, so it rotates by more or less than the object. An edge of
the object bends the gel sharply, a smooth contact does not. The dome's own ellipse lies along the axes of the gel.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from slipguard.perception.contact.patch import Patch
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.texture_map import REDUCTION, Field, TextureMap, mask_in_window

SHARP_MIN = 7.0
"""Curvature of the gel times half the contact's width over its slope: 2.4-5.8 for balls, cylinders, eggs and flat faces
without an edge in the contact, 7-24 for broad contacts with edges, on rendered gels with domes of all kinds."""
SKIRT_PX = 6
"""The contact's surroundings count as far out as this, texture pixels."""
CURVED_PERCENTILE, STEEP_PERCENTILE = 97.0, 95.0
NOISE_FACTOR = 2.2
"""The percentile of the curvature over the standard deviation of its noise."""
BROAD_PX = 65.0
"""Width of a contact, frame pixels (3.5 mm), from which it may be a dome's own: a gel of 30 mm radius is touched over
3.5 mm at a depth of 0.05 mm."""
FLAT_LEVELS, CURVED_LEVELS = 3.0, 9.0
"""Curvature of the gel, gray levels per pixel, up to which it may be a dome's own, and from which a dome does not
matter: 0.4-2.6 for flat faces, balls of 30 mm and cylinders of 10-35 mm radius on domes of 30 mm radius and more; 4 for
a battery, 9 and more for a pen or a screwdriver."""
STEEP_MIN = 1.0
"""Slope, gray levels, below which the image shows no surface at all; the faintest contacts have 5."""
ALIGNED_DEG = 20.0
"""An ellipse closer than this to the image's axes, which are the gel's, may be the dome's own."""
DOME_ASPECT_MAX = 5.0
"""Largest aspect of a dome's height lines."""
LEAN_FREE = 0.03
LEAN_SMOOTH_DEG, LEAN_DEG = 6.0, 3.0
"""Sigma of the rotation per change of strength from one side to the other, beyond a free amount: an object that is
tilted rolls, and the imprint of a bent smooth body then rotates although the body does not; edges roll less. Without a
tilt the change is 0.02-0.15. Chosen on rocking training objects."""
ROLLED_DEG, ROLLED_FREE_PX, ROLLED_MAX_DEG = 0.16, 1.0, 5.0
"""Sigma of the rotation per frame pixel by which the contact of a smooth object has moved, beyond a free amount: it may
have rolled, and then the imprint of a body bent with a radius of 20 mm rotates by 0.16 degrees per pixel, a banana's by
0.35. A smooth contact that has moved by 2.1 mm is therefore declined, also if it has only slid. Chosen on rocking
training objects. For a contact with edges that has moved and shrunk, at most the third number."""
ROLLED_UNSEEN_PX = 0.6
"""A smooth contact may always have rolled by this: a part of the free amount. That is 0.1 degrees."""
SHRUNK = 1.5
"""Any contact that has moved and shrunk by this factor touches with another part of the object."""
DOME_SHARE_MAX = 0.3
"""Largest share of the rotation in sigma for a smooth contact that is not the gel's own."""


class GelContour:
    """Whether the reference's contact is smooth, and what that means for a rotation since then.

    Args:
        texture_map: The reference's texture map.
        slopes: The gel's slopes to the right and upwards in the same window, (h, w) float32 each, gray levels.
        patch: The reference's contact.
    """

    def __init__(self, texture_map: TextureMap, slopes: tuple[Field, Field], patch: Patch) -> None:
        self._shape = _Ellipse(patch)
        self._area_px = patch.area_px
        curved, steep = _strength(texture_map, slopes, patch)
        sharp = 0.5 * self._shape.width_px / REDUCTION * curved / max(steep, 1e-3)
        self._flat = min(FLAT_LEVELS / max(curved, 1e-3), 1.0)
        self.edgeless = steep >= STEEP_MIN and sharp < SHARP_MIN
        """Whether no edge of the object bends the gel: then force alone changes the contour."""
        self.smooth = self.edgeless and curved < CURVED_LEVELS and self._shape.width_px >= BROAD_PX
        """Whether the dome may show in the contour."""
        self._detail = f"bent by {sharp:.1f}, limit {SHARP_MIN:g}"

    def check(
        self, rotation: RotationEstimate, patch: Patch, factor: float, lean: float = 0.0, moved_px: float = 0.0
    ) -> RotationEstimate:
        """Decline a rotation if the contour may be the gel's own; increase its sigma if force, dome or tilt distort it.

        Args:
            rotation: As measured.
            patch: The contact now.
            factor: On the sigma of a contact without edges.
            lean: How much stronger the texture has become on one side.
            moved_px: How far the contact has moved without rotating, frame pixels: it may have rolled.
        """
        shrunk = math.log(max(self._area_px, 1) / max(patch.area_px, 1)) / math.log(SHRUNK)
        rolled_deg = ROLLED_DEG * max(moved_px - ROLLED_FREE_PX, ROLLED_UNSEEN_PX if self.smooth else 0.0)
        if not self.smooth:
            rolled_deg = min(max(shrunk, 0.0), 1.0) * min(rolled_deg, ROLLED_MAX_DEG)
        leaning_deg = (LEAN_SMOOTH_DEG if self.smooth else LEAN_DEG) * max(lean - LEAN_FREE, 0.0)
        rotation = rotation.widened(math.hypot(rolled_deg, leaning_deg))
        if self.edgeless and rotation.sigma_deg is not None:
            rotation = replace(rotation, sigma_deg=factor * rotation.sigma_deg)
        if not self.smooth or rotation.rotation_deg is None or rotation.sigma_deg is None:
            return rotation
        now = _Ellipse(patch)
        if self._flat == 1.0 and min(now.aspect, self._shape.aspect) < DOME_ASPECT_MAX:
            off_deg = min(now.off_axes_deg, self._shape.off_axes_deg)
            if off_deg < ALIGNED_DEG:
                detail = f"{self._detail}; {off_deg:.0f} deg from the gel's axes, limit {ALIGNED_DEG:g} deg"
                return RotationEstimate(None, None, explain(DeclineReason.GEL_CONTOUR, detail))
        share = self._flat * min(1.0 / max(now.aspect**2 - 1.0, 1e-3), DOME_SHARE_MAX)
        return replace(rotation, sigma_deg=math.hypot(rotation.sigma_deg, share * rotation.rotation_deg))


class _Ellipse:
    """The ellipse of a patch's second moments. width_px: its short axis, frame pixels."""

    def __init__(self, patch: Patch) -> None:
        m = cv2.moments(patch.mask, True)
        area = max(m["m00"], 1.0)
        xx, yy, xy = m["mu20"] / area, m["mu02"] / area, m["mu11"] / area
        half = math.hypot(0.5 * (xx - yy), xy)
        middle = 0.5 * (xx + yy)
        short2 = max(middle - half, 0.1)
        self.aspect = math.sqrt((middle + half) / short2)
        self.width_px = 4.0 * math.sqrt(short2) * patch.frame_px
        from_right_deg = abs(math.degrees(0.5 * math.atan2(2.0 * xy, xx - yy)))
        self.off_axes_deg = min(from_right_deg, 90.0 - from_right_deg)


def _strength(texture_map: TextureMap, slopes: tuple[Field, Field], patch: Patch) -> tuple[float, float]:
    """Return the largest curvature and slope of the gel in and around a patch: gray levels per pixel, gray levels."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SKIRT_PX + 1, 2 * SKIRT_PX + 1))
    near = cv2.dilate(mask_in_window(patch, texture_map.window), disc) > 0
    curved = _percentile(np.abs(texture_map.curvature[near]), CURVED_PERCENTILE)
    curved = math.sqrt(max(curved**2 - (NOISE_FACTOR * texture_map.noise) ** 2, 0.0))
    return curved, _percentile(np.hypot(*(one[near] for one in slopes)), STEEP_PERCENTILE)


def _percentile(values: Field, percent: float) -> float:
    """Return the nearest value; numpy's percentile takes three times as long."""
    place = round(0.01 * percent * (len(values) - 1))
    return float(np.partition(values, place)[place])
