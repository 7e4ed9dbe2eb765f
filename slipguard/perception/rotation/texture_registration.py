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
from slipguard.perception.rotation.contour_template import sampled
from slipguard.perception.rotation.round_contact import FAINT_LEVELS
from slipguard.perception.rotation.texture_map import Field, ImageWindow, TextureMap
from slipguard.perception.rotation.texture_template import EDGE_PX, TextureTemplate

ITERATIONS_MAX = 8
ROBUST = 2.5
"""Differences beyond this many times their r.m.s. are weighted less."""
ALIKE_MIN = 0.7
"""Smallest correlation of the reference's texture with the current one."""
VISIBLE_MIN = 0.45
"""Smallest share of the reference's texture within the image."""
_PRIOR_STD = np.array([10.0, 6.0, 6.0, 0.1, 0.5])
"""Weak priors: rotation (rad), shift from the start (texture pixels), scale and gain (shares)."""
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

GHOST_SIGMA_MIN = 0.01
GHOST_VISIBLE_MIN = 1e-4
"""Part of the unmoved reference's square that no motion explains, below which a ghost looks like motion."""
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

    share: its amplitude relative to the reference's, with one standard deviation. pull_deg: by how much a ghost of
    share 1 changes the rotation that a fit without a ghost finds, to first order.
    """

    share: float
    sigma: float
    pull_deg: float


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
    """Register a texture map to the template, from a start within some degrees and pixels."""
    if template.round_reason is not None:
        return TextureFit(start, 180.0, 180.0, 180.0, 0.0, 0.0, 1.0, 0.0, template.round_reason)
    rotation, dx, dy, scale, gain = math.radians(start.rotation_deg), start.dx_px, start.dy_px, start.scale, start.gain
    motion = template.motion
    for _ in range(ITERATIONS_MAX):
        value, weight = _sampled_at(template, texture_map, rotation, dx, dy, scale)
        difference = value - np.float32(gain) * template.value
        square = difference * difference
        noise2 = max(float(weight @ square) / max(float(weight.sum()), 1.0), 1e-6)
        weight /= 1.0 + square * np.float32(1.0 / (ROBUST**2 * noise2))
        weighted = motion.T * weight
        gains = np.array([gain, gain, gain, gain, 1.0])
        normal = (weighted @ motion) * (gains[:, None] * gains)
        gradient = (weighted @ difference) * gains
        prior = _CORRELATED * noise2 / _PRIOR_STD**2
        c, s = math.cos(rotation), math.sin(rotation)
        away_x, away_y = dx - start.dx_px, dy - start.dy_px
        gradient[1] += prior[1] * (c * away_x - s * away_y)
        gradient[2] += prior[2] * (s * away_x + c * away_y)
        gradient[3] -= prior[3] * (scale - 1.0)
        gradient[4] -= prior[4] * (gain - 1.0)
        regularized = normal.copy()
        regularized.flat[::6] += prior + 1e-7 * normal.trace()
        step = np.linalg.solve(regularized, gradient)
        rotation_step = min(max(float(step[0]), -0.2), 0.2)
        move_x, move_y = float(step[1]), float(step[2])
        scale = min(max(scale + float(step[3]), 0.5), 2.0)
        gain = min(max(gain + float(step[4]), 0.2), 5.0)
        # Inverse composition: apply the inverse of the step before the current pose.
        rotation -= rotation_step
        c, s = math.cos(rotation), math.sin(rotation)
        dx -= c * move_x + s * move_y
        dy -= -s * move_x + c * move_y
        if abs(rotation_step) < 8e-4 and abs(move_x) + abs(move_y) < 0.04:
            break
    pose = TexturePose(math.degrees(rotation), dx, dy, scale, gain)
    left, top = (round(at - inside) for at, inside in zip(template.center_px, template.origin_px, strict=True))
    reference_map = TextureMap(ImageWindow(left, top, 0, 0), template.image)
    unmoved, visible = _sampled_at(template, reference_map, rotation, dx, dy, scale)
    ghost, bias = find_ghost(motion, weight * visible, difference, unmoved)
    moving = difference  # what a ghost leaves is no deformation
    if ghost.share > GHOST_SIGMAS * ghost.sigma:
        moving = difference - np.float32(ghost.share) * unmoved
    uneven = uneven_share(template, weight * visible, moving)
    twist_deg, lean = local_changes(template, visible * weight, moving)
    fit = _result(template, texture_map.noise, pose, regularized, difference, value, weight, bias, ghost, uneven)
    return replace(fit, twist_deg=twist_deg, lean=lean)


def _result(
    template: TextureTemplate,
    noise: float,
    pose: TexturePose,
    normal: NDArray[np.float64],
    difference: Field,
    value: Field,
    weight: Field,
    bias: float,
    ghost: Ghost,
    uneven: float,
) -> TextureFit:
    mass = max(float(weight.sum()), 1e-6)
    covariance = np.linalg.inv(normal)[0]
    gains = np.array([pose.gain, pose.gain, pose.gain, pose.gain, 1.0])
    pull = (template.motion @ (covariance * gains).astype(np.float32)) * weight * difference
    parts = np.bincount(template.block, pull)
    spread_deg = math.degrees(math.sqrt(float(parts @ parts)))
    levels = math.sqrt(1.0 / max(float(covariance[0]), 1e-12) / mass)  # change of the texture by a radian
    own2 = max(float(weight @ template.value**2) / mass, 1e-9)
    now2 = max(float(weight @ value**2) / mass, 1e-9)
    both2 = float((weight * value) @ template.value) / mass
    alike = both2 / math.sqrt(own2 * now2)
    clean2, clean_now2 = max(own2 - template.noise**2, 1e-2 * own2), max(now2 - noise**2, 1e-2 * now2)
    noise2 = noise**2 + (pose.gain * template.noise) ** 2
    left2 = float(weight @ difference**2) / mass - NOISE_LEFT * noise2
    visible = float(np.count_nonzero(weight)) / weight.size
    return TextureFit(
        pose,
        spread_deg=min(max(spread_deg, 1e-3), 180.0),
        noise_deg=min(math.degrees(math.sqrt(noise2) / levels), 180.0),
        misfit_deg=min(math.degrees(math.sqrt(max(left2, 0.0)) / levels), 180.0),
        change=levels / (abs(pose.gain) * math.sqrt(own2)),
        alike=alike,
        deformed=1.0 - min(max(both2 / math.sqrt(clean2 * clean_now2), 0.0), 1.0),
        strength=math.sqrt(clean2),
        declined=_declined(visible, alike, uneven),
        static_bias_deg=bias * abs(pose.rotation_deg) * (1.0 - min(max(alike, 0.0), 1.0)),
        ghost=replace(ghost, pull_deg=ghost.pull_deg / pose.gain),
        uneven=uneven,
    )


def _declined(visible: float, alike: float, uneven: float) -> str | None:
    if visible < VISIBLE_MIN:
        return explain(DeclineReason.CLIPPED, f"{visible:.0%} of the texture is visible, limit {VISIBLE_MIN:.0%}")
    if uneven > UNEVEN_MAX:
        return explain(DeclineReason.DEFORMED, f"{uneven:.0%} of the misfit, limit {UNEVEN_MAX:.0%}")
    if alike >= ALIKE_MIN:
        return None
    return explain(DeclineReason.CONTACT_CHANGED, f"texture correlates by {alike:.2f}, limit {ALIKE_MIN:.2f}")


def _sampled_at(
    template: TextureTemplate, texture_map: TextureMap, rotation: float, dx: float, dy: float, scale: float
) -> tuple[Field, Field]:
    """Return the map's values where the template's points have moved to, and 1 for points within the image, else 0."""
    window = texture_map.window
    c, s = np.float32(scale * math.cos(rotation)), np.float32(scale * math.sin(rotation))
    x = template.x_px * c + template.y_px * s + np.float32(template.center_px[0] + dx - window.left_px)
    y = template.y_px * c - template.x_px * s + np.float32(template.center_px[1] + dy - window.top_px)
    rows, columns = texture_map.curvature.shape
    value = sampled(texture_map.curvature, x, y, cv2.BORDER_REPLICATE)
    inside = (x >= EDGE_PX) & (x <= columns - 1 - EDGE_PX) & (y >= EDGE_PX) & (y <= rows - 1 - EDGE_PX)
    return value, inside.astype(np.float32)


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


def uneven_share(template: TextureTemplate, weight: Field, difference: Field) -> float:
    """Return the share of the fit's squared residual that uneven deformation explains, beyond what chance does."""
    rows = np.concatenate([template.motion.T, template.deform.T])
    weighted = rows * weight
    normal = (weighted @ rows.T).astype(np.float64)
    scale = np.sqrt(normal.diagonal()) + 1e-9
    normal /= scale[:, None] * scale
    normal.flat[:: len(normal) + 1] += 1e-6
    gradient = (weighted @ difference).astype(np.float64) / scale
    explained = float(gradient @ np.linalg.solve(normal, gradient))
    rigid = gradient[:5]
    by_motion = float(rigid @ np.linalg.solve(normal[:5, :5], rigid))
    left = max(float(weight @ difference**2) - by_motion, 1e-9)
    return max((explained - by_motion) / left - UNEVEN_CHANCE / len(weight), 0.0)


def local_changes(template: TextureTemplate, weight: Field, difference: Field) -> tuple[float, float]:
    """Return what a middle that rotates by itself adds to sigma (degrees), and how much one side has become stronger.

    Every visible point has the same weight: a robust fit would leave out a middle that moves differently.
    """
    left = difference * (weight > 0.0)
    noise = CHANCE * math.sqrt(_CORRELATED * float(left @ left) / max(int(np.count_nonzero(weight)), 1))
    found = (left @ template.local).astype(np.float64)
    sigma = noise * np.sqrt(np.einsum("ij,ij->j", template.local, template.local))
    near_axis, near_center, right, down = np.sqrt(np.maximum(found**2 - sigma**2, 0.0)).tolist()
    angles_deg = (min(math.degrees(near), TWIST_MAX_DEG) for near in (near_axis, near_center))
    twist_deg = math.hypot(*(share * angle for share, angle in zip(TWIST_SHARES, angles_deg, strict=True)))
    return twist_deg, math.hypot(right, down)


def find_ghost(motion: Field, weight: Field, difference: Field, unmoved: Field) -> tuple[Ghost, float]:
    """Return how much of the reference stays in place (a gel's memory), and the bias by any pattern that does (dirt).

    If a share a of an image stays and 1 - a rotates, a fit of small rotations finds 1 - a of the rotation. It leaves
    a / (1 - a) of the unmoved reference, except for what rotation, shift, scale and gain explain. That factor is found
    by least squares. The bias is a share of the found rotation, 0 to `STATIC_BIAS_MAX`.

    Args:
        motion: (N, 5), change of the reference by each motion.
        weight: (N,), of the fit.
        difference: (N,), residual of the fit.
        unmoved: (N,), the reference's own image where its points have moved to.
    """
    weighted = motion.T * weight
    normal = (weighted @ motion).astype(np.float64)
    normal += 1e-9 * (float(np.trace(normal)) + 1e-9) * np.eye(len(normal))
    explained = np.linalg.solve(normal, (weighted @ unmoved).astype(np.float64)).astype(np.float32)
    static = unmoved - motion @ explained
    weighted_static = weight * static
    square = float(weighted_static @ static) + 1e-9
    found = float(weighted_static @ difference)
    whole = float(weight @ unmoved**2)
    bias = min(max(found / (square + STATIC_PRIOR * whole), 0.0), STATIC_BIAS_MAX)
    pull_deg = math.degrees(float(explained[0]))
    if square < GHOST_VISIBLE_MIN * whole:
        return Ghost(0.0, math.inf, pull_deg), bias
    left2 = max(float(weight @ difference**2) - found**2 / square, 0.0) / max(float(weight.sum()), 1e-9)
    sigma = max(math.sqrt(_CORRELATED * left2 / square), GHOST_SIGMA_MIN)
    return Ghost(found / square, sigma, pull_deg), bias


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
