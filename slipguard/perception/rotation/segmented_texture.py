"""How far a contact has rotated since the network last ran, if its texture has moved as a whole since then."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slipguard.perception.declined import DeclineReason
from slipguard.perception.rotation.fusion import RotationEstimate, is_certain
from slipguard.perception.rotation.texture_registration import TextureFit
from slipguard.perception.rotation.texture_tracker import TrackedTexture

SCALE, GAIN, ALIKE = 0.02, 0.1, 0.03
ROTATION_DEG, SHIFT_PX = 8.0, 3.0
"""Changes up to which a contact moves as a whole: shares of scale and strength, correlation with the reference,
rotation, and shift (texture pixels)."""
SIGMA_MAX_DEG = 4.0
"""A texture up to this sigma still shows how far the contact has rotated since the network ran."""
MOVED_SHARE = 0.1
"""Share of that rotation in sigma."""
SMOOTH_S = 0.02
"""Along a smooth shaft only the ends show a shift, which the network finds: it runs on every second frame at 60 Hz, so
that a slide is seen one frame later at most."""


@dataclass(frozen=True, slots=True)
class SegmentedTexture:
    """The texture in the last segmented contact, and what was measured there.

    fit, texture: its registration to the reference, and its rotation. fused: the rotation by texture, contour and axis.
    captured_at_s: capture time of that frame.
    """

    captured_at_s: float
    fit: TextureFit
    texture: RotationEstimate
    fused: RotationEstimate

    def rotation_in(self, found: TrackedTexture, now_s: float) -> RotationEstimate | None:
        """Return the rotation since the reference in a later frame of which only the texture is known.

        A certain texture shows it by itself. An uncertain one shows the rotation since the network ran, because its
        error is nearly the same as then. A round contact stays declined. None if it has not moved as a whole, or is too
        uncertain even for that.
        """
        if found.fit is None or not self._moved_as_a_whole(found.fit):
            return None
        if found.smooth is not None and now_s - self.captured_at_s > SMOOTH_S:
            return None
        if found.rotation.rotation_deg is None and (self.fused.declined or "").startswith(DeclineReason.ROUND):
            return self.fused
        return found.rotation if is_certain(found.rotation) else self._carried_on(found.rotation)

    def _moved_as_a_whole(self, fit: TextureFit) -> bool:
        pose, before = fit.pose, self.fit.pose
        return (
            abs(pose.scale - before.scale) <= SCALE
            and abs(pose.gain - before.gain) <= GAIN
            and fit.alike >= self.fit.alike - ALIKE
            and abs(pose.rotation_deg - before.rotation_deg) <= ROTATION_DEG
            and math.hypot(pose.dx_px - before.dx_px, pose.dy_px - before.dy_px) <= SHIFT_PX
        )

    def _carried_on(self, texture: RotationEstimate) -> RotationEstimate | None:
        before, fused = self.texture, self.fused
        if texture.rotation_deg is None or before.rotation_deg is None or fused.rotation_deg is None:
            return None
        sigma, sigma_before = texture.sigma_deg or 0.0, before.sigma_deg or 0.0
        if sigma > SIGMA_MAX_DEG or fused.sigma_deg is None:
            return None
        moved_deg = texture.rotation_deg - before.rotation_deg
        grown = math.sqrt(max(sigma**2 - sigma_before**2, 0.0))
        sigma_deg = math.hypot(fused.sigma_deg, grown, MOVED_SHARE * moved_deg)
        return RotationEstimate(fused.rotation_deg + moved_deg, sigma_deg)
