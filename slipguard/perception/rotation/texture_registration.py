"""The turn of a contact since the reference by the relief in it: its edges, ribs and texture, not its outline.

Inverse compositional alignment (S. Baker, I. Matthews, "Lucas-Kanade 20 years on", IJCV 56 (2004) 221-255) of the
curvature of the gel inside and close around the reference's contact. Beside turn and shift a scale and a gain
are fitted. The relief of an edge stays where it is when the force rises and the outline grows; a contact that shows
the same relief from all sides (a ball, a ring) declines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.rotation.contour_template import sampled
from slipguard.perception.rotation.static_pattern import static_pattern_bias
from slipguard.perception.rotation.texture_map import HEIGHT_PX, WIDTH_PX, ImageWindow, TextureMap, placed

SKIRT_PX = 5
"""The slopes around the contact count as far out as this, relief pixels."""
EDGE_PX = 4
"""Relief this close to the edge of the picture does not count: filters see only half of what is there."""
POINTS_MAX = 1500
POINTS_MIN = 60
MAX_ROUNDS = 8
ROBUST = 2.5
"""Differences beyond this many times their r.m.s. count less and less."""
BLOCK_PX = 16.0
"""Residuals further apart than this are taken for independent."""
COARSE_PX = 2.3
"""Blur (relief pixels, on top of the relief's own) before a contact is judged round: light that falls unevenly on a
ball makes fine differences that do not turn with it."""
ROUND_LEVER = 1.3
ROUND_FAINT = 0.25
FAINT_LEVELS = 1.2
"""Change of the blurred relief by a turn of one radian (what shift, scale and gain cannot explain) over the relief
itself, r.m.s.: 0.3-1.0 for plain balls and rings, rendered and real, 1.4 and more for what has a face. A faint relief
must show more, for noise has an axis too: this share more at `FAINT_LEVELS` (grey levels a pixel, r.m.s.). Real faint
balls reach 1.3."""
ALIKE_MIN = 0.7
"""Correlation of the reference's relief with what now lies there."""
SIGHT_MIN = 0.45
"""Share of the reference's relief that must be in the picture."""
SMOOTH = 0.8
"""Change of the relief per pixel along a shaft over the camera's noise, r.m.s., below which it is that noise: 0.53-0.7
for featureless shafts, from 1 for what has an end or a face."""
_PRIOR_STD = np.array([10.0, 6.0, 6.0, 0.1, 0.5])
"""Turn (rad), shift from the start (relief pixels), scale and gain (shares): weak, for what it does not tell."""
NOISE_LEFT = 0.85
"""What a robust fit leaves of the noise of two pictures, as a share of its square."""
UNLIKE = 0.1
"""A correlation this far below 1 makes sigmas twice as large: real contacts that are sheared deform. Chosen on real
shear without turning."""
_CORRELATED = 30.0
"""How many of the template's points carry the same error."""
OTHER = "contact changed too much since the reference"
ROUND = "round contact"
CLIPPED = "clipped by the frame"

Field = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class TexturePose:
    """Where the reference's relief has moved to: degrees counter-clockwise, relief pixels right and down, shares."""

    rotation_deg: float = 0.0
    dx_px: float = 0.0
    dy_px: float = 0.0
    scale: float = 1.0
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class TextureFit:
    """The best pose. spread_deg: one standard deviation of the turn as parts of the contact disagree about it.

    noise_deg: the turn that would change the relief as much as the camera's noise does. misfit_deg: as much as what
    the fit leaves beyond the noise of both pictures.
    lever: change of the relief by a turn of a radian over the relief itself. alike: correlation with the reference.
    deformed: how far below 1 that is for other reasons than noise. strength: of the reference's relief without noise,
    grey levels a pixel, r.m.s. declined: None, or why there is no turn. held_deg: how far what has not turned along
    may have held the turn back.
    """

    pose: TexturePose
    spread_deg: float
    noise_deg: float
    misfit_deg: float
    lever: float
    alike: float
    deformed: float
    strength: float
    declined: str | None = None
    held_deg: float = 0.0

    @property
    def unlike(self) -> float:
        """By how much a contact that has deformed makes sigmas larger; 1 where it is as it was."""
        return 1.0 + self.deformed / UNLIKE


@dataclass(frozen=True, slots=True, eq=False)
class TextureTemplate:
    """The reference's relief: points around its centre, their values and how each motion changes them.

    x_px, y_px, value: (N,) float32. motion: (N, 5) float32, change per turn, shift x, shift y, scale, gain.
    block: (N,) which neighbourhood each point belongs to. smooth: the direction (right, down; of length 1) along which
    nothing but noise changes, so that it tells no shift; None where there is none. coarse_lever: what `ROUND_LEVER`
    judges. strength: r.m.s. of the values. noise: what of it the camera's noise makes. picture, origin_px: what the
    points were taken from, and the centre in it.
    """

    x_px: Field
    y_px: Field
    value: Field
    motion: Field
    block: NDArray[np.intp]
    smooth: tuple[float, float] | None
    center_px: tuple[float, float]
    coarse_lever: float
    strength: float
    noise: float
    picture: Field
    origin_px: tuple[float, float]

    @property
    def round(self) -> bool:
        """Whether the relief looks the same from all sides."""
        return self.coarse_lever < ROUND_LEVER * (1.0 + ROUND_FAINT * (FAINT_LEVELS / max(self.strength, 1e-3)) ** 2)


def make_texture_template(relief: TextureMap, patch: Patch) -> TextureTemplate | None:
    """Remember the relief in and around a patch; None where too little of it lies within the picture."""
    window = relief.window
    mask = placed(patch, window)
    m = cv2.moments(mask, True)
    if m["m00"] < 1.0:
        return None
    centre_x, centre_y = m["m10"] / m["m00"], m["m01"] / m["m00"]
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SKIRT_PX + 1, 2 * SKIRT_PX + 1))
    wide = cv2.dilate(mask, disc)
    rows, columns = wide.shape
    wide[: max(EDGE_PX - window.top_px, 0)] = 0
    wide[:, : max(EDGE_PX - window.left_px, 0)] = 0
    wide[rows - max(EDGE_PX - (HEIGHT_PX - window.bottom_px), 0) :] = 0
    wide[:, columns - max(EDGE_PX - (WIDTH_PX - window.right_px), 0) :] = 0
    step = 2 if np.count_nonzero(wide) <= 4 * POINTS_MAX else 3
    y, x = np.nonzero(wide[::step, ::step])
    if x.size < POINTS_MIN:
        return None
    y, x = step * y, step * x
    dx, dy = (x - centre_x).astype(np.float32), (y - centre_y).astype(np.float32)
    blur = cv2.GaussianBlur(relief.curvature, (0, 0), COARSE_PX)
    coarse = _motion(np.asarray(blur, np.float32), x, y, dx, dy)
    motion = _motion(relief.curvature, x, y, dx, dy)
    smooth = _smooth(motion[:, 1:3], relief.noise)
    if smooth is not None:  # shift by noise would wander, frame after frame
        motion[:, 1:3] -= np.outer(motion[:, 1:3] @ smooth, smooth)
    block = np.floor(dx / BLOCK_PX).astype(np.intp) * 64 + np.floor(dy / BLOCK_PX).astype(np.intp)
    return TextureTemplate(
        dx,
        dy,
        relief.curvature[y, x],
        motion,
        np.unique(block, return_inverse=True)[1],
        None if smooth is None else (float(smooth[0]), float(smooth[1])),
        (centre_x + window.left_px, centre_y + window.top_px),
        _lever(coarse.T @ coarse),
        math.sqrt(float(np.mean(np.square(relief.curvature[y, x])))),
        relief.noise,
        relief.curvature,
        (centre_x, centre_y),
    )


def fit_texture(texture: TextureTemplate, relief: TextureMap, start: TexturePose) -> TextureFit:
    """Lay the reference's relief over another, from a start within some degrees and pixels."""
    if texture.round:
        return TextureFit(start, 180.0, 180.0, 180.0, 0.0, 0.0, 1.0, 0.0, ROUND)
    rotation, dx, dy, scale, gain = math.radians(start.rotation_deg), start.dx_px, start.dy_px, start.scale, start.gain
    motion = texture.motion
    for _ in range(MAX_ROUNDS):
        value, weight = _laid(texture, relief, rotation, dx, dy, scale)
        difference = value - np.float32(gain) * texture.value
        square = difference * difference
        noise2 = max(float(weight @ square) / max(float(weight.sum()), 1.0), 1e-6)
        weight /= 1.0 + square * np.float32(1.0 / (ROBUST**2 * noise2))
        weighted = motion.T * weight
        gains = np.array([gain, gain, gain, gain, 1.0])
        normal = (weighted @ motion).astype(np.float64) * np.outer(gains, gains)
        gradient = (weighted @ difference).astype(np.float64) * gains
        prior = _CORRELATED * noise2 / _PRIOR_STD**2
        c, s = math.cos(rotation), math.sin(rotation)
        away_x, away_y = dx - start.dx_px, dy - start.dy_px
        gradient[1] += prior[1] * (c * away_x - s * away_y)
        gradient[2] += prior[2] * (s * away_x + c * away_y)
        gradient[3] -= prior[3] * (scale - 1.0)
        gradient[4] -= prior[4] * (gain - 1.0)
        held = normal + np.diag(prior + 1e-7 * np.trace(normal))
        step = np.linalg.solve(held, gradient)
        rotation_step = min(max(float(step[0]), -0.2), 0.2)
        move_x, move_y = float(step[1]), float(step[2])
        scale = min(max(scale + float(step[3]), 0.5), 2.0)
        gain = min(max(gain + float(step[4]), 0.2), 5.0)
        # Inverse composition: undo the step before the present pose.
        rotation -= rotation_step
        c, s = math.cos(rotation), math.sin(rotation)
        dx -= c * move_x + s * move_y
        dy -= -s * move_x + c * move_y
        if abs(rotation_step) < 8e-4 and abs(move_x) + abs(move_y) < 0.04:
            break
    pose = TexturePose(math.degrees(rotation), dx, dy, scale, gain)
    left, top = (round(at - inside) for at, inside in zip(texture.center_px, texture.origin_px, strict=True))
    unmoved, seen = _laid(texture, TextureMap(ImageWindow(left, top, 0, 0), texture.picture), rotation, dx, dy, scale)
    back = static_pattern_bias(motion, weight * seen, difference, unmoved)
    return _judged(texture, relief.noise, pose, held, difference, value, weight, back)


def _judged(
    texture: TextureTemplate,
    noise: float,
    pose: TexturePose,
    held: NDArray[np.float64],
    difference: Field,
    value: Field,
    weight: Field,
    back: float,
) -> TextureFit:
    mass = max(float(weight.sum()), 1e-6)
    told = np.linalg.inv(held)[0]
    gains = np.array([pose.gain, pose.gain, pose.gain, pose.gain, 1.0])
    pull = (texture.motion @ (told * gains).astype(np.float32)) * weight * difference
    parts = np.bincount(texture.block, pull)
    spread_deg = math.degrees(math.sqrt(float(parts @ parts)))
    levels = math.sqrt(1.0 / max(float(told[0]), 1e-12) / mass)  # change of the relief by a turn of a radian
    own2 = max(float(weight @ texture.value**2) / mass, 1e-9)
    now2 = max(float(weight @ value**2) / mass, 1e-9)
    both2 = float((weight * value) @ texture.value) / mass
    alike = both2 / math.sqrt(own2 * now2)
    clean2, clean_now2 = max(own2 - texture.noise**2, 1e-2 * own2), max(now2 - noise**2, 1e-2 * now2)
    noise2 = noise**2 + (pose.gain * texture.noise) ** 2
    left2 = float(weight @ difference**2) / mass - NOISE_LEFT * noise2
    sight = float(np.count_nonzero(weight)) / weight.size
    return TextureFit(
        pose,
        spread_deg=min(max(spread_deg, 1e-3), 180.0),
        noise_deg=min(math.degrees(math.sqrt(noise2) / levels), 180.0),
        misfit_deg=min(math.degrees(math.sqrt(max(left2, 0.0)) / levels), 180.0),
        lever=levels / (abs(pose.gain) * math.sqrt(own2)),
        alike=alike,
        deformed=1.0 - min(max(both2 / math.sqrt(clean2 * clean_now2), 0.0), 1.0),
        strength=math.sqrt(clean2),
        declined=CLIPPED if sight < SIGHT_MIN else None if alike >= ALIKE_MIN else OTHER,
        held_deg=back * abs(pose.rotation_deg) * (1.0 - min(max(alike, 0.0), 1.0)),
    )


def _laid(
    texture: TextureTemplate, relief: TextureMap, rotation: float, dx: float, dy: float, scale: float
) -> tuple[Field, Field]:
    """What now lies where the reference's points have moved to, and 1 where that is in the picture, else 0."""
    window = relief.window
    c, s = np.float32(scale * math.cos(rotation)), np.float32(scale * math.sin(rotation))
    x = texture.x_px * c + texture.y_px * s + np.float32(texture.center_px[0] + dx - window.left_px)
    y = texture.y_px * c - texture.x_px * s + np.float32(texture.center_px[1] + dy - window.top_px)
    rows, columns = relief.curvature.shape
    value = sampled(relief.curvature, x, y, cv2.BORDER_REPLICATE)
    inside = (x >= EDGE_PX) & (x <= columns - 1 - EDGE_PX) & (y >= EDGE_PX) & (y <= rows - 1 - EDGE_PX)
    return value, inside.astype(np.float32)


def _motion(picture: Field, x: NDArray[np.intp], y: NDArray[np.intp], dx: Field, dy: Field) -> Field:
    """(N, 5) float32: change of the picture's values per turn, shift x, shift y, scale and gain."""
    gx = cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=0.125)[y, x]
    gy = cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=0.125)[y, x]
    # A turn counter-clockwise as seen moves (dx, dy), y down, by (dy, -dx) a radian.
    # Motion by motion in memory: that is how a fit runs over them.
    return np.asarray(np.stack([gx * dy - gy * dx, gx, gy, -(gx * dx + gy * dy), picture[y, x]]), np.float32).T


def _smooth(shifts: Field, noise: float) -> Field | None:
    """The direction in which a shift changes least, where that is no more than noise does. shifts: (N, 2)."""
    square, axes = np.linalg.eigh(shifts.T @ shifts / len(shifts))
    return None if square[0] >= (SMOOTH * noise) ** 2 else np.asarray(axes[:, 0], np.float32)


def _lever(normal: NDArray[np.float32]) -> float:
    """What a turn of a radian changes that no other motion explains, over the picture itself, r.m.s."""
    whole = normal.astype(np.float64)
    whole += 1e-9 * (np.trace(whole) + 1e-9) * np.eye(len(whole))
    return math.sqrt(1.0 / float(np.linalg.inv(whole)[0, 0]) / max(float(whole[-1, -1]), 1e-9))
