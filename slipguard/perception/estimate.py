"""What one finger says about one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class AxisEstimate:
    """The axis of one contact patch, or why there is none.

    angle_deg: axial, in (-90, 90], counter-clockwise as a viewer sees the picture, 0 along +x (right).
    sigma_deg: one standard deviation of `angle_deg`.
    center_px: (x right, y down) of the patch in frame pixels (240 x 320).
    declined: None, or why no angle can be told ("round contact", "clipped by the frame", ...); then angle is None.
    """

    method: str
    angle_deg: float | None
    sigma_deg: float | None
    center_px: tuple[float, float] | None
    declined: str | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """The turn of the object in one finger's picture since the reference.

    angle_deg: signed, unwrapped turn since the reference, counter-clockwise positive as a viewer sees the picture.
    sigma_deg: one standard deviation of `angle_deg`; None exactly where `angle_deg` is None.
    orientation_deg: axial orientation now, in (-90, 90].
    rate_deg_s: filtered turning rate; None where not known.
    shift_mm: (right, up) of the patch centre since the reference; None before it.
    contact_area_px: in frame pixels (240 x 320).
    measured_at_s: capture time of the frame the answer was measured on; older than `captured_at_s` after a skip.
    skipped: None, or which skip was taken ("no contact", "unchanged", "other finger").
    declined: None, or why there is no angle.
    """

    sequence: int
    captured_at_s: float
    measured_at_s: float
    contact: bool
    contact_area_px: int
    method: str
    angle_deg: float | None = None
    sigma_deg: float | None = None
    orientation_deg: float | None = None
    rate_deg_s: float | None = None
    shift_mm: tuple[float, float] | None = None
    skipped: str | None = None
    declined: str | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)
