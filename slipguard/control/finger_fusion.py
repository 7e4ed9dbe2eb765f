"""Fuse the estimates of both fingers into one rotation of the object.

The fingers face each other, so a rotation of the object has opposite signs in their images. Rotations are positive
counter-clockwise in the LEFT finger's image; the sign of the right one is flipped here and nowhere else.
Shifts are the contact's motion since the reference in the left finger's image: down and to the right are positive. How
the image is oriented to gravity depends on the arm's pose (slide_direction.py), and every direction counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.perception.estimate import Estimate

SIGMA_FLOOR_DEG = 0.1
"""No estimate counts as more certain than this."""
AGREE_SIGMAS = 3.0
"""Rotations further apart than this many combined standard deviations disagree."""
DIFFER_DEG = 3.0
"""Two fingers that disagree contradict each other if they also differ by more than this plus DIFFER_SHARE of the larger
rotation: about twice the largest difference in lifts, elastic torsion of soft pads included (1.6 degrees; 0.6 times
this limit in 20 rendered lifts)."""
DIFFER_SHARE = 0.1
"""A finger's error grows with the rotation, by up to 4.5 % of it (one standard deviation)."""
GAP_MAX_S = 0.1
"""A finger further behind the other than this is left out; frames come every 17-33 ms."""
SIGMA_MAX_DEG = 180.0
SHIFTS_DIFFER_MM, SHIFTS_DIFFER_SHARE = 4.0, 0.5
"""Two fingers contradict each other if their shifts are further apart than this plus a share of the larger one: a good
one errs by 2.5 mm, and by more in a long slide, in which the contact leaves the image."""
LARGEST = 1e6
"""No rotation in degrees, rate in degrees/s or shift in mm is larger than this."""


@dataclass(frozen=True, slots=True)
class FusedEstimate:
    """The estimate of both fingers together.

    Args:
        left_contact, right_contact: None if the finger gives no estimate, or cannot see (`Estimate.unusable`).
        captured_at_s: the moment of `rotation_deg`.
        measured_at_s, newest_at_s: the oldest and the newest measurement used.
        fingers: which fingers estimate the rotation.
        rotation_deg: of the object since the reference, positive counter-clockwise in the left image; None: `declined`.
        sigma_deg: one standard deviation, wider if the fingers disagree; None exactly if rotation_deg is None.
        rate_deg_s: of the rotation.
        shift_mm, sideways_mm: down and to the right since the reference, mean of the `shift_fingers` that know it.
        slides: no finger knows the shift, and one sees that the object slides.
        conflict: the fingers' rotations contradict each other, so only the larger one is used. shift_conflict: so do
            their shifts.
        note: what is worth reporting although there is an estimate.
        contact_radius_mm: mean radius of the contacts seen, each as the disk of its area; None if none is seen.
        declined: why there is none.
    """

    left_contact: bool | None
    right_contact: bool | None
    captured_at_s: float
    measured_at_s: float
    fingers: tuple[str, ...] = ()
    rotation_deg: float | None = None
    sigma_deg: float | None = None
    rate_deg_s: float | None = None
    shift_mm: float | None = None
    conflict: str | None = None
    note: str | None = None
    declined: str | None = None
    newest_at_s: float = -math.inf
    slides: bool = False
    sideways_mm: float | None = None
    shift_fingers: tuple[str, ...] = ()
    shift_conflict: str | None = None
    contact_radius_mm: float | None = None

    @property
    def both_touch(self) -> bool:
        """Contact in both fingers."""
        return self.left_contact is True and self.right_contact is True


@dataclass(frozen=True, slots=True)
class _Rotation:
    """One finger's rotation with the left image's sign."""

    finger: str
    rotation_deg: float
    sigma_deg: float
    rate_deg_s: float | None
    captured_at_s: float
    measured_at_s: float


def fuse(left: Estimate | None, right: Estimate | None) -> FusedEstimate | None:
    """Return the estimate of both fingers together; None if neither gives one.

    Args:
        left, right: the newest estimates; None for a finger whose frames are stale. One with an invalid number (NaN,
            infinite, too large) gives no rotation; one with an invalid time gives nothing.
    """
    left, right = _checked(left), _checked(right)
    given = [estimate for estimate in (left, right) if estimate is not None]
    if not given:
        return None
    shifts = _shifts(left, right)
    shift_mm, opposed = _mean_shift(shifts)
    both = (_rotation("left", left, 1.0), _rotation("right", right, -1.0))
    rotations = [rotation for rotation in both if rotation is not None]
    notes = [f"{name} finger: {_reason(one)}" for name, one in (("left", left), ("right", right)) if _reason(one)]
    if len(rotations) == 2:
        rotations, behind = _aligned(rotations[0], rotations[1])
        notes += behind
    base = FusedEstimate(
        left_contact=None if left is None or left.unusable else left.contact,
        right_contact=None if right is None or right.unusable else right.contact,
        captured_at_s=min(estimate.captured_at_s for estimate in given),
        measured_at_s=min(estimate.measured_at_s for estimate in given),
        newest_at_s=max(estimate.measured_at_s for estimate in given),
        shift_mm=shift_mm[1] if shift_mm is not None else None,
        sideways_mm=shift_mm[0] if shift_mm is not None else None,
        shift_fingers=tuple(shifts),
        shift_conflict=opposed,
        slides=not shifts and any(estimate.slides for estimate in given),
        contact_radius_mm=_contact_radius_mm(given),
    )
    if not rotations:
        return replace(base, declined="; ".join(notes))
    conflict = _conflict(*rotations) if len(rotations) == 2 else None
    used = rotations if conflict is None else [max(rotations, key=lambda rotation: abs(rotation.rotation_deg))]
    rotation_deg, sigma_deg = _weighted(used)
    return replace(
        base,
        captured_at_s=rotations[0].captured_at_s,
        measured_at_s=min(rotation.measured_at_s for rotation in used),
        newest_at_s=max(rotation.measured_at_s for rotation in used),
        fingers=tuple(rotation.finger for rotation in rotations),
        rotation_deg=rotation_deg,
        sigma_deg=sigma_deg,
        rate_deg_s=_rate(used),
        conflict=conflict,
        note="; ".join(notes) or None,
    )


def _contact_radius_mm(given: list[Estimate]) -> float | None:
    """Return the mean radius: both fingers press with the same force, so their torques add up as the radii do."""
    radii = [one.contact_radius_mm for one in given if one.contact_radius_mm is not None and not one.unusable]
    radii = [radius_mm for radius_mm in radii if 0.0 < radius_mm <= LARGEST]
    return sum(radii) / len(radii) if radii else None


def _shifts(left: Estimate | None, right: Estimate | None) -> dict[str, tuple[float, float]]:
    """Return the shift that each finger knows: to the right and down in the left image."""
    given = (("left", left, 1.0), ("right", right, -1.0))
    return {
        finger: (sign * estimate.shift_mm[0], -estimate.shift_mm[1])
        for finger, estimate, sign in given
        if estimate is not None and estimate.shift_mm is not None
    }


def _mean_shift(shifts: dict[str, tuple[float, float]]) -> tuple[tuple[float, float] | None, str | None]:
    """Return the shift of the object, and how the fingers contradict each other; the larger one is used then."""
    if not shifts:
        return None, None
    apart_mm = math.dist(*shifts.values()) if len(shifts) == 2 else 0.0
    larger_mm = max(math.hypot(*shift) for shift in shifts.values())
    if apart_mm > SHIFTS_DIFFER_MM + SHIFTS_DIFFER_SHARE * larger_mm:
        what = (
            f"the fingers' shifts contradict each other ({apart_mm:.1f} mm apart): one is wrong, the larger one is used"
        )
        return max(shifts.values(), key=lambda shift: math.hypot(*shift)), what
    count = len(shifts)
    return (sum(x for x, _ in shifts.values()) / count, sum(y for _, y in shifts.values()) / count), None


def _checked(estimate: Estimate | None) -> Estimate | None:
    """Return the estimate, without rotation and shift if one of its numbers is invalid."""
    if estimate is None or not (math.isfinite(estimate.captured_at_s) and math.isfinite(estimate.measured_at_s)):
        return None
    numbers = (estimate.rotation_deg, estimate.rate_deg_s, *(estimate.shift_mm or ()))
    sigma_deg = estimate.sigma_deg
    if all(n is None or abs(n) <= LARGEST for n in numbers) and (
        sigma_deg is None or 0.0 <= sigma_deg <= SIGMA_MAX_DEG
    ):
        return estimate
    return estimate.without_motion("not a number")


def _rotation(finger: str, estimate: Estimate | None, sign: float) -> _Rotation | None:
    if estimate is None or estimate.rotation_deg is None or estimate.sigma_deg is None:
        return None
    rate_deg_s = None if estimate.rate_deg_s is None else sign * estimate.rate_deg_s
    sigma_deg = max(estimate.sigma_deg, SIGMA_FLOOR_DEG)
    return _Rotation(
        finger, sign * estimate.rotation_deg, sigma_deg, rate_deg_s, estimate.captured_at_s, estimate.measured_at_s
    )


def _reason(estimate: Estimate | None) -> str | None:
    """Return why a finger gives no rotation; None if it does."""
    if estimate is None:
        return "no frames"
    if estimate.rotation_deg is not None and estimate.sigma_deg is not None:
        return None
    return estimate.declined or ("no reference yet" if estimate.contact else "no contact")


def _aligned(one: _Rotation, other: _Rotation) -> tuple[list[_Rotation], list[str]]:
    """Return both rotations at the older one's moment; only the newer one if the other is too far behind.

    A finger without a rate gets the other's, for it is one object. If neither has one, no rotation can be moved in
    time, and only the newer one counts.
    """
    older, newer = sorted((one, other), key=lambda rotation: rotation.captured_at_s)
    gap_s = newer.captured_at_s - older.captured_at_s
    rate_deg_s = older.rate_deg_s if newer.rate_deg_s is None else newer.rate_deg_s
    if gap_s > GAP_MAX_S:
        return [newer], [f"{older.finger} finger: {1e3 * gap_s:.0f} ms behind"]
    if gap_s > 0.0 and rate_deg_s is None:
        return [newer], [f"{older.finger} finger: older, and its rate is unknown"]
    moved_deg = -gap_s * (rate_deg_s or 0.0)
    back = replace(newer, rotation_deg=newer.rotation_deg + moved_deg, captured_at_s=older.captured_at_s)
    return [back if rotation is newer else rotation for rotation in (one, other)], []


def _conflict(left: _Rotation, right: _Rotation) -> str | None:
    """Return how the fingers contradict each other: no object can rotate both like that.

    The larger rotation is used then, because tightening for nothing costs less than a drop. So a finger that sees an
    imprint of its own, or whose pad rotates with the object, hides no slip however certain it is.
    """
    apart_deg = abs(left.rotation_deg - right.rotation_deg)
    apart = apart_deg / math.hypot(left.sigma_deg, right.sigma_deg)
    if apart > AGREE_SIGMAS and _certainly_opposite(left, right):
        return (
            f"both images rotate the same way (left {left.rotation_deg:+.1f}°, right {-right.rotation_deg:+.1f}°): "
            "a fault of one finger, or the object rolls"
        )
    larger_deg = max(abs(left.rotation_deg), abs(right.rotation_deg))
    if apart > AGREE_SIGMAS and apart_deg > DIFFER_DEG + DIFFER_SHARE * larger_deg:
        return (
            f"the fingers contradict each other (left {left.rotation_deg:+.1f}°, right {right.rotation_deg:+.1f}°): "
            "one is stuck or wrong, the larger rotation is used"
        )
    return None


def _weighted(rotations: list[_Rotation]) -> tuple[float, float]:
    """Return the weighted rotation and its sigma; disagreement widens sigma (Birge ratio)."""
    if len(rotations) == 1:
        return rotations[0].rotation_deg, rotations[0].sigma_deg
    left, right = rotations
    apart = abs(left.rotation_deg - right.rotation_deg) / math.hypot(left.sigma_deg, right.sigma_deg)
    weights = [rotation.sigma_deg**-2 for rotation in rotations]
    mean_deg = sum(w * rotation.rotation_deg for w, rotation in zip(weights, rotations, strict=True)) / sum(weights)
    sigma_deg = sum(weights) ** -0.5
    return mean_deg, sigma_deg * (apart if apart > AGREE_SIGMAS else 1.0)


def _certainly_opposite(left: _Rotation, right: _Rotation) -> bool:
    """Return whether both have certainly rotated, in opposite directions: no object rotates both like that."""
    certain = all(abs(rotation.rotation_deg) > AGREE_SIGMAS * rotation.sigma_deg for rotation in (left, right))
    return certain and left.rotation_deg * right.rotation_deg < 0.0


def _rate(rotations: list[_Rotation]) -> float | None:
    known = [(rotation.sigma_deg**-2, rotation.rate_deg_s) for rotation in rotations if rotation.rate_deg_s is not None]
    if not known:
        return None
    return sum(weight * rate for weight, rate in known) / sum(weight for weight, _ in known)
