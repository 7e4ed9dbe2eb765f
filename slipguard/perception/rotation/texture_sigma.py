"""How far to trust a turn told by the relief: one standard deviation from what is known to drive its error.

What noise does to a turn is seen in how the contact's parts disagree, and known from the camera. What deforms a contact
is what the fit leaves beyond that noise: a faint picture of a contact that has only turned is sure, a strong one
of a contact that has been sheared or pressed harder is not.
"""

from __future__ import annotations

import math

from slipguard.perception.rotation.texture_registration import FAINT_LEVELS, TextureFit

FLOOR_DEG = 0.03
SPREAD, NOISE, GROWTH, MISFIT = 1.25, 0.032, 0.72, 0.25
"""Shares in sigma of what parts of the contact disagree by, and of the turns that would change the relief as much as
the camera's noise does, as its growth since the reference, and as the deformation that the fit leaves. Chosen by
`tests.campaigns.fit_sigma` on rendered turns of the training objects and on real presses."""
HELD, HELD_FREE_DEG = 5.0, 0.05
"""Share in sigma of what a pattern that stays in its place may have held the turn back by, beyond what is found where
nothing has: nine of ten real presses stay below. Coarse compression and few grey levels give 0.1-0.4 degrees."""


def sigma_deg(answer: TextureFit) -> float:
    """One standard deviation of the turn, degrees."""
    parts = (share * part for share, part in zip(shares(), parts_deg(answer), strict=True))
    return math.hypot(FLOOR_DEG, HELD * max(answer.held_deg - HELD_FREE_DEG, 0.0), *parts)


def shares() -> tuple[float, float, float, float]:
    """What `parts_deg` are multiplied by."""
    return SPREAD, NOISE, GROWTH, MISFIT


def parts_deg(answer: TextureFit) -> tuple[float, float, float, float]:
    """Turns (degrees) by spread, noise, growth and misfit, of which sigma is made.

    A misfit counts more the more the relief has deformed, and the less a turn changes it. Both growth and misfit count
    twice where the relief is no stronger than `FAINT_LEVELS`: what the light does to a place does not turn.
    """
    faint = 1.0 + (FAINT_LEVELS / max(answer.strength, 1e-3)) ** 2
    lever = max(answer.lever, 1e-3)
    grown_deg = math.degrees(abs(math.log(answer.pose.scale)) / lever)
    return answer.spread_deg, answer.noise_deg, faint * grown_deg, faint * answer.unlike * answer.misfit_deg / lever
