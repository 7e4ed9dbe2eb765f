"""Registration of a frame's texture to the reference's: the rotation, and how uncertain it is.

Inverse compositional alignment (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56 (2004) 221-255) of the
gel's curvature inside and close around the reference's contact: robust least squares of rotation and shift, with a
scale and a gain for the change of force. Points where the gel did not follow get little weight.

The noise model has three terms:
    spread    the residual, summed up by blocks: how far the parts of the contact disagree about the rotation. It
              contains the camera's noise and every deformation that differs from block to block. (Cluster-robust
              covariance: K.-Y. Liang, S. Zeger, "Longitudinal data analysis using generalized linear models",
              Biometrika 73 (1986) 13-22.) The more a contact has deformed, the more of it all blocks have in common:
              the spread counts more the less the texture correlates with the reference's
    lead      the middle has rotated further than the rest. Gel that sticks to its surroundings lags behind the object,
              none leads: the object has rotated with the middle, and the rotation is corrected by a part of the lead
    rolling   an arc that has slid along itself has also rotated, and a tilted object rolls along its arc
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import DeclineReason, explain
from slipguard.perception.texture_map import HEIGHT_PX, WIDTH_PX, Field, ImageWindow, TextureMap
from slipguard.perception.texture_template import EDGE_PX, MOTIONS, TextureTemplate

ITERATIONS_MAX = 8
ROBUST = 2.5
"""Differences beyond this many times their r.m.s. are weighted less."""
ALIKE_MIN = 0.5
"""Smallest correlation of the reference's texture with the current one, and smallest share of it within the image: real
gels sheared by 1 mm reach a correlation of 0.5."""
CORRELATED = 30.0
"""Number of the template's points with the same error."""
_PRIOR_STD = np.array([10.0, 6.0, 6.0, 0.1, 0.5])
"""Weak priors: rotation (rad), shift from the start (texture pixels), scale and gain (shares)."""
_ROUND_PRIOR_STD = np.append(1e-6, _PRIOR_STD[1:])
"""The same for a round texture, whose rotation is held."""

FLOOR_DEG = 0.05
SPREAD, LEAD, ROLLING = 1.3, 0.4, 0.8
"""Shares of the three terms in sigma, fitted by `python -m tests.campaigns fit-sigma`."""
DEFORMED = 0.035
"""A correlation this far below 1 doubles the spread's share. Fitted likewise."""
LEAD_CORRECTION = 0.45
"""Share of the lead of the middle by which the rotation is corrected, fitted likewise."""
LEAD_SIGMAS = 1.5
"""A lead counts as far as it exceeds this many standard deviations of the blocks."""

GHOST_MODEL = 0.015
"""Share of the reference that other causes than memory leave of it in place: a ghost of which little is visible beside
the motion is as uncertain as that."""
GHOST_SHOWN_MIN = 0.01
"""Part of the unmoved reference's square that no motion explains, above which a ghost is neither motion nor
interpolation. A share of 0.65 reads 1.2 at 0.002, 0.8 at
0.01, and 0.66 from 0.1 on."""

_DIFFERENCE, _MOTION, _GAIN, _UNMOVED = 0, slice(1, MOTIONS + 1), MOTIONS, MOTIONS + 1
"""Rows of the fields of a fit: the residual; the motions, of which the last (gain) is the template's value; the
template's own unmoved image. All weighted sums follow from one table of their products."""


@dataclass(frozen=True, slots=True)
class TexturePose:
    """Motion of the reference's texture: degrees counter-clockwise, texture pixels right and down, factors."""

    rotation_deg: float = 0.0
    dx_px: float = 0.0
    dy_px: float = 0.0
    scale: float = 1.0
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class Ghost:
    """A part of the reference's texture that stays in place while the rest moves.

    share: its amplitude relative to that of the fitted texture, with one standard deviation: the same before and after
    the two come apart. pull_deg: by how much a ghost of share 1 changes the rotation that a fit without a ghost finds,
    to first order. shown: whether the texture has moved enough for a ghost to be no motion and no interpolation.
    """

    share: float
    sigma: float
    pull_deg: float
    shown: bool = True


@dataclass(frozen=True, slots=True)
class Registration:
    """The best pose and the terms of its uncertainty, degrees.

    spread_deg, lead_deg, rolling_deg: the three terms of the noise model. axis_lead_deg: the lead near the grasp axis.
    alike: correlation with the reference. information: number of independent points, for the probability of this pose
    against another one.
    ghost: how much of the reference's own texture stayed in place. declined: None, or why there is no rotation.
    """

    pose: TexturePose
    spread_deg: float
    lead_deg: float
    axis_lead_deg: float
    rolling_deg: float
    alike: float
    information: float
    ghost: Ghost
    declined: str | None = None

    @property
    def sigma_deg(self) -> float:
        """One standard deviation of the rotation."""
        spread_deg = SPREAD * (1.0 + (1.0 - self.alike) / DEFORMED) * self.spread_deg
        return math.hypot(FLOOR_DEG, spread_deg, LEAD * self.lead_deg, ROLLING * self.rolling_deg)

    @property
    def rotation_deg(self) -> float:
        """The object's rotation."""
        return self.pose.rotation_deg + math.copysign(LEAD_CORRECTION * self.axis_lead_deg, self.pose.rotation_deg)


def register(template: TextureTemplate, texture_map: TextureMap, start: TexturePose) -> Registration:
    """Register a texture map to the template, from a start within some degrees and pixels.

    A round texture shows a shift and no rotation: it stays at the start, and is declined.
    """
    fields = np.empty((_UNMOVED + 1, template.value.size), np.float32)
    fields[_MOTION] = template.motion
    difference, pose = fields[_DIFFERENCE], start
    prior = CORRELATED / (_PRIOR_STD if template.round_reason is None else _ROUND_PRIOR_STD) ** 2
    for _ in range(ITERATIONS_MAX):
        visible = _sample(template, texture_map, pose, difference)
        difference -= np.float32(pose.gain) * template.value
        square = difference * difference
        noise2 = max(float(visible @ square) / max(float(visible.sum()), 1.0), 1e-6)
        weight = visible / (1.0 + square * np.float32(1.0 / (ROBUST**2 * noise2)))
        products, fitted = _products(fields[:_UNMOVED], weight), pose
        normal, pose, converged = _improved(products, fitted, start, prior * noise2)
        if converged:
            break
    left, top = (round(at - inside) for at, inside in zip(template.center_px, template.origin_px, strict=True))
    own_map = TextureMap(ImageWindow(left, top, 0, 0), template.image)
    in_both = weight * _sample(template, own_map, pose, fields[_UNMOVED])
    ghost = find_ghost(_products(fields, in_both), float(in_both.sum()))

    row = np.linalg.inv(normal)[0] * _gains(pose)
    parts = np.bincount(template.block, (row.astype(np.float32) @ template.motion) * weight * difference)
    own2 = max(float(products[_GAIN, _GAIN]), 1e-9)
    both = float(products[_DIFFERENCE, _GAIN]) + fitted.gain * own2
    now2 = float(products[_DIFFERENCE, _DIFFERENCE]) + fitted.gain * (2.0 * both - fitted.gain * own2)
    alike = both / math.sqrt(own2 * max(now2, 1e-9 * own2))
    leads_deg = _leads_deg(template, difference * (visible > 0.0), pose.rotation_deg)
    return Registration(
        pose,
        spread_deg=min(math.degrees(math.sqrt(float(parts @ parts))), 180.0),
        lead_deg=max(leads_deg),
        axis_lead_deg=leads_deg[0],
        rolling_deg=_rolling_deg(template, pose),
        alike=alike,
        information=float(visible.sum()) / CORRELATED,
        ghost=replace(ghost, share=ghost.share / pose.gain, sigma=ghost.sigma / pose.gain),
        declined=template.round_reason or _declined(float(visible.sum()) / visible.size, alike),
    )


def _improved(
    products: NDArray[np.float64], pose: TexturePose, start: TexturePose, prior: NDArray[np.float64]
) -> tuple[NDArray[np.float64], TexturePose, bool]:
    """Return the normal equations of one step, the pose after it, and whether the step was small."""
    gains = _gains(pose)
    gradient = products[_MOTION, _DIFFERENCE] * gains
    rotation = math.radians(pose.rotation_deg)
    c, s = math.cos(rotation), math.sin(rotation)
    away_x, away_y = pose.dx_px - start.dx_px, pose.dy_px - start.dy_px
    gradient[1] += prior[1] * (c * away_x - s * away_y)
    gradient[2] += prior[2] * (s * away_x + c * away_y)
    gradient[3] -= prior[3] * (pose.scale - 1.0)
    gradient[4] -= prior[4] * (pose.gain - 1.0)
    normal = products[_MOTION, _MOTION] * (gains[:, None] * gains)
    normal.flat[:: MOTIONS + 1] += prior + 1e-7 * normal.trace()
    step, move_x, move_y, grow, strengthen = np.linalg.solve(normal, gradient).tolist()
    step = min(max(step, -0.2), 0.2)
    # Inverse composition: apply the inverse of the step before the current pose.
    rotation -= step
    c, s = math.cos(rotation), math.sin(rotation)
    better = TexturePose(
        math.degrees(rotation),
        pose.dx_px - (c * move_x + s * move_y),
        pose.dy_px - (c * move_y - s * move_x),
        min(max(pose.scale + grow, 0.5), 2.0),
        min(max(pose.gain + strengthen, 0.2), 5.0),
    )
    return normal, better, abs(step) < 8e-4 and abs(move_x) + abs(move_y) < 0.04


def _gains(pose: TexturePose) -> NDArray[np.float64]:
    """Return by how much a texture of this strength changes more than the template's, by motion."""
    return np.array([pose.gain, pose.gain, pose.gain, pose.gain, 1.0])


def _products(fields: Field, weight: Field) -> NDArray[np.float64]:
    """Return the weighted sums of the products of every two fields, (k, k). fields: (k, N)."""
    return ((fields * weight) @ fields.T).astype(np.float64)


def _declined(visible: float, alike: float) -> str | None:
    """Return why a pose is none: too little of the texture is visible and alike. visible: its share in the image."""
    if min(alike, visible) >= ALIKE_MIN:
        return None
    detail = f"texture correlates by {alike:.2f} and {visible:.0%} of it is visible, limit of both {ALIKE_MIN:.2f}"
    return explain(DeclineReason.CONTACT_CHANGED, detail)


def _sample(template: TextureTemplate, texture_map: TextureMap, pose: TexturePose, values: Field) -> Field:
    """Write the map's values where the template's points are now; return 1 for points within the image, else 0."""
    window, rotation = texture_map.window, math.radians(pose.rotation_deg)
    c, s = pose.scale * math.cos(rotation), pose.scale * math.sin(rotation)
    right = template.center_px[0] + pose.dx_px - window.left_px
    down = template.center_px[1] + pose.dy_px - window.top_px
    place = np.array([[c, s, right], [-s, c, down]], np.float32) @ template.place
    # As one row: OpenCV takes six times as long for a column.
    cv2.remap(
        texture_map.curvature, place[:1], place[1:], cv2.INTER_LINEAR, values.reshape(1, -1), cv2.BORDER_REPLICATE
    )
    rows, columns = texture_map.curvature.shape
    farthest = np.array([[columns - 1 - EDGE_PX], [rows - 1 - EDGE_PX]], np.float32)
    inside = (place >= EDGE_PX) & (place <= farthest)
    return np.asarray(inside[0] & inside[1], np.float32)


def _leads_deg(template: TextureTemplate, left: Field, rotation_deg: float) -> tuple[float, float]:
    """Return how much further than the rest the texture near the grasp axis, and near its center, has rotated.

    In the direction of the rotation; 0 if it lags, or if the blocks of the contact do not agree on it.

    Args:
        template: The reference's texture.
        left: (N,), the residual of the visible points. All have the same weight: a robust fit would leave out a middle
            that moves differently.
        rotation_deg: The rotation of the whole.
    """
    leads = []
    for weights in template.local:
        parts = np.degrees(np.bincount(template.block, weights * left))
        lead, chance = -math.copysign(1.0, rotation_deg) * float(parts.sum()), LEAD_SIGMAS**2 * float(parts @ parts)
        leads.append(math.sqrt(max(lead * lead - chance, 0.0)) if lead > 0.0 else 0.0)
    return leads[0], leads[1]


def _rolling_deg(template: TextureTemplate, pose: TexturePose) -> float:
    """Return the rotation that a texture shows if it has rolled along its own arc as far as it has slid.

    The slide is that of the object's point at the grasp axis: a rotation about the axis slides nothing.
    """
    c, s = math.cos(math.radians(pose.rotation_deg)), math.sin(math.radians(pose.rotation_deg))
    right, down = (WIDTH_PX - 1) / 2.0 - template.center_px[0], (HEIGHT_PX - 1) / 2.0 - template.center_px[1]
    slide_x = pose.dx_px + c * right + s * down - right
    slide_y = pose.dy_px + c * down - s * right - down
    arc_x, arc_y = template.arc_deg_px
    return abs(arc_x * (c * slide_x - s * slide_y) + arc_y * (c * slide_y + s * slide_x))


def find_ghost(products: NDArray[np.float64], mass: float) -> Ghost:
    """Return how much of the reference stays in place (a gel's memory).

    If a share a of an image stays and 1 - a rotates, a fit of small rotations finds 1 - a of the rotation. It leaves
    a / (1 - a) of the unmoved reference, except for what rotation, shift, scale and gain explain. That factor is found
    by least squares.

    Args:
        products: Weighted products of the fields of a fit.
        mass: Sum of the weights.
    """
    normal, unmoved = products[_MOTION, _MOTION], products[_MOTION, _UNMOVED]
    explained = np.linalg.solve(normal + 1e-9 * (normal.trace() + 1e-9) * np.eye(MOTIONS), unmoved)
    whole = float(products[_UNMOVED, _UNMOVED])
    square = max(whole + float(explained @ (normal @ explained - 2.0 * unmoved)), 0.0) + 1e-9
    pull_deg = math.degrees(float(explained[0]))
    found = float(products[_DIFFERENCE, _UNMOVED] - explained @ products[_MOTION, _DIFFERENCE])
    left2 = max(float(products[_DIFFERENCE, _DIFFERENCE]) - found**2 / square, 0.0) / max(mass, 1e-9)
    sigma = math.sqrt((CORRELATED * left2 + GHOST_MODEL**2 * whole) / square)
    return Ghost(found / square, sigma, pull_deg, square > GHOST_SHOWN_MIN * whole)
