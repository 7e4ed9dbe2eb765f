"""Registration of a patch to the reference's contour: a rotation without an axis and without drift.

Inverse compositional alignment (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56 (2004) 221-255) of the
blurred probability along the reference's contour. Three nuisance motions are fitted with rotation and shift: the
contour grows evenly, and the patch stretches along and across its axis, as a contact does when the force changes.
Parts of the contour outside the frame, now or in the reference, are ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.rotation.contour_template import BLUR_PX, RIM_PX, ContourTemplate, blurred, sampled
from slipguard.perception.rotation.round_contact import round_contour_reason

ITERATIONS_MAX = 8
CONTOUR_PX = 0.10
MISFIT_SHARE = 0.55
"""One standard deviation of the rotation, as an error of the contour's position in network pixels: at least this, and
this share of the misfit between the contours. Fitted to rendered rotations of the training objects."""
MISFIT_MAX_PX = 1.4
"""Contours with a larger misfit (r.m.s., network pixels) are not those of one contact."""
OVERLAP_MIN = 0.45
"""Share of the reference's contour that must be visible."""
CONTRAST_RATIO_MIN = 1.8
"""A rotation by `contour_template.CONTRAST_DEG` must change the image by this multiple of the fit's residual."""
_CORRELATED_PX = math.pi * BLUR_PX**2
"""Number of the template's pixels (every second row and column) with the same blurred error."""
_RAIL = 1e3
"""Weight that holds a shift along a template's rail at 0; the contour's own is of the order of 1."""
_PRIOR_STD = np.array([10.0, 2.0, 2.0, 6.0, 0.2, 0.2])
"""Weak priors: rotation (rad), shift x and y from the start (px), growth (px), stretch along and across (share)."""


@dataclass(frozen=True, slots=True)
class ContourPose:
    """Motion of the reference: rotation counter-clockwise, shift of its center in network pixels, y down.

    growth: growth of the contour (network pixels) and stretch of the patch along and across (shares).
    """

    rotation_deg: float = 0.0
    dx_px: float = 0.0
    dy_px: float = 0.0
    growth: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ContourFit:
    """The best pose and its sigma.

    misfit_deg: the rotation that would move the contour by as much as the fit leaves between the two contours.
    residual: r.m.s. difference of probability after the fit. declined: None, or why there is no rotation.
    """

    pose: ContourPose
    sigma_deg: float
    misfit_deg: float
    residual: float
    declined: str | None

    @property
    def contact_changed(self) -> bool:
        """Whether the contour is not that of the reference any more."""
        return self.declined is not None and self.declined.startswith(DeclineReason.CONTACT_CHANGED)


class ContourRegistrar:
    """Registers a patch to a template, from one or more starts."""

    def __init__(self, template: ContourTemplate, patch: Patch) -> None:
        self._template = template
        self._patch = patch
        self._soft = blurred(patch)
        self._cut = patch.clipped.any

    def fit(self, start: ContourPose) -> ContourFit:
        """Refine a start; converges from within about ten degrees and a few pixels.

        The shift stays near its start where the contour hardly shows it, and at 0 along a template's rail.
        """
        t = self._template
        rotation, dx, dy = math.radians(start.rotation_deg), start.dx_px, start.dy_px
        if t.value.size < 30:
            return ContourFit(start, 180.0, 180.0, 1.0, DeclineReason.CLIPPED)
        nuisance = np.array(start.growth, np.float32)
        last_step = 0.0
        for _ in range(ITERATIONS_MAX):
            difference, weight = self._difference(rotation, dx, dy, nuisance)
            weighted = t.motion.T * weight
            normal = (weighted @ t.motion).astype(np.float64)
            noise2 = max(float(weight @ difference**2) / max(float(weight.sum()), 1.0), 1e-4)
            gradient = (weighted @ difference).astype(np.float64)
            prior = _CORRELATED_PX * noise2 / _PRIOR_STD**2
            c, s = math.cos(rotation), math.sin(rotation)
            away_x, away_y = dx - start.dx_px, dy - start.dy_px
            gradient[1] += prior[1] * (c * away_x - s * away_y)
            gradient[2] += prior[2] * (s * away_x + c * away_y)
            gradient[3:] -= prior[3:] * nuisance
            held = normal + np.diag(prior)
            if t.rail is not None:
                along_x, along_y = t.rail
                away = along_x * (c * dx - s * dy) + along_y * (s * dx + c * dy)
                gradient[1] += _RAIL * along_x * away
                gradient[2] += _RAIL * along_y * away
                held[1:3, 1:3] += _RAIL * np.outer(t.rail, t.rail)
            step = np.linalg.solve(held, gradient)
            nuisance += step[3:].astype(np.float32)
            rotation_step, move_x, move_y = float(step[0]), float(step[1]), float(step[2])
            small = abs(rotation_step) < 4e-4 and abs(move_x) + abs(move_y) < 0.02
            # A rough contour makes every step too short by the same share: extrapolate the geometric series.
            ratio = rotation_step / last_step if last_step else 0.0
            last_step = rotation_step
            if 0.1 < ratio < 0.75:
                rotation_step /= 1.0 - ratio
                last_step = 0.0
            rotation_step = min(max(rotation_step, -0.3), 0.3)
            # Inverse composition: apply the inverse of the step before the current pose.
            rotation -= rotation_step
            c, s = math.cos(rotation), math.sin(rotation)
            dx -= c * move_x + s * move_y
            dy -= -s * move_x + c * move_y
            if small:
                break
        pose = ContourPose(math.degrees(rotation), dx, dy, (float(nuisance[0]), float(nuisance[1]), float(nuisance[2])))
        return self._result(pose, normal, noise2, weight)

    def _difference(
        self, rotation: float, dx: float, dy: float, nuisance: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the image minus the grown, stretched template and a robust weight, 0 outside the frame."""
        t, patch = self._template, self._patch
        c, s = np.float32(math.cos(rotation)), np.float32(math.sin(rotation))
        grown_x, grown_y = t.x_px + t.growth_x @ nuisance, t.y_px + t.growth_y @ nuisance
        x = grown_x * c + grown_y * s + np.float32(t.center_px[0] + dx - patch.left_px)
        y = grown_y * c - grown_x * s + np.float32(t.center_px[1] + dy - patch.top_px)
        difference = (
            sampled(self._soft, np.asarray(x, np.float32), np.asarray(y, np.float32), cv2.BORDER_CONSTANT) - t.value
        )
        width, height = patch.image_size
        weight = 1.0 / (1.0 + (difference * np.float32(1.0 / 0.25)) ** 2)
        left, top = np.float32(RIM_PX - patch.left_px), np.float32(RIM_PX - patch.top_px)
        right = np.float32(width - 1 - RIM_PX - patch.left_px)
        bottom = np.float32(height - 1 - RIM_PX - patch.top_px)
        if x.min() < left or y.min() < top or x.max() > right or y.max() > bottom:
            weight *= (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        return difference, weight

    def _result(
        self, pose: ContourPose, normal: NDArray[np.float64], noise2: float, weight: NDArray[np.float32]
    ) -> ContourFit:
        t = self._template
        residual = math.sqrt(noise2)
        covariance = np.linalg.inv(normal + np.diag(1e-4 / _PRIOR_STD**2))
        information = 1.0 / max(float(covariance[0, 0]), 1e-12)
        steepness2 = max(float(weight @ t.slope**2), 1e-9)
        # Motion of the contour by a rotation, beyond what shift, growth and stretch explain.
        motion_px = max(math.sqrt(information / steepness2), 1e-3)
        misfit_px = residual / math.sqrt(steepness2 / max(float(weight.sum()), 1e-6))
        misfit_deg = math.degrees(misfit_px / motion_px)
        own_px = math.hypot(CONTOUR_PX, self._patch.ragged_px)
        sigma = math.hypot(math.degrees(own_px / motion_px), MISFIT_SHARE * misfit_deg)
        declined = self._declined(float(weight.sum()), motion_px, misfit_px, residual)
        return ContourFit(pose, min(sigma, 180.0), min(misfit_deg, 180.0), residual, declined)

    def _declined(self, visible: float, motion_px: float, misfit_px: float, residual: float) -> str | None:
        t = self._template
        share = visible / t.value.size
        if visible < OVERLAP_MIN * t.value.size:
            reason = DeclineReason.CLIPPED if self._cut else DeclineReason.CONTACT_CHANGED
            return explain(reason, f"{share:.0%} of the contour is visible, limit {OVERLAP_MIN:.0%}")
        if t.periodic:
            return DeclineReason.PERIODIC_CONTOUR
        declined = round_contour_reason(motion_px, t.contrast)
        if declined is None and (misfit_px > MISFIT_MAX_PX or t.contrast < CONTRAST_RATIO_MIN * residual):
            limit_px = min(MISFIT_MAX_PX, misfit_px * t.contrast / (CONTRAST_RATIO_MIN * residual))
            detail = f"contours differ by {misfit_px:.1f} px, limit {limit_px:.1f} px"
            return explain(DeclineReason.CONTACT_CHANGED, detail)
        return declined
