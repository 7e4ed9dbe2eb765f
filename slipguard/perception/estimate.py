"""What perception returns for one frame of one finger, and the reasons why a frame gives no rotation.

`Estimate.declined` starts with one of these reasons. Details follow after a colon: the measured value, the limit, and
what to do. Match on `Estimate.decline_reason`, never on the whole text: the value changes from frame to frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from pydantic.json_schema import SkipJsonSchema


class DeclineReason(StrEnum):
    """Why there is no rotation, or no shift."""

    NO_CONTACT = "no contact"
    NO_BACKGROUND = "no background image"
    NO_REFERENCE = "no reference yet"
    CONTACT_TOO_SMALL = "contact too small"
    CONTACT_CHANGED = "contact changed too much since the reference"
    ROUND = "round contact"
    UNCERTAIN = "too uncertain"
    SEVERAL_ROTATIONS = "texture fits at several rotations"
    SHIFT_AMBIGUOUS = "periodic texture, shift ambiguous"
    IMAGE = "image unusable"


def explain(reason: DeclineReason, detail: str) -> str:
    """Return a reason with the value, the limit and what to do, as in "round contact: aspect 1.08, limit 1.15"."""
    return f"{reason.value}: {detail}"


@dataclass(frozen=True, slots=True)
class AxisEstimate:
    """The axis of one contact patch, or why there is none.

    angle_deg: axial, in (-90, 90], counter-clockwise as a viewer sees the image, 0 along +x (right).
    sigma_deg: one standard deviation of `angle_deg`.
    center_px: (x right, y down) of the patch in frame pixels (240 x 320).
    declined: None, or why there is no angle, a `DeclineReason` with details; then `angle_deg` is None.
    """

    method: str
    angle_deg: float | None
    sigma_deg: float | None
    center_px: tuple[float, float] | None
    declined: str | None = None


@dataclass(frozen=True, slots=True)
class RotationEstimate:
    """A rotation since the reference, degrees counter-clockwise, with its sigma; declined: why there is none."""

    rotation_deg: float | None
    sigma_deg: float | None
    declined: str | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """The rotation of the object in one finger's image since the reference.

    Either `rotation_deg` and `sigma_deg` are numbers, or `declined` says why there is none:

    >>> Estimate(7, 0.1, 0.1, True, 5000, "registration", rotation_deg=12.5, sigma_deg=0.2).decline_reason
    >>> Estimate(8, 0.2, 0.2, True, 5000, "registration", declined="round contact: aspect 1.1").decline_reason
    'round contact'

    rotation_deg: signed, unwrapped rotation since the reference, counter-clockwise positive as a viewer sees the image.
    sigma_deg: one standard deviation of `rotation_deg`; None exactly where `rotation_deg` is None.
    orientation_deg: axial orientation now, in (-90, 90].
    rate_deg_s: filtered rotation rate; None if unknown.
    shift_mm: (right, up) of the patch center since the reference; None before it, or if `shift_declined`.
    shift_declined: None, or why the shift is unknown.
    slides: the object slides by an unknown distance: its periodic texture moves.
    contact_area_px: in frame pixels (240 x 320).
    contact_radius_mm: of a disk with this area; None without contact.
    measured_at_s: capture time of the measured frame; older than `captured_at_s` after a skip.
    skipped: None, or which skip was taken ("no contact", "unchanged", "other finger").
    declined: None, or why there is no angle, a `DeclineReason` with details after a colon.
    segmented: False if contact area and mask are an earlier frame's; not recorded.
    """

    sequence: int
    captured_at_s: float
    measured_at_s: float
    contact: bool
    contact_area_px: int
    method: str
    rotation_deg: float | None = None
    sigma_deg: float | None = None
    orientation_deg: float | None = None
    rate_deg_s: float | None = None
    shift_mm: tuple[float, float] | None = None
    shift_declined: str | None = None
    slides: bool = False
    skipped: str | None = None
    declined: str | None = None
    stage_ms: Mapping[str, float] = field(default_factory=dict)
    segmented: SkipJsonSchema[bool] = True
    contact_radius_mm: float | None = None

    @property
    def has_reference(self) -> bool:
        """Whether the frame was compared with a reference."""
        return self.shift_mm is not None or self.shift_declined is not None

    @property
    def decline_reason(self) -> str | None:
        """The reason of `declined` without its details: the same text as long as the cause is the same."""
        return None if self.declined is None else self.declined.partition(":")[0]

    @property
    def unusable(self) -> bool:
        """The image shows neither rotation nor contact: `contact` is what the network made of it."""
        return self.decline_reason == DeclineReason.IMAGE

    def without_motion(self, declined: str) -> Estimate:
        """Return the estimate without any rotation, shift or slide, declined for this reason."""
        return replace(
            self,
            rotation_deg=None,
            sigma_deg=None,
            rate_deg_s=None,
            shift_mm=None,
            slides=False,
            declined=declined,
        )
