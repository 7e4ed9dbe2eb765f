"""Fuses the rotations by texture, contour and axis of one contact into one. Pure functions.

The texture inside a contact and its shape (contour and axis) err independently, so their mean is better than either.
Contour and axis come from the same mask and err together, so the axis only checks the contour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.estimate import UnconfirmedRotation
from slipguard.perception.rotation.axial_angle import nearest_rotation_deg

AGREE_SIGMAS = 3.0
"""Two rotations agree within this many combined standard deviations."""
DISAGREE_DEG = 8.0
"""Rotations that do not agree and differ by more than this are both declined."""
CONTOUR_ALONE_DEG = 4.0
"""A contour that no axis confirms with a larger sigma fits at other rotations as well (a ring cut by the frame): each
frame would find it a little further on."""
CERTAIN_DEG = 0.8
"""A texture with a smaller sigma that the axis does not contradict needs no contour."""
LIGHT_FREE_LEVELS = 1.0
LIGHT_DEG = 0.6
"""Light that changes after the reference shifts contours: one standard deviation of the rotation per gray level of mean
difference from the background image, beyond the first level. A slope of 6 levels over the image gives 2 levels."""
SLIP_SHARE, SLIP_MAX_DEG = 0.05, 1.0
"""The part of a contact whose texture is seen may lag behind the object: by this share of the rotation in sigma, at
most by this angle, since a gel is twisted by some degrees only."""
SMOOTH_TWIST = 1.5
"""Factor on the sigma by a middle that rotates differently, for smooth contacts: most of their middle shows nothing.
Both were chosen on partial slip of training objects; larger ones decline more frames than they correct."""


@dataclass(frozen=True, slots=True)
class RotationEstimate:
    """A rotation since the reference, degrees counter-clockwise, with its sigma; declined: why there is none.

    unconfirmed: a rotation that is declined unless the other finger confirms it.
    """

    rotation_deg: float | None
    sigma_deg: float | None
    declined: str | None = None
    unconfirmed: UnconfirmedRotation | None = None

    def widened(self, by_deg: float) -> RotationEstimate:
        """Return the estimate with an independent error of this standard deviation added."""
        if self.sigma_deg is None or by_deg <= 0.0:
            return self
        return replace(self, sigma_deg=math.hypot(self.sigma_deg, by_deg))


def fuse_rotation(
    texture: RotationEstimate | None,
    contour: RotationEstimate | None,
    axis: RotationEstimate | None,
    deformation: float = 1.0,
    common_deg: float = 0.0,
) -> RotationEstimate:
    """Return one rotation from up to three measurements of the same contact.

    The rule:
        1. Without a contour, because the texture is certain: the mean of texture and axis, weighted by 1 / sigma^2.
        2. With a contour: the axis checks the contour (`check_contour`), `deformation` increases its sigma, and the
           mean of texture and checked contour is taken.
        3. A measurement that is None or declined is left out. If all are declined the texture's reason counts, then
           the contour's.
        4. Where two measurements do not agree, sigma covers both; far apart, the result is declined.

    Args:
        texture: Rotation by the texture inside the contact; None if it has none.
        contour: Rotation by the contour; None if it was not measured.
        axis: Rotation of the patch's axis; None if the estimator does not use it.
        deformation: Factor on the contour's sigma: 1, more if the contact has deformed since the reference.
        common_deg: Part of the sigmas that all measurements share, so that their mean is no better.
    """
    shape = axis
    if contour is not None:
        shape = contour if axis is None else check_contour(contour, axis)
        if shape.sigma_deg is not None:
            shape = RotationEstimate(shape.rotation_deg, deformation * shape.sigma_deg)
    given = [measurement for measurement in (texture, shape) if measurement is not None]
    fused = given[0] if len(given) == 1 else weighted_mean(*given)
    return fused if fused.sigma_deg is None else replace(fused, sigma_deg=max(fused.sigma_deg, common_deg))


def needs_contour(texture: RotationEstimate | None, axis: RotationEstimate) -> bool:
    """Return False if the texture is certain and the axis does not contradict it."""
    return not (texture is not None and is_certain(texture) and agree(texture, axis))


def is_certain(texture: RotationEstimate) -> bool:
    return texture.sigma_deg is not None and texture.sigma_deg <= CERTAIN_DEG


def check_contour(contour: RotationEstimate, axis: RotationEstimate) -> RotationEstimate:
    """Return the rotation by the contour, checked by the axis.

    Both come from one mask and err together, so their mean would be no better than the better one: the contour, unless
    its sigma is more than half as large again. Where they do not agree, sigma covers both; far apart, both are
    declined. An axis alone is used as is, a contour alone up to a sigma of `CONTOUR_ALONE_DEG`. If both are declined
    the contour's reason counts.
    """
    if contour.rotation_deg is None or contour.sigma_deg is None:
        return axis if axis.rotation_deg is not None else contour
    if axis.rotation_deg is None or axis.sigma_deg is None:
        if contour.sigma_deg <= CONTOUR_ALONE_DEG:
            return contour
        detail = f"sigma {contour.sigma_deg:.1f} deg, limit {CONTOUR_ALONE_DEG:g} deg without an axis"
        return RotationEstimate(None, None, explain(DeclineReason.CONTOUR_ALONE, detail))
    apart = abs(contour.rotation_deg - axis.rotation_deg)
    better = contour if contour.sigma_deg <= 1.5 * axis.sigma_deg else axis
    if apart <= AGREE_SIGMAS * math.hypot(contour.sigma_deg, axis.sigma_deg):
        return better
    return _covering(better, apart, "contour and axis")


def weighted_mean(texture: RotationEstimate, shape: RotationEstimate) -> RotationEstimate:
    """Return the mean of two independent rotations, weighted by 1 / sigma^2.

    One alone is used as is. If both are declined the texture's reason counts. Where they do not agree the better one
    is used, with a sigma that covers both; far apart, both are declined.
    """
    if texture.rotation_deg is None or texture.sigma_deg is None:
        return shape if shape.rotation_deg is not None else texture
    if shape.rotation_deg is None or shape.sigma_deg is None:
        return texture
    apart = abs(texture.rotation_deg - shape.rotation_deg)
    if apart > AGREE_SIGMAS * math.hypot(texture.sigma_deg, shape.sigma_deg):
        better = texture if texture.sigma_deg <= shape.sigma_deg else shape
        return _covering(better, apart, "texture and contour")
    weight, other = texture.sigma_deg**-2, shape.sigma_deg**-2
    mean = (weight * texture.rotation_deg + other * shape.rotation_deg) / (weight + other)
    return RotationEstimate(mean, (weight + other) ** -0.5)


def _covering(better: RotationEstimate, apart_deg: float, which: str) -> RotationEstimate:
    """Return a rotation with a sigma that covers one `apart_deg` away, or decline if that is too far."""
    if apart_deg > DISAGREE_DEG:
        detail = f"{which} are {apart_deg:.1f} deg apart, limit {DISAGREE_DEG:g} deg"
        return RotationEstimate(None, None, explain(DeclineReason.DISAGREE, detail))
    return RotationEstimate(better.rotation_deg, max(better.sigma_deg or 0.0, 0.5 * apart_deg))


def fuse_axis_rotations(rotations: Sequence[RotationEstimate]) -> RotationEstimate:
    """Return one rotation from those of several axis estimators: the best, averaged with all that agree with it.

    One that does not agree is left out but widens sigma. If all are declined the first one's reason counts.
    """
    given = [(r.rotation_deg, r.sigma_deg) for r in rotations if r.rotation_deg is not None and r.sigma_deg is not None]
    if not given:
        return rotations[0]
    best, sigma = min(given, key=lambda one: one[1])
    total = weights = 0.0
    widened = sigma
    for value, own in given:
        apart = abs(value - best)
        if apart <= AGREE_SIGMAS * math.hypot(own, sigma):
            total += value / own**2
            weights += 1.0 / own**2
        else:
            widened = max(widened, apart / 4.0)
    return RotationEstimate(total / weights, widened)


def agree(first: RotationEstimate, second: RotationEstimate) -> bool:
    """Return whether two rotations do not contradict each other; a declined one contradicts none."""
    if first.rotation_deg is None or first.sigma_deg is None or second.rotation_deg is None or second.sigma_deg is None:
        return True
    sigma = math.hypot(first.sigma_deg, second.sigma_deg)
    return abs(first.rotation_deg - second.rotation_deg) <= AGREE_SIGMAS * sigma


def rotation_between_axes(
    now_deg: float, now_sigma_deg: float, reference_deg: float, reference_sigma_deg: float, near_deg: float
) -> RotationEstimate:
    """Return the rotation between two axes, of all that differ by 180 degrees the one nearest `near_deg`.

    From -6 to +6 it is +12, from 80 to 100 (the axis -80) it is +20.
    """
    rotation = nearest_rotation_deg(now_deg - reference_deg, near_deg)
    return RotationEstimate(rotation, math.hypot(now_sigma_deg, reference_sigma_deg))


def widen_for_slip(rotation: RotationEstimate, twist_deg: float, smooth: bool) -> RotationEstimate:
    """Increase sigma for partial slip: a part of the contact sticks to the gel while the rest rotates.

    Args:
        rotation: The rotation to widen.
        twist_deg: Sigma by a middle that has rotated differently.
        smooth: Whether the contact has no edges.
    """
    twist_deg *= SMOOTH_TWIST if smooth else 1.0
    lag_deg = min(SLIP_SHARE * abs(rotation.rotation_deg or 0.0), SLIP_MAX_DEG)
    return rotation.widened(math.hypot(twist_deg, lag_deg))


def widen_for_light(rotation: RotationEstimate, levels: float) -> RotationEstimate:
    """Increase sigma for a change of light since the reference: the network's contours shift with the light.

    Args:
        rotation: The rotation to widen.
        levels: Mean difference from the background image, gray levels, minus that of the reference image.
    """
    if rotation.rotation_deg is None or rotation.sigma_deg is None or levels <= LIGHT_FREE_LEVELS:
        return rotation
    light_deg = LIGHT_DEG * (levels - LIGHT_FREE_LEVELS)
    return RotationEstimate(rotation.rotation_deg, math.hypot(rotation.sigma_deg, light_deg))
