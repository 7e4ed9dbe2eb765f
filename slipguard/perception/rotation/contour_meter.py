"""Measures rotation and shift of a contact by its contour, against one reference's."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from slipguard.perception.contact.patch import Patch
from slipguard.perception.rotation.contour_registration import ContourFit, ContourPose, ContourRegistrar
from slipguard.perception.rotation.contour_template import ContourTemplate, make_contour_template
from slipguard.perception.rotation.fusion import RotationEstimate

MISFIT_SIGMAS = 1.5
"""If the contour is not the reference's any more, the axis is off too: by this share of the contour's misfit."""
SECOND_START_DEG = 4.0
"""If the axis points further away than this from the registered contour, registration also starts from there."""


@dataclass(frozen=True, slots=True)
class ContourMeasurement:
    """Rotation by the contour; the axis, widened if the contact has changed; shift in frame pixels right and down."""

    rotation: RotationEstimate
    axis: RotationEstimate
    shift_px: tuple[float, float]


class ContourMeter:
    """Measures against the contour of one reference. rotation_deg: the last known rotation since then."""

    def __init__(self, patch: Patch, rotation_deg: float = 0.0) -> None:
        self._patch = patch
        self._pose = ContourPose(rotation_deg)

    @cached_property
    def template(self) -> ContourTemplate:
        """The reference's contour; many grasps never need it."""
        return make_contour_template(self._patch)

    def measure(
        self,
        patch: Patch,
        axis: RotationEstimate,
        near_deg: float,
        center_shift_px: tuple[float, float],
        *,
        from_axis: bool,
    ) -> ContourMeasurement:
        """Register the contour from `near_deg`, and also from where the axis points if `from_axis`.

        Args:
            patch: The contact now.
            axis: Its rotation by the axis.
            near_deg: The expected rotation.
            center_shift_px: How far its center has moved, frame pixels.
            from_axis: Whether the axis is known better than `near_deg`.
        """
        fit = self._register(patch, axis.rotation_deg if from_axis else None, near_deg, center_shift_px)
        if fit.contact_changed and axis.rotation_deg is not None and axis.sigma_deg is not None:
            axis = RotationEstimate(axis.rotation_deg, math.hypot(axis.sigma_deg, MISFIT_SIGMAS * fit.misfit_deg))
        if fit.declined is not None:
            return ContourMeasurement(RotationEstimate(None, None, fit.declined), axis, center_shift_px)
        self._pose = fit.pose
        shift_px = (fit.pose.dx_px * patch.frame_px, fit.pose.dy_px * patch.frame_px)
        return ContourMeasurement(RotationEstimate(fit.pose.rotation_deg, fit.sigma_deg), axis, shift_px)

    def _register(
        self, patch: Patch, axis_deg: float | None, near_deg: float, center_shift_px: tuple[float, float]
    ) -> ContourFit:
        registrar = ContourRegistrar(self.template, patch)
        best = registrar.fit(replace(self._pose, rotation_deg=near_deg))
        if axis_deg is None or abs(axis_deg - best.pose.rotation_deg) < SECOND_START_DEG:
            return best
        dx, dy = center_shift_px
        other = registrar.fit(ContourPose(axis_deg, dx / patch.frame_px, dy / patch.frame_px))
        better = other.declined is None and (best.declined is not None or other.residual < best.residual)
        return other if better else best
