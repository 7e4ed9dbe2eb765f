"""What perception returns for one frame of one finger, and the timer that fills `Estimate.stage_ms`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from pydantic.json_schema import SkipJsonSchema

from slipguard.perception.declined import DeclineReason


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


class StageTimer:
    """Collects milliseconds per pipeline stage. The stage names are keys of `bench`'s JSON.

    clock: returns seconds; None leaves `stage_ms` empty.
    """

    def __init__(self, clock: Callable[[], float] | None) -> None:
        self._clock = clock
        self.stage_ms: dict[str, float] = {}
        self._since_s = 0.0 if clock is None else clock()

    def mark(self, stage: str) -> None:
        """Add the time since the last mark to `stage`; a stage may be marked more than once."""
        if self._clock is None:
            return
        now_s = self._clock()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now_s - self._since_s)
        self._since_s = now_s
