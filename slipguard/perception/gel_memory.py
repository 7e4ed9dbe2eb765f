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
SHARE_MIN = 0.06
"""A larger share that is certain counts as memory, and rotations are corrected for it."""
SHARE_MAX = 0.85
"""A gel that keeps more shows too little of the present imprint."""
SPREAD_SHARE, CORRECTION_SHARE = 0.5, 0.1
"""Shares in sigma of the uncertain part of the correction, and of the correction made."""
PAST_SHARE = 0.02
"""Share in sigma of the farthest rotation: a gel that forgets also remembers the poses on the way."""
UNCERTAIN_MAX = 0.3
"""Largest sigma by memory that is not certain, as a share of the rotation: three sigmas stay below the rotation, so
that a slip is detected as early as without."""
CORRECTION_MAX = 0.5
"""Largest correction, as a share of the rotation: linearized, it is inaccurate beyond."""


class ImprintMemory:
    """The estimated share of the reference that stays in place. All constants were chosen on training objects."""

    def __init__(self) -> None:
        self._share = 0.0
        self._sigma = SHARE_STD
        self._shown = False
        self._farthest_deg = 0.0

    @property
    def certain(self) -> bool:
        return self._shown and self._share > max(SHARE_MIN, CERTAIN_SIGMAS * self._sigma)

    @property
    def too_strong(self) -> bool:
        return self.certain and self._share > SHARE_MAX

    @property
    def share(self) -> float:
        return self._share

    def update(self, ghost: Ghost) -> None:
        """Take a frame's registration into account."""
        if not math.isfinite(ghost.sigma):
            return
        self._shown = self._shown or ghost.shown
        gain = self._sigma**2 / (self._sigma**2 + ghost.sigma**2)
        self._share += gain * (ghost.share - self._share)
        self._sigma = min(math.hypot(math.sqrt(gain) * ghost.sigma, DRIFT), SHARE_STD)

    def corrected(self, rotation_deg: float, sigma_deg: float, ghost: Ghost) -> RotationEstimate:
        """Return a rotation corrected for memory that is certain; memory that is only possible widens sigma."""
        self._farthest_deg = max(self._farthest_deg, abs(rotation_deg))
        correction, spread = self._correction_deg(rotation_deg, ghost)
        if not self.certain:
            return RotationEstimate(rotation_deg, math.hypot(sigma_deg, self.possible_deg(rotation_deg, ghost)))
        past = PAST_SHARE * self._share * self._farthest_deg
        sigma_deg = math.hypot(sigma_deg, spread, CORRECTION_SHARE * correction, past)
        return RotationEstimate(rotation_deg + correction, sigma_deg)

    def possible_deg(self, rotation_deg: float, ghost: Ghost) -> float:
        """Return the sigma by memory that is only possible; 0 if it is certain."""
        possible = math.hypot(*self._correction_deg(rotation_deg, ghost))
        return 0.0 if self.certain else min(possible, UNCERTAIN_MAX * abs(rotation_deg))

    def _correction_deg(self, rotation_deg: float, ghost: Ghost) -> tuple[float, float]:
        """Return the correction and its sigma."""
        limit = CORRECTION_MAX * abs(rotation_deg)
        correction = min(max(ghost.pull_deg * max(self._share, 0.0), -limit), limit)
        return correction, min(SPREAD_SHARE * abs(ghost.pull_deg) * self._sigma, limit)
