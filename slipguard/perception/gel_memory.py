"""Memory of the gel: a share of the reference's imprint that stays in place holds the registered rotation back.

A single frame shows that share only after some degrees of rotation. It is therefore estimated over all frames since
the reference: a normal distribution that every frame's registration updates.
"""

from __future__ import annotations

import math

from slipguard.perception.estimate import RotationEstimate
from slipguard.perception.registration import Ghost

SHARE_STD = 0.2
"""Standard deviation of the share before any rotation is seen: gels that keep up to 0.4 are within two."""
DRIFT = 0.02
"""Uncertainty that is left after any number of frames: their errors are alike, and the gel forgets."""
CERTAIN_SIGMAS = 5.0
"""Rotations are corrected for a share that is this certain."""
SPREAD_SHARE, CORRECTION_SHARE = 0.5, 0.1
"""Shares in sigma of the uncertain part of the correction, and of the correction made."""
POSSIBLE_MAX = 0.3
"""Largest sigma by memory that is not certain, as a share of the rotation: three sigmas stay below the rotation, so
that a slip is detected as early as without."""


class ImprintMemory:
    """The estimated share of the reference that stays in place. All constants were chosen on training objects."""

    def __init__(self) -> None:
        self.share = 0.0
        self._sigma = SHARE_STD
        self._shown = False

    @property
    def certain(self) -> bool:
        return self._shown and self.share > CERTAIN_SIGMAS * self._sigma

    def update(self, ghost: Ghost) -> None:
        """Take a frame's registration into account."""
        self._shown = self._shown or ghost.shown
        gain = self._sigma**2 / (self._sigma**2 + ghost.sigma**2)
        self.share += gain * (ghost.share - self.share)
        self._sigma = min(math.hypot(math.sqrt(gain) * ghost.sigma, DRIFT), SHARE_STD)

    def corrected(self, rotation_deg: float, sigma_deg: float, ghost: Ghost) -> RotationEstimate:
        """Return a rotation corrected for memory that is certain; memory that is only possible widens sigma."""
        correction_deg = ghost.pull_deg * min(max(self.share, 0.0), 1.0)
        spread_deg = SPREAD_SHARE * abs(ghost.pull_deg) * self._sigma
        if self.certain:
            sigma_deg = math.hypot(sigma_deg, spread_deg, CORRECTION_SHARE * correction_deg)
            return RotationEstimate(rotation_deg + correction_deg, sigma_deg)
        possible_deg = min(math.hypot(correction_deg, spread_deg), POSSIBLE_MAX * abs(rotation_deg))
        return RotationEstimate(rotation_deg, math.hypot(sigma_deg, possible_deg))
