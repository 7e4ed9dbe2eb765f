"""What an untouched gel's picture says of its light and of its wear, in words, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slipguard.perception.quality.gel_wear import GelChange

LEVEL_MAX = 15.0
"""Grey levels, as `UNEVEN_MAX` is: each half of what makes a picture unlike the no-contact image (see
`slipguard.perception.contact.gate`). Frames of two real units, taken over minutes, differ by up to 5.4 evenly."""
UNEVEN_MAX = 4.0
WORN_MM2 = 0.3
"""A spot of 0.6 mm. Rendered drifts of up to 15 levels leave marks of 0.07 mm2 at most, real ones none."""


class GelStatus(StrEnum):
    """ok: unchanged. drifted: calibrate again. marked: small lasting marks. worn: clean it; where they stay, replace it."""

    OK = "ok"
    DRIFTED = "drifted"
    MARKED = "marked"
    WORN = "worn"


@dataclass(frozen=True, slots=True)
class GelCondition:
    """light: since the newest no-contact image. wear: since the first one of this gel. do: empty where it is fine."""

    status: GelStatus
    light: GelChange
    wear: GelChange
    marked_mm2: float
    observed: str
    action: str


def describe_gel(light: GelChange, wear: GelChange, px_per_mm: float) -> GelCondition:
    """What two comparisons come to, in words; wear before drift."""
    marked_mm2 = wear.marked_px / px_per_mm**2
    if marked_mm2 >= WORN_MM2:
        first = wear.marks[0]
        observed = (
            f"{_marks(len(wear.marks))} since the gel's first no-contact image, {marked_mm2:.1f} mm² together; the "
            f"strongest {first.levels:.0f} grey levels at {first.x_px:.0f}, {first.y_px:.0f} px"
        )
        action = "clean the gel; where they stay it is worn: replace it, then `slipguard calibrate --new-gel`"
        return GelCondition(GelStatus.WORN, light, wear, marked_mm2, observed, action)
    brighter = max(light.level_bgr, key=abs)
    if abs(brighter) > LEVEL_MAX or light.uneven_levels > UNEVEN_MAX:
        blue, green, red = light.level_bgr
        observed = (
            f"the light has changed since the no-contact image: blue {blue:+.0f}, green {green:+.0f}, red {red:+.0f} "
            f"grey levels, its pattern by {light.uneven_levels:.1f}"
        )
        return GelCondition(
            GelStatus.DRIFTED, light, wear, marked_mm2, observed, "jaws open and empty: `slipguard calibrate`"
        )
    if wear.marks:
        observed = f"{_marks(len(wear.marks))}, {marked_mm2:.2f} mm² together"
        return GelCondition(GelStatus.MARKED, light, wear, marked_mm2, observed, "clean the gel when convenient")
    return GelCondition(GelStatus.OK, light, wear, marked_mm2, "as it was", "")


def _marks(count: int) -> str:
    return "a lasting mark" if count == 1 else f"{count} lasting marks"
