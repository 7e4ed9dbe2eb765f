"""Registration of a frame's texture to the reference's: rotation by edges, ribs and texture inside the contact.

Inverse compositional alignment (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56 (2004) 221-255) of the
gel's curvature inside and close around the reference's contact. A scale and a gain are fitted with rotation and shift.
The texture of an edge stays in place when the force rises and the contour grows.

Sigma is built from the known causes of error: noise, which shows in the disagreement of the contact's parts and is
known for the camera; and deformation, which is what the fit leaves beyond that noise. A faint image of a contact that
has only rotated gets a small sigma, a strong one of a contact that was sheared or pressed harder a large one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.rotation.round_contact import FAINT_LEVELS
from slipguard.perception.rotation.texture_map import Field, ImageWindow, TextureMap
from slipguard.perception.rotation.texture_template import EDGE_PX, MOTIONS, TextureTemplate

ITERATIONS_MAX = 8
ROBUST = 2.5
"""Differences beyond this many times their r.m.s. are weighted less."""
ALIKE_MIN = 0.7
"""Smallest correlation of the reference's texture with the current one."""
VISIBLE_MIN = 0.45
"""Smallest share of the reference's texture within the image."""
_PRIOR_STD = np.array([10.0, 6.0, 6.0, 0.1, 0.5])
"""Weak priors: rotation (rad), shift from the start (texture pixels), scale and gain (shares)."""
_ROUND_PRIOR_STD = np.array([1e-6, 6.0, 6.0, 0.1, 0.5])
"""The same for a round texture, whose rotation is held."""
NOISE_LEFT = 0.85
"""Share of the squared noise of two images that a robust fit leaves."""
DEFORMED = 0.1
"""A correlation this far below 1 doubles sigmas: real contacts under shear deform. Chosen on real shear without
rotation."""
_CORRELATED = 30.0
"""Number of the template's points with the same error."""
STATIC_BIAS_MAX = 3.0
"""Largest bias by a static pattern, as a share of the found rotation."""
STATIC_PRIOR = 1e-3
"""If a rotation changes the reference by less than this share of its square, a static pattern cannot be detected."""
SEARCH_STEP_DEG, SEARCH_POINTS = 4.0, 500
"""A search of all rotations takes these steps, with this many points of the texture."""
SEARCH_STARTS, APART_DEG = 4, 12.0
"""It returns this many of the best, if they are this far apart."""

_DIFFERENCE, _MOTION, _GAIN, _TEMPLATE, _UNMOVED = 0, slice(1, 6), 5, slice(1, 11), 11
"""Rows of the fields of a fit: the residual; the fields of the template, the motions first, the last of which (gain) is
its value; and its own unmoved image. All weighted sums follow from one table of their products."""

GHOST_SIGMA_MIN = 0.01
GHOST_VISIBLE_MIN = 1e-4
"""Part of the unmoved reference's square that no motion explains, below which a ghost looks like motion."""
GHOST_SHOWN_MIN = 0.01
"""The same, above which it is surely none: below, interpolation adds to it. A share of 0.65 reads 1.2 at 0.002, 0.8 at
0.01, and 0.66 from 0.1 on."""
GHOST_SIGMAS = 3.0
"""A ghost above this many of its sigmas is not taken for deformation."""
UNEVEN_CHANCE = 24.0
"""Uneven deformation explains this over the number of points even in rigid contacts."""
UNEVEN_MAX = 0.3
UNEVEN_DEG = 20.0
"""Sigma of the rotation if uneven deformation explained all that the fit leaves. Rigid contacts of the training objects
reach a share of 0.01, partial slip 0.1-0.7."""
UNEVEN_FULL_DEG, UNEVEN_LEAST = 1.0, 0.2
"""Deformation counts in full from this rotation on, and by this share without any: force alone deforms contacts too."""
TWIST_SHARES = (0.6, 0.3)
TWIST_MAX_DEG = 10.0
"""Sigma of the rotation per degree by which the texture near the grasp axis, and near the contact's center, has rotated
more or less than the rest, and the largest such angle. Below `CHANCE` standard deviations the angle is noise."""
CHANCE = 0.2
FLOOR_DEG = 0.03
SIGMA_SHARES = (1.25, 0.032, 0.72, 0.25)
"""Shares in sigma of the disagreement of the contact's parts; and of the rotations that would change the texture as
much as the camera's noise does, as its growth since the reference, and as the deformation that the fit leaves. Chosen
by `tests.campaigns.fit_sigma` on rendered rotations of the training objects and on real presses."""
STATIC, STATIC_FREE_DEG = 5.0, 0.05
"""Share in sigma of the bias by a static pattern, beyond the amount found without one: nine of ten real presses stay
below. Coarse compression and few gray levels give 0.1-0.4 degrees."""


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


NO_GHOST = Ghost(0.0, math.inf, 0.0)


@dataclass(frozen=True, slots=True)
class TextureFit:
    """The best pose. spread_deg: one standard deviation of the rotation by the disagreement of the contact's parts.

    noise_deg: the rotation that would change the texture as much as the camera's noise does. misfit_deg: as much as the
    fit leaves beyond the noise of both images. change: of the texture by a rotation of a radian over the texture
    itself. alike: correlation with the reference. deformed: how far below 1 that is for other reasons than noise.
    strength: of the reference's texture without noise, gray levels per pixel, r.m.s. declined: None, or why there is no
    rotation. static_bias_deg: by how much a static pattern may have held the rotation back. ghost: how much of the
    reference's own texture stayed in place. uneven: share of what the fit leaves that a deformation of the contact
    explains. twist_deg: sigma by a middle that has rotated differently, not part of the other sigmas. lean: by how much
    the texture has become stronger on one side, as a share per r.m.s. distance: the object is tilted.
    """

    pose: TexturePose
    spread_deg: float
    noise_deg: float
    misfit_deg: float
    change: float
    alike: float
    deformed: float
    strength: float
    declined: str | None = None
    static_bias_deg: float = 0.0
    ghost: Ghost = NO_GHOST
    uneven: float = 0.0
    twist_deg: float = 0.0
    lean: float = 0.0

    @property
    def uneven_deg(self) -> float:
        """One standard deviation of the rotation by uneven deformation, which may be that of the contact's rim only."""
        doubted = min(max(abs(self.pose.rotation_deg) / UNEVEN_FULL_DEG, UNEVEN_LEAST), 1.0)
        return UNEVEN_DEG * doubted * self.uneven

    @property
    def deformation(self) -> float:
        """Factor on sigmas by the deformation of the contact; 1 for none."""
        return 1.0 + self.deformed / DEFORMED


def fit_texture(template: TextureTemplate, texture_map: TextureMap, start: TexturePose) -> TextureFit:
    """Register a texture map to the template, from a start within some degrees and pixels.

    A round texture shows a shift and no rotation: it stays at the start, and is declined.
    """
    fields = np.empty((_UNMOVED + 1, template.value.size), np.float32)
    fields[_TEMPLATE] = template.fields
    difference, pose = fields[_DIFFERENCE], start
    prior = _CORRELATED / (_PRIOR_STD if template.round_reason is None else _ROUND_PRIOR_STD) ** 2
    for _ in range(ITERATIONS_MAX):
        visible = _sample(template, texture_map, pose, difference)
        difference -= np.float32(pose.gain) * template.value
        square = difference * difference
        noise2 = max(float(visible @ square) / max(float(visible.sum()), 1.0), 1e-6)
        weight = visible / (1.0 + square * np.float32(1.0 / (ROBUST**2 * noise2)))
        products, fitted = _products(fields[: _GAIN + 1], weight), pose
        normal, pose, converged = _improved(products, fitted, start, prior * noise2)
        if converged:
            break
    left, top = (round(at - inside) for at, inside in zip(template.center_px, template.origin_px, strict=True))
    own_map = TextureMap(ImageWindow(left, top, 0, 0), template.image)
    in_both = weight * _sample(template, own_map, pose, fields[_UNMOVED])
    by_both = _products(fields, in_both)
    ghost, bias = find_ghost(by_both, float(in_both.sum()))
    left_over = np.zeros(len(fields), np.float32)
    left_over[_DIFFERENCE] = 1.0
    if ghost.share > GHOST_SIGMAS * ghost.sigma:  # what a ghost leaves is no deformation
        left_over[_UNMOVED] = -ghost.share
    uneven = uneven_share(by_both, left_over, template.value.size)
    twist_deg, lean = local_changes(template, in_both, left_over @ fields)

    mass = max(float(weight.sum()), 1e-6)
    covariance = np.linalg.inv(normal)[0]
    pull = ((covariance * _gains(pose)).astype(np.float32) @ template.motion) * weight * difference
    parts = np.bincount(template.block, pull)
    spread_deg = math.degrees(math.sqrt(float(parts @ parts)))
    levels = math.sqrt(1.0 / max(float(covariance[0]), 1e-12) / mass)  # change of the texture by a radian
    left2 = float(products[_DIFFERENCE, _DIFFERENCE]) / mass
    both2 = float(products[_DIFFERENCE, _GAIN] + fitted.gain * products[_GAIN, _GAIN]) / mass
    own2 = max(float(products[_GAIN, _GAIN]) / mass, 1e-9)
    now2 = max(left2 + fitted.gain * (2.0 * both2 - fitted.gain * own2), 1e-9)
    alike = both2 / math.sqrt(own2 * now2)
    noise2, own_noise2 = texture_map.noise**2, template.noise**2
    clean2, clean_now2 = max(own2 - own_noise2, 1e-2 * own2), max(now2 - noise2, 1e-2 * now2)
    noise2 += pose.gain**2 * own_noise2
    beyond_noise2 = max(left2 - NOISE_LEFT * noise2, 0.0)
    return TextureFit(
        pose,
        spread_deg=min(max(spread_deg, 1e-3), 180.0),
        noise_deg=min(math.degrees(math.sqrt(noise2) / levels), 180.0),
        misfit_deg=min(math.degrees(math.sqrt(beyond_noise2) / levels), 180.0),
        change=levels / (abs(pose.gain) * math.sqrt(own2)),
        alike=alike,
        deformed=1.0 - min(max(both2 / math.sqrt(clean2 * clean_now2), 0.0), 1.0),
        strength=math.sqrt(clean2),
        declined=template.round_reason or _declined(float(visible.sum()) / visible.size, alike, uneven),
        static_bias_deg=bias * abs(pose.rotation_deg) * (1.0 - min(max(alike, 0.0), 1.0)),
        ghost=replace(ghost, share=ghost.share / pose.gain, sigma=ghost.sigma / pose.gain),
        uneven=uneven,
        twist_deg=twist_deg,
        lean=lean,
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


def _declined(visible: float, alike: float, uneven: float) -> str | None:
    if visible < VISIBLE_MIN:
        return explain(DeclineReason.CLIPPED, f"{visible:.0%} of the texture is visible, limit {VISIBLE_MIN:.0%}")
    if uneven > UNEVEN_MAX:
        return explain(DeclineReason.DEFORMED, f"{uneven:.0%} of the misfit, limit {UNEVEN_MAX:.0%}")
    if alike >= ALIKE_MIN:
        return None
    return explain(DeclineReason.CONTACT_CHANGED, f"texture correlates by {alike:.2f}, limit {ALIKE_MIN:.2f}")


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


def likely_rotations_deg(
    template: TextureTemplate, texture_map: TextureMap, shift_px: tuple[float, float]
) -> list[float]:
    """Return the rotations at which the texture correlates best, the best first, at least `APART_DEG` apart."""
    step = max(template.value.size // SEARCH_POINTS, 1)
    x, y, own = template.x_px[::step], template.y_px[::step], template.value[::step]
    window = texture_map.window
    center_x = np.float32(template.center_px[0] + shift_px[0] - window.left_px)
    center_y = np.float32(template.center_px[1] + shift_px[1] - window.top_px)
    rotations_deg = np.arange(-180.0, 180.0, SEARCH_STEP_DEG)
    c = np.cos(np.radians(rotations_deg)).astype(np.float32)[:, None]
    s = np.sin(np.radians(rotations_deg)).astype(np.float32)[:, None]
    value = cv2.remap(
        texture_map.curvature, c * x + s * y + center_x, c * y - s * x + center_y, cv2.INTER_LINEAR, borderValue=0.0
    )
    alike = (value @ own) / np.sqrt(np.einsum("ij,ij->i", value, value) + 1e-9)
    found: list[float] = []
    for k in np.argsort(-alike):
        candidate_deg = float(rotations_deg[k])
        if all(abs(math.remainder(candidate_deg - one, 360.0)) >= APART_DEG for one in found):
            found.append(candidate_deg)
        if len(found) == SEARCH_STARTS:
            break
    return found


def uneven_share(products: NDArray[np.float64], left: Field, points: int) -> float:
    """Return the share of the fit's squared residual that uneven deformation explains, beyond what chance does.

    Args:
        products: Weighted products of the fields of a fit.
        left: The residual, as shares of these fields.
        points: Number of points.
    """
    normal, gradient = products[_TEMPLATE, _TEMPLATE], products[_TEMPLATE] @ left
    scale = np.sqrt(normal.diagonal()) + 1e-9
    normal = normal / (scale[:, None] * scale)
    normal.flat[:: len(normal) + 1] += 1e-6
    gradient /= scale
    explained = float(gradient @ np.linalg.solve(normal, gradient))
    rigid = gradient[:MOTIONS]
    by_motion = float(rigid @ np.linalg.solve(normal[:MOTIONS, :MOTIONS], rigid))
    remaining = max(float(left @ products @ left) - by_motion, 1e-9)
    return max((explained - by_motion) / remaining - UNEVEN_CHANCE / points, 0.0)


def local_changes(template: TextureTemplate, weight: Field, difference: Field) -> tuple[float, float]:
    """Return what a middle that rotates by itself adds to sigma (degrees), and how much one side has become stronger.

    Every visible point has the same weight: a robust fit would leave out a middle that moves differently.
    """
    visible = weight > 0.0
    left = difference * visible
    noise = CHANCE * math.sqrt(_CORRELATED * float(left @ left) / max(int(np.count_nonzero(visible)), 1))
    found = (template.local @ left).astype(np.float64)
    sigma = noise * template.local_size
    near_axis, near_center, right, down = np.sqrt(np.maximum(found**2 - sigma**2, 0.0)).tolist()
    angles_deg = (min(math.degrees(near), TWIST_MAX_DEG) for near in (near_axis, near_center))
    twist_deg = math.hypot(*(share * angle for share, angle in zip(TWIST_SHARES, angles_deg, strict=True)))
    return twist_deg, math.hypot(right, down)


def find_ghost(products: NDArray[np.float64], mass: float) -> tuple[Ghost, float]:
    """Return how much of the reference stays in place (a gel's memory), and the bias by any pattern that does (dirt).

    If a share a of an image stays and 1 - a rotates, a fit of small rotations finds 1 - a of the rotation. It leaves
    a / (1 - a) of the unmoved reference, except for what rotation, shift, scale and gain explain. That factor is found
    by least squares. The bias is a share of the found rotation, 0 to `STATIC_BIAS_MAX`.

    Args:
        products: Weighted products of the fields of a fit.
        mass: Sum of the weights.
    """
    normal, unmoved = products[_MOTION, _MOTION], products[_MOTION, _UNMOVED]
    explained = np.linalg.solve(normal + 1e-9 * (normal.trace() + 1e-9) * np.eye(MOTIONS), unmoved)
    whole = float(products[_UNMOVED, _UNMOVED])
    square = max(whole + float(explained @ (normal @ explained - 2.0 * unmoved)), 0.0) + 1e-9
    found = float(products[_DIFFERENCE, _UNMOVED] - explained @ products[_MOTION, _DIFFERENCE])
    bias = min(max(found / (square + STATIC_PRIOR * whole), 0.0), STATIC_BIAS_MAX)
    pull_deg = math.degrees(float(explained[0]))
    if square < GHOST_VISIBLE_MIN * whole:
        return Ghost(0.0, math.inf, pull_deg), bias
    left2 = max(float(products[_DIFFERENCE, _DIFFERENCE]) - found**2 / square, 0.0) / max(mass, 1e-9)
    sigma = max(math.sqrt(_CORRELATED * left2 / square), GHOST_SIGMA_MIN)
    return Ghost(found / square, sigma, pull_deg, square > GHOST_SHOWN_MIN * whole), bias


def sigma_deg(fit: TextureFit) -> float:
    """Return one standard deviation of the rotation, degrees."""
    parts = (share * part for share, part in zip(SIGMA_SHARES, parts_deg(fit), strict=True))
    return math.hypot(FLOOR_DEG, fit.uneven_deg, STATIC * max(fit.static_bias_deg - STATIC_FREE_DEG, 0.0), *parts)


def parts_deg(fit: TextureFit) -> tuple[float, float, float, float]:
    """Return the parts of sigma as rotations (degrees): spread, noise, growth and misfit.

    A misfit counts more the more the texture has deformed, and the less a rotation changes it. Growth and misfit count
    twice if the texture is no stronger than `FAINT_LEVELS`: the effect of the light on a place does not rotate.
    """
    faint = 1.0 + (FAINT_LEVELS / max(fit.strength, 1e-3)) ** 2
    change = max(fit.change, 1e-3)
    grown_deg = math.degrees(abs(math.log(fit.pose.scale)) / change)
    return fit.spread_deg, fit.noise_deg, faint * grown_deg, faint * fit.deformation * fit.misfit_deg / change
