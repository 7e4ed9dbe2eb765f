"""The condition of an untouched gel, from comparisons with its background images: its light, and its wear."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slipguard.perception.background import GelChange

LEVEL_MAX = 15.0
"""Gray levels, as `UNEVEN_MAX`: each is half of the difference that the contact gate accepts (see
`slipguard.perception.skipping`). Frames of two real units, minutes apart, differ by up to 5.4 evenly."""
UNEVEN_MAX = 4.0
WORN_MM2 = 0.3
"""A spot of 0.6 mm. Rendered drifts of up to 15 levels leave marks of 0.07 mm2 at most, real ones none."""


class GelStatus(StrEnum):
    """ok: unchanged. drifted: calibrate again. marked: small lasting marks. worn: clean it, or replace it."""

    OK = "ok"
    DRIFTED = "drifted"
    MARKED = "marked"
    WORN = "worn"


@dataclass(frozen=True, slots=True)
class GelCondition:
    """light: since the newest background image. wear: since the first one of this gel. action: empty if it is ok."""

    status: GelStatus
    light: GelChange
    wear: GelChange
    marked_mm2: float
    observed: str
    action: str


def assess_gel(light: GelChange, wear: GelChange, px_per_mm: float) -> GelCondition:
    """Return the condition that follows from two comparisons; wear outranks drift."""
    marked_mm2 = wear.marked_px / px_per_mm**2
    marks = "1 lasting mark" if len(wear.marks) == 1 else f"{len(wear.marks)} lasting marks"
    if marked_mm2 >= WORN_MM2:
        first = wear.marks[0]
        observed = (
            f"{marks} since the gel's first background image, total area {marked_mm2:.1f} mm² (limit {WORN_MM2:g}); "
            f"the strongest has {first.levels:.0f} gray levels at x = {first.x_px:.0f}, y = {first.y_px:.0f} px"
        )
        action = "clean the gel; if the marks stay, replace it and run `slipguard calibrate --new-gel`"
        return GelCondition(GelStatus.WORN, light, wear, marked_mm2, observed, action)
    brightest = max(light.level_bgr, key=abs)
    if abs(brightest) > LEVEL_MAX or light.uneven_levels > UNEVEN_MAX:
        blue, green, red = light.level_bgr
        observed = (
            f"the light has changed since the background image: blue {blue:+.0f}, green {green:+.0f}, red {red:+.0f} "
            f"gray levels (limit {LEVEL_MAX:g}), unevenly by {light.uneven_levels:.1f} (limit {UNEVEN_MAX:g})"
        )
        action = "open and empty the jaws and run `slipguard calibrate`"
        return GelCondition(GelStatus.DRIFTED, light, wear, marked_mm2, observed, action)
    if wear.marks:
        observed = f"{marks}, total area {marked_mm2:.2f} mm²"
        return GelCondition(GelStatus.MARKED, light, wear, marked_mm2, observed, "clean the gel when convenient")
    return GelCondition(GelStatus.OK, light, wear, marked_mm2, "unchanged", "")
