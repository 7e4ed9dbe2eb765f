"""The turn of a patch since the reference by laying its picture over the reference's: no axis needed, no drift.

Inverse compositional alignment (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56 (2004) 221-255) of the
blurred probability along the reference's outline. Beside turn and shift three nuisance motions are fitted: the
outline grows evenly, and the patch stretches along and across its axis, as a contact does when the force changes.
Parts of the outline that lie, or lay, outside the frame do not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.regions import Patch

BLUR_PX = 2.0
"""Blur of both pictures, network pixels: what is within about twice this of the outline pulls."""
MAX_ROUNDS = 8
OUTLINE_PX = 0.16
"""Smooth error of the outline that mimics a turn, network pixels, one standard deviation."""
LEVER_MIN_PX = 2.2
"""A turn by a radian must move the outline by at least this (r.m.s., what shift and growth cannot explain)."""
RESIDUAL_MAX = 0.16
"""Pictures that differ more than this (r.m.s. of probability along the outline) do not show the same contact."""
OVERLAP_MIN = 0.45
"""Share of the reference's outline that must be in sight."""
RIM_PX = 5
"""Outline this close to the edge of the frame does not count: the network sees only half of what made it."""
TELLING_DEG = 12.0
CONTRAST_MIN = 0.08
CONTRAST_RATIO_MIN = 1.8
"""A turn by `TELLING_DEG` must change the picture by this much (r.m.s.), and this many times what the fit leaves."""
_PRIOR_STD = np.array([1e3, 60.0, 60.0, 6.0, 0.4, 0.4])
"""Turn (rad), shift x and y (px), growth (px), stretch along and across (share): weak, keeps the fit solvable."""
_EDGE_SHARE = 0.04
"""Pixels whose gradient is above this share of the steepest belong to the outline."""
_NOT_SAME = "contact changed too much since the reference"
_ROUND = "round contact"
_CLIPPED = "clipped by the frame"


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the reference has moved to: turn counter-clockwise, shift of its centre in network pixels, y down."""

    turn_deg: float = 0.0
    dx_px: float = 0.0
    dy_px: float = 0.0


@dataclass(frozen=True, slots=True)
class Registration:
    """The best pose, its sigma, and what is left: r.m.s. difference of probability. declined: None or why no turn."""

    pose: Pose
    sigma_deg: float
    residual: float
    declined: str | None


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The reference's outline: pixels around its centre, their values, and how each moves them.

    x_px, y_px: (N,) float32 from the centre, network pixels, y down. value: (N,) float32.
    motion: (N, 6) float32, change of value per turn, shift x, shift y, growth, stretch along, stretch across.
    centre_px: in the network's picture. slope: (N,) gradient magnitude. contrast: how much the picture differs
    (r.m.s.) from itself turned by `TELLING_DEG`.
    """

    x_px: NDArray[np.float32]
    y_px: NDArray[np.float32]
    value: NDArray[np.float32]
    motion: NDArray[np.float32]
    slope: NDArray[np.float32]
    centre_px: tuple[float, float]
    contrast: float


def _blurred(patch: Patch) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(patch.probability, (0, 0), BLUR_PX, borderType=cv2.BORDER_REPLICATE), np.float32)


def make_template(patch: Patch, angle_deg: float | None = None) -> Template:
    """Remember a patch as the reference. angle_deg: its axis where one is known; it steers the stretches."""
    soft = _blurred(patch)
    gx = cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    gy = cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    steep = np.asarray(cv2.magnitude(gx, gy), np.float32)
    outline = steep > _EDGE_SHARE * float(steep.max())
    rows, columns = soft.shape
    # Where the frame cuts the patch the outline is not the object's.
    if patch.clipped.left:
        outline[:, :RIM_PX] = False
    if patch.clipped.right:
        outline[:, columns - RIM_PX :] = False
    if patch.clipped.top:
        outline[:RIM_PX] = False
    if patch.clipped.bottom:
        outline[rows - RIM_PX :] = False
    # The blurred pictures carry nothing finer than two pixels: every second row and column is enough.
    y, x = np.nonzero(outline[::2, ::2])
    y, x = 2 * y, 2 * x
    m = cv2.moments(patch.mask, True)
    centre_x, centre_y = m["m10"] / m["m00"], m["m01"] / m["m00"]
    slope_x, slope_y = gx[y, x], gy[y, x]
    value, slope = soft[y, x], steep[y, x]
    dx, dy = (x - centre_x).astype(np.float32), (y - centre_y).astype(np.float32)
    turned = 0.0 if angle_deg is None else math.radians(angle_deg)
    c, s = np.float32(math.cos(turned)), np.float32(-math.sin(turned))
    along, across = dx * c + dy * s, dy * c - dx * s
    along_slope, across_slope = slope_x * c + slope_y * s, slope_y * c - slope_x * s
    contrast = _contrast(soft, dx, dy, value, (centre_x, centre_y))
    motion = np.stack(
        # A turn counter-clockwise as seen moves (dx, dy), y down, by (dy, -dx) a radian.
        [slope_x * dy - slope_y * dx, slope_x, slope_y, slope, along * along_slope, across * across_slope],
        axis=1,
    )
    return Template(
        dx,
        dy,
        value,
        motion,
        slope,
        (centre_x + patch.left_px, centre_y + patch.top_px),
        contrast,
    )


def _contrast(
    soft: NDArray[np.float32],
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
    value: NDArray[np.float32],
    centre: tuple[float, float],
) -> float:
    """How much the picture differs (r.m.s.) from itself turned about its centre by `TELLING_DEG` both ways."""
    total = 0.0
    for turn in (math.radians(TELLING_DEG), -math.radians(TELLING_DEG)):
        c, s = np.float32(math.cos(turn)), np.float32(math.sin(turn))
        x, y = dx * c + dy * s + np.float32(centre[0]), dy * c - dx * s + np.float32(centre[1])
        seen = np.asarray(cv2.remap(soft, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)
        total += float(np.mean((seen.ravel() - value) ** 2))
    return math.sqrt(total / 2.0)


class Registrar:
    """Lays patches over one template. `blurred` is shared between several starts on one patch."""

    def __init__(self, template: Template, patch: Patch) -> None:
        self._template = template
        self._patch = patch
        self._soft = _blurred(patch)
        self._cut = patch.clipped.any

    def fit(self, start: Pose) -> Registration:
        """Refine a start; converges from within about ten degrees and a few pixels."""
        t = self._template
        turn, dx, dy = math.radians(start.turn_deg), start.dx_px, start.dy_px
        nuisance = np.zeros(3)
        if t.value.size < 30:
            return Registration(start, 180.0, 1.0, _CLIPPED)
        last_step = 0.0
        for _ in range(MAX_ROUNDS):
            difference, weight = self._difference(turn, dx, dy)
            difference -= t.motion[:, 3:] @ nuisance.astype(np.float32)
            weighted = t.motion * weight[:, None]
            normal = (weighted.T @ t.motion).astype(np.float64)
            noise2 = max(float(weight @ difference**2) / max(float(weight.sum()), 1.0), 1e-4)
            gradient = (weighted.T @ difference).astype(np.float64)
            prior = noise2 / _PRIOR_STD**2
            gradient[3:] -= prior[3:] * nuisance
            step = np.linalg.solve(normal + np.diag(prior), gradient)
            nuisance += step[3:]
            turn_step, move_x, move_y = float(step[0]), float(step[1]), float(step[2])
            small = abs(turn_step) < 4e-4 and abs(move_x) + abs(move_y) < 0.02
            # A rough outline makes every step too short by the same share: go on to where the steps lead.
            ratio = turn_step / last_step if last_step else 0.0
            last_step = turn_step
            if 0.1 < ratio < 0.75:
                turn_step /= 1.0 - ratio
                last_step = 0.0
            turn_step = min(max(turn_step, -0.3), 0.3)
            # Inverse composition: undo the step before the present pose.
            turn -= turn_step
            c, s = math.cos(turn), math.sin(turn)
            dx -= c * move_x + s * move_y
            dy -= -s * move_x + c * move_y
            if small:
                break
        pose = Pose(math.degrees(turn), dx, dy)
        return self._judged(pose, normal, noise2, weight)

    def _difference(self, turn: float, dx: float, dy: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Picture minus template along the outline, and a robust weight, 0 outside the frame."""
        t, patch = self._template, self._patch
        c, s = np.float32(math.cos(turn)), np.float32(math.sin(turn))
        x = t.x_px * c + t.y_px * s + np.float32(t.centre_px[0] + dx - patch.left_px)
        y = t.y_px * c - t.x_px * s + np.float32(t.centre_px[1] + dy - patch.top_px)
        seen = cv2.remap(self._soft, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
        difference = np.asarray(seen, np.float32).ravel() - t.value
        width, height = patch.picture_size
        weight = 1.0 / (1.0 + (difference * np.float32(1.0 / 0.25)) ** 2)
        left, top = np.float32(RIM_PX - patch.left_px), np.float32(RIM_PX - patch.top_px)
        right = np.float32(width - 1 - RIM_PX - patch.left_px)
        bottom = np.float32(height - 1 - RIM_PX - patch.top_px)
        if x.min() < left or y.min() < top or x.max() > right or y.max() > bottom:
            weight *= (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        return difference, weight

    def _judged(
        self, pose: Pose, normal: NDArray[np.float64], noise2: float, weight: NDArray[np.float32]
    ) -> Registration:
        t = self._template
        residual = math.sqrt(noise2)
        covariance = np.linalg.inv(normal + np.diag(1e-4 / _PRIOR_STD**2))
        information = 1.0 / max(float(covariance[0, 0]), 1e-12)
        # What a turn moves the outline by, beyond what shift, growth and stretch explain.
        lever_px = math.sqrt(information / max(float(weight @ t.slope**2), 1e-9))
        correlated = 4.0 * math.pi * BLUR_PX**2
        sigma = math.degrees(
            math.hypot(OUTLINE_PX / max(lever_px, 1e-3), residual * math.sqrt(correlated / information))
        )
        declined = None
        if float(weight.sum()) < OVERLAP_MIN * t.value.size:
            declined = _CLIPPED if self._cut else _NOT_SAME
        elif residual > RESIDUAL_MAX:
            declined = _NOT_SAME
        elif lever_px < LEVER_MIN_PX or t.contrast < max(CONTRAST_MIN, CONTRAST_RATIO_MIN * residual):
            declined = _ROUND
        return Registration(pose, min(sigma, 180.0), residual, declined)
