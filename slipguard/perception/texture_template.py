"""The texture template: points of the reference's texture, how motions change them, and which rotations look alike.

The curve of the reference with itself over all rotations is known before anything moves. Its further maxima are the
rotations after which the texture looks the same or nearly so: periods (gears, nuts), symmetries (a bar by 180 degrees).
The curve of a frame is needed only after a gap in which the object may have rotated further than a registration
searches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.estimate import DeclineReason, explain
from slipguard.perception.patch import Patch
from slipguard.perception.texture_map import HEIGHT_PX, WIDTH_PX, Field, ImageWindow, TextureMap, mask_in_window

SKIRT_PX = 5
"""The slopes around the contact count as far out as this, texture pixels."""
EDGE_PX = 4
"""Texture this close to the edge of the image is ignored: filters have half of their data there."""
POINTS_MAX = 1500
POINTS_MIN = 60
BLOCK_PX = 16.0
"""Residuals further apart than this are taken to be independent: 1.7 mm."""
NEAR_PX = 30.0
"""Partial slip: the middle that sticks, or what is around it, rotates by itself within about this distance (3 mm)."""
COARSE_PX = 2.3
"""Blur (texture pixels, on top of the map's own) for the test of roundness: uneven light on a ball makes fine
differences that do not rotate with it."""
SMOOTH = 0.8
"""Change of the texture per pixel along a shaft over the camera's noise, r.m.s., below which it is noise: 0.53-0.7 for
featureless shafts, from 1 for those with an end or a face."""
CHANGE_MIN = 1.3
"""Change of the blurred texture by a rotation of one radian (beyond what shift, scale and gain explain) over the
texture itself, r.m.s.: 0.3-1.0 for plain balls and rings, rendered and real, 1.4 and more for contacts with a face."""
FAINT_LEVELS, FAINT_SHARE = 1.2, 0.25
"""Strength of a faint texture, gray levels per pixel, r.m.s. It must change more, since noise also has an axis: by this
share at that strength, and with the inverse square of the strength. Real faint balls reach a change of 1.3."""
ARC_SHARE = 0.5
"""An arc that slides along itself also rotates. A texture is one if its weakest motion, a rotation with a shift,
changes it by less than this share (of squares) of what the second weakest does."""
MOTIONS = 5
"""Fitted motions: rotation, two shifts, scale and gain."""


STEP_DEG = 2.0
POINTS = 500
"""A curve has this step, and about this many points of the texture."""
SIMILAR = 0.5
"""Smallest correlation at a maximum of the curve that is followed up. Teeth and regular polygons reach 0.85-0.99, a nut
of which not all edges touch, a cross and four pins 0.75, other contacts of tools 0.6 and less."""
CAPTURE_DEG = 12.0
"""A registration finds rotations this far from its start: starts that are closer together end at the same pose."""
SIMILAR_APART_DEG = 6.0
"""The finest period that is followed up: 60 teeth."""
STARTS_MAX = 4
"""A search begins at this many rotations."""

_ROTATIONS_DEG = np.arange(-180.0, 180.0, STEP_DEG)


@dataclass(frozen=True, slots=True, eq=False)
class TextureTemplate:
    """The reference's texture: points around its center, their values and their change by each motion.

    place: (3, N) float32, right and down of the center, and 1.
    motion: (5, N) float32, change by rotation (rad), shift right, shift down, scale and gain. value: the last one.
    local: (2, N) float32, weights of a fit's residual that sum up to the clockwise rotation (rad) of what is near the
    grasp axis, and near the contact's center, against the rest.
    block: (N,) number of the neighborhood that each point belongs to.
    smooth: the direction (right, down; of length 1) along which only noise changes, so that a shift is invisible; None
    if there is none.
    arc_deg_px: (right, down), by how many degrees a texture that is an arc rotates per pixel of a shift along itself.
    center_px: the center, texture pixels of the whole image. image, origin_px: the source of the points, and the center
    in it. mask: where in the image the texture counts, (h, w) uint8, 0 or 1.
    round_reason: None, or why the contact counts as round.
    """

    place: Field
    motion: Field
    value: Field
    local: Field
    block: NDArray[np.intp]
    smooth: tuple[float, float] | None
    arc_deg_px: tuple[float, float]
    center_px: tuple[float, float]
    image: Field
    origin_px: tuple[float, float]
    mask: NDArray[np.uint8]
    round_reason: str | None


def make_texture_template(texture_map: TextureMap, patch: Patch) -> TextureTemplate | None:
    """Return a template of the texture in and around a patch; None if too little of it lies within the image."""
    window, curvature = texture_map.window, texture_map.curvature
    mask = mask_in_window(patch, window)
    m = cv2.moments(mask, True)
    if m["m00"] < 1.0:
        return None
    center_x, center_y = m["m10"] / m["m00"], m["m01"] / m["m00"]
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
    dx, dy = (x - center_x).astype(np.float32), (y - center_y).astype(np.float32)
    blurred = np.asarray(cv2.GaussianBlur(curvature, (0, 0), COARSE_PX), np.float32)
    coarse = _motion(blurred, x, y, dx, dy)
    motion = _motion(curvature, x, y, dx, dy)
    smooth = _smooth_direction(motion[1:3], texture_map.noise)
    if smooth is not None:  # a shift measured on noise would wander from frame to frame
        motion[1:3] -= np.outer(smooth, smooth @ motion[1:3])
    local = _local_weights(motion, dx, dy, (center_x + window.left_px, center_y + window.top_px))
    block = np.floor(dx / BLOCK_PX).astype(np.intp) * 64 + np.floor(dy / BLOCK_PX).astype(np.intp)
    return TextureTemplate(
        np.stack([dx, dy, np.ones_like(dx)]),
        motion,
        motion[MOTIONS - 1],
        local,
        block - block.min(),
        None if smooth is None else (float(smooth[0]), float(smooth[1])),
        _arc(motion, math.sqrt(float(np.mean(dx * dx + dy * dy)))),
        (center_x + window.left_px, center_y + window.top_px),
        curvature,
        (center_x, center_y),
        np.asarray(wide, np.uint8),
        _round_reason(coarse, math.sqrt(float(np.mean(np.square(motion[4]))))),
    )


def _motion(image: Field, x: NDArray[np.intp], y: NDArray[np.intp], dx: Field, dy: Field) -> Field:
    """Return the change of the image's values by rotation, shift x, shift y, scale and gain: (5, N) float32."""
    gx = cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=0.125)[y, x]
    gy = cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=0.125)[y, x]
    # A counter-clockwise rotation moves (dx, dy), y down, by (dy, -dx) per radian.
    return np.asarray(np.stack([gx * dy - gy * dx, gx, gy, -(gx * dx + gy * dy), image[y, x]]), np.float32)


def _products(motion: Field) -> NDArray[np.float64]:
    """Return the products of the motions, (5, 5), invertible."""
    products = (motion @ motion.T).astype(np.float64)
    products += 1e-6 * (float(np.trace(products)) + 1e-9) / len(products) * np.eye(len(products))
    return products


def _local_weights(motion: Field, dx: Field, dy: Field, center_px: tuple[float, float]) -> Field:
    """Return the weights that measure what partial slip does next to the motions: (2, N) float32."""
    gx, gy = motion[1], motion[2]

    def rotation_near(x_px: float, y_px: float) -> Field:
        x, y = dx - np.float32(x_px - center_px[0]), dy - np.float32(y_px - center_px[1])
        return np.asarray((gx * y - gy * x) * np.exp((x * x + y * y) * np.float32(-(NEAR_PX**-2))), np.float32)

    near_axis = rotation_near((WIDTH_PX - 1) / 2.0, (HEIGHT_PX - 1) / 2.0)
    local = np.stack([near_axis, rotation_near(*center_px)]).astype(np.float64)
    local -= np.linalg.solve(_products(motion), motion @ local.T).T @ motion
    return np.asarray(local / np.maximum(np.sum(local**2, axis=1, keepdims=True), 1e-9), np.float32)


def _smooth_direction(shifts: Field, noise: float) -> Field | None:
    """Return the direction in which a shift changes least, if that is no more than noise. shifts: (2, N)."""
    square, axes = np.linalg.eigh(shifts @ shifts.T / shifts.shape[1])
    return None if square[0] >= (SMOOTH * noise) ** 2 else np.asarray(axes[:, 0], np.float32)


def _arc(motion: Field, radius_px: float) -> tuple[float, float]:
    """Return by how many degrees the texture rotates per pixel right and down while it slides along itself.

    That is the weakest of the rigid motions: the one that changes the texture least. radius_px: r.m.s. distance of the
    points from the center, at which a rotation moves them as far as a shift does.
    """
    rigid = np.linalg.inv(np.linalg.inv(_products(motion))[:3, :3])
    rigid[0] /= radius_px
    rigid[:, 0] /= radius_px
    changes, motions = np.linalg.eigh(rigid)
    turn, right, down = motions[:, 0]
    share = max(1.0 - float(changes[0] / changes[1]) / ARC_SHARE, 0.0)
    deg_px = share * math.degrees(turn / radius_px)
    return float(deg_px * right), float(deg_px * down)


def _round_reason(coarse: Field, strength: float) -> str | None:
    """Return why a texture changes too little when rotated, as that of a ball; None if it changes enough.

    coarse: (5, N), motions of the blurred texture. strength: r.m.s. of the texture, gray levels per pixel.
    """
    products = _products(coarse)
    levels = math.sqrt(1.0 / float(np.linalg.inv(products)[0, 0]))
    change = levels / math.sqrt(max(float(products[-1, -1]), 1e-9))
    limit = CHANGE_MIN * (1.0 + FAINT_SHARE * (FAINT_LEVELS / max(strength, 1e-3)) ** 2)
    if not change < limit:
        return None
    return explain(DeclineReason.ROUND, f"texture changes by {change:.2f} per radian, limit {limit:.2f}")


def correlation_curve(
    template: TextureTemplate, texture_map: TextureMap, shift_px: tuple[float, float]
) -> NDArray[np.float32]:
    """Return the correlation of a texture with the template, rotated in steps of `STEP_DEG` from -180 degrees on.

    Args:
        template: The reference's texture.
        texture_map: The texture of a frame.
        shift_px: Where the reference's center is now, texture pixels right and down of where it was.
    """
    step = max(template.value.size // POINTS, 1)
    x, y, own = template.place[0, ::step], template.place[1, ::step], template.value[::step]
    window = texture_map.window
    center_x = np.float32(template.center_px[0] + shift_px[0] - window.left_px)
    center_y = np.float32(template.center_px[1] + shift_px[1] - window.top_px)
    c = np.cos(np.radians(_ROTATIONS_DEG)).astype(np.float32)[:, None]
    s = np.sin(np.radians(_ROTATIONS_DEG)).astype(np.float32)[:, None]
    place = c * x + s * y + center_x, c * y - s * x + center_y
    value = cv2.remap(texture_map.curvature, *place, cv2.INTER_LINEAR, borderValue=0.0)
    size = np.sqrt(np.einsum("ij,ij->i", value, value) * np.float32(own @ own))
    return np.asarray((value @ own) / np.maximum(size, np.float32(1e-9)), np.float32)


def maxima_deg(
    curve: NDArray[np.float32], near_deg: float, within_deg: float, apart_deg: float = CAPTURE_DEG
) -> list[float]:
    """Return the rotations at the maxima of a curve, the highest first, at least `apart_deg` apart.

    They are those nearest `near_deg`, and at most `within_deg` away from there.
    """
    peak = (curve >= np.roll(curve, 1)) & (curve > np.roll(curve, -1)) & (curve > SIMILAR)
    found: list[float] = []
    for k in sorted(np.flatnonzero(peak), key=lambda one: -curve[one]):
        rotation_deg = near_deg + math.remainder(float(_ROTATIONS_DEG[k]) - near_deg, 360.0)
        if abs(rotation_deg - near_deg) <= within_deg and all(abs(rotation_deg - one) >= apart_deg for one in found):
            found.append(rotation_deg)
    return found


def similar_deg(template: TextureTemplate) -> list[float]:
    """Return the rotations after which the reference's texture is similar to itself, without 0."""
    left, top = (round(at - inside) for at, inside in zip(template.center_px, template.origin_px, strict=True))
    own = TextureMap(ImageWindow(left, top, 0, 0), template.image)
    curve = correlation_curve(template, own, (0.0, 0.0))
    return [one for one in maxima_deg(curve, 0.0, 180.0, SIMILAR_APART_DEG) if one != 0.0]
