"""Build observations and estimates from a few values."""

from __future__ import annotations

from dataclasses import replace

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.messages import NO_REQUEST, ControlRequest, FingerHealth, Observation, RequestKind
from slipguard.control.params import GuardParams, GuardTuning
from slipguard.devices import ArmState, GripperState
from slipguard.perception.estimate import Estimate


def gripper(
    force_n: float = 40.0, *, holding: bool = True, moving: bool = False, at_s: float = 0.0, nothing: bool = False,
    fault: str | None = None, active: bool = True, width_mm: float = 30.0, known: bool = True,
) -> GripperState:  # fmt: skip
    return GripperState(active, moving, holding, nothing, width_mm, force_n, fault, at_s, known)


def arm(
    height_mm: float = 0.0, *, moving: bool = False, at_s: float = 0.0, protective: bool = False,
    emergency: bool = False,
) -> ArmState:  # fmt: skip
    return ArmState(height_mm, 50.0 * moving, moving, protective, emergency, at_s)


def fused(
    rotation_deg: float | None = 0.0, rate_deg_s: float | None = 0.0, *, at_s: float = 0.0,
    shift_mm: float | None = 0.0,
    contact: bool = True, sigma_deg: float = 0.5, fingers: tuple[str, ...] = ("left", "right"),
    conflict: str | None = None, note: str | None = None, declined: str | None = None,
    contact_radius_mm: float | None = None,
) -> FusedEstimate:  # fmt: skip
    declines = rotation_deg is None
    return FusedEstimate(
        contact, contact, at_s, at_s, () if declines else fingers, rotation_deg, None if declines else sigma_deg,
        None if declines else rate_deg_s, shift_mm, conflict, note, declined, contact_radius_mm=contact_radius_mm,
    )  # fmt: skip


def observation(now_s: float, **changes: object) -> Observation:
    """All well at `now_s`: an object held, rotation estimated, the arm at rest, everything just measured."""
    base = Observation(
        now_s=now_s, fused=fused(at_s=now_s), left=FingerHealth(), right=FingerHealth(),
        gripper=gripper(at_s=now_s), arm=arm(at_s=now_s), request=NO_REQUEST,
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


def guard_params(**keys: object) -> GuardParams:
    """The parameters with some keys changed, each put where it belongs: into [guard] or [guard.tuning]."""
    tuning = {key: keys.pop(key) for key in list(keys) if key in GuardTuning.model_fields}
    return GuardParams(**keys, tuning=GuardTuning(**tuning))  # type: ignore[arg-type]


def ask(kind: RequestKind, **values: float) -> ControlRequest:
    return ControlRequest(kind, **values)


def estimate(
    rotation_deg: float | None = 0.0, sigma_deg: float | None = 0.5, *, at_s: float = 0.0,
    rate_deg_s: float | None = None, contact: bool = True, shift_mm: tuple[float, float] | None = None,
    declined: str | None = None, measured_s: float | None = None,
) -> Estimate:  # fmt: skip
    return Estimate(
        1, at_s, at_s if measured_s is None else measured_s, contact, 4000, "fused",
        rotation_deg=rotation_deg, sigma_deg=None if rotation_deg is None else sigma_deg,
        rate_deg_s=rate_deg_s, shift_mm=shift_mm, declined=declined,
    )  # fmt: skip
