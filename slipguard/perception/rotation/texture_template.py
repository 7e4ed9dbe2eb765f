"""The texture template: the reference's texture, and how motions change it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch
from slipguard.perception.rotation.round_contact import round_texture_reason
from slipguard.perception.rotation.texture_map import HEIGHT_PX, WIDTH_PX, Field, TextureMap, mask_in_window

SKIRT_PX = 5
"""The slopes around the contact count as far out as this, texture pixels."""
EDGE_PX = 4
"""Texture this close to the edge of the image is ignored: filters have half of their data there."""
POINTS_MAX = 1500
POINTS_MIN = 60
BLOCK_PX = 16.0
"""Residuals further apart than this are taken to be independent."""
NEAR_PX = 30.0
"""Partial slip: the middle that sticks, or what is around it, rotates by itself within about this distance (3 mm)."""
COARSE_PX = 2.3
"""Blur (texture pixels, on top of the map's own) for the test of roundness: uneven light on a ball makes fine
differences that do not rotate with it."""
SMOOTH = 0.8
"""Change of the texture per pixel along a shaft over the camera's noise, r.m.s., below which it is noise: 0.53-0.7 for
featureless shafts, from 1 for those with an end or a face."""
MOTIONS = 5
"""Fitted motions: rotation, two shifts, scale and gain."""


@dataclass(frozen=True, slots=True, eq=False)
class TextureTemplate:
    """The reference's texture: points around its center, their values and their change by each motion.

    place: (3, N) float32, right and down of the center, and 1. fields: (10, N) float32, change by rotation, shift x,
    shift y, scale and gain, the last of which is the value itself; then by uneven deformation of the gel: twist, two
    strains, two bends. local: (4, N), weights of a fit's residual that sum up to the rotation (radians) of what is near
    the grasp axis, and near the contact's center; and to the growth of strength to the right, and downwards (share per
    r.m.s. distance). local_size: (4,), their norms.
    block: (N,) number of the neighborhood that each point belongs to. smooth: the direction (right, down; of length 1)
    along which only noise changes, so that a shift is invisible; None if there is none.
    noise: the camera's share of the values, r.m.s. image, origin_px: the source of the points, and the center in it.
    mask: where in the image the texture counts, uint8, 0 or 1.
    round_reason: None, or why the contact counts as round.
    """

    place: Field
    fields: Field
    local: Field
    local_size: NDArray[np.float64]
    block: NDArray[np.intp]
    smooth: tuple[float, float] | None
    center_px: tuple[float, float]
    noise: float
    image: Field
    origin_px: tuple[float, float]
    mask: NDArray[np.uint8]
    round_reason: str | None

    @property
    def x_px(self) -> Field:
        return np.asarray(self.place[0], np.float32)

    @property
    def y_px(self) -> Field:
        return np.asarray(self.place[1], np.float32)

    @property
    def motion(self) -> Field:
        return self.fields[:MOTIONS]

    @property
    def value(self) -> Field:
        return np.asarray(self.fields[MOTIONS - 1], np.float32)


def make_texture_template(texture_map: TextureMap, patch: Patch) -> TextureTemplate | None:
    """Make a template of the texture in and around a patch; None if too little of it lies within the image."""
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
    blur = cv2.GaussianBlur(curvature, (0, 0), COARSE_PX)
    coarse = _motion(np.asarray(blur, np.float32), x, y, dx, dy)
    motion = _motion(curvature, x, y, dx, dy)
    smooth = _smooth_direction(motion[1:3], texture_map.noise)
    if smooth is not None:  # a shift measured on noise would wander from frame to frame
        motion[1:3] -= np.outer(smooth, smooth @ motion[1:3])
    local = _local_weights(motion, dx, dy, (center_x + window.left_px, center_y + window.top_px))
    block = np.floor(dx / BLOCK_PX).astype(np.intp) * 64 + np.floor(dy / BLOCK_PX).astype(np.intp)
    strength = math.sqrt(float(np.mean(np.square(motion[4]))))
    return TextureTemplate(
        np.stack([dx, dy, np.ones_like(dx)]),
        np.concatenate([motion, _deformations(motion, dx, dy)]),
        local,
        np.sqrt(np.einsum("ij,ij->i", local, local).astype(np.float64)),
        block - block.min(),
        None if smooth is None else (float(smooth[0]), float(smooth[1])),
        (center_x + window.left_px, center_y + window.top_px),
        texture_map.noise,
        curvature,
        (center_x, center_y),
        np.asarray(wide, np.uint8),
        round_texture_reason(_change_by_rotation(coarse @ coarse.T), strength),
    )


def _motion(image: Field, x: NDArray[np.intp], y: NDArray[np.intp], dx: Field, dy: Field) -> Field:
    """Return the change of the image's values by rotation, shift x, shift y, scale and gain: (5, N) float32."""
    gx = cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=0.125)[y, x]
    gy = cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=0.125)[y, x]
    # A counter-clockwise rotation moves (dx, dy), y down, by (dy, -dx) per radian.
    return np.asarray(np.stack([gx * dy - gy * dx, gx, gy, -(gx * dx + gy * dy), image[y, x]]), np.float32)


def _deformations(motion: Field, dx: Field, dy: Field) -> Field:
    """Return the change of the image's values by deformations that are not a motion: (5, N) float32.

    A rotation that grows with the distance from the center (twist, partial slip), stretch along one diagonal or axis
    and shortening across it (shear), and a shift that grows with that distance (bend).
    """
    gx, gy = motion[1:3]
    square = dx * dx + dy * dy
    far = square / max(float(square.mean()), 1e-6)
    strains = [gx * dx - gy * dy, gx * dy + gy * dx]
    size = np.sqrt(np.float32(square.mean()))
    return np.asarray(np.stack([(gx * dy - gy * dx) * far, *strains, gx * far * size, gy * far * size]), np.float32)


def _local_weights(motion: Field, dx: Field, dy: Field, center_px: tuple[float, float]) -> Field:
    """Return the weights that measure what partial slip and a tilt do, each next to the motions: (4, N) float32."""
    gx, gy, value = motion[1], motion[2], motion[4]

    def rotation_near(x_px: float, y_px: float) -> Field:
        x, y = dx - np.float32(x_px - center_px[0]), dy - np.float32(y_px - center_px[1])
        return np.asarray((gx * y - gy * x) * np.exp((x * x + y * y) * np.float32(-(NEAR_PX**-2))), np.float32)

    size = np.sqrt(np.mean(dx * dx + dy * dy))
    near_axis = rotation_near((WIDTH_PX - 1) / 2.0, (HEIGHT_PX - 1) / 2.0)
    local = np.stack([near_axis, rotation_near(*center_px), value * dx / size, value * dy / size]).astype(np.float64)
    normal = (motion @ motion.T).astype(np.float64)
    normal += 1e-6 * (float(np.trace(normal)) + 1e-9) / len(normal) * np.eye(len(normal))
    local -= np.linalg.solve(normal, motion @ local.T).T @ motion
    return np.asarray(local / np.maximum(np.sum(local**2, axis=1, keepdims=True), 1e-9), np.float32)


def _smooth_direction(shifts: Field, noise: float) -> Field | None:
    """Return the direction in which a shift changes least, if that is no more than noise. shifts: (2, N)."""
    square, axes = np.linalg.eigh(shifts @ shifts.T / shifts.shape[1])
    return None if square[0] >= (SMOOTH * noise) ** 2 else np.asarray(axes[:, 0], np.float32)


def _change_by_rotation(normal: NDArray[np.float32]) -> float:
    """Return the change by a rotation of one radian, beyond the other motions, over the image itself, r.m.s."""
    whole = normal.astype(np.float64)
    whole += 1e-9 * (np.trace(whole) + 1e-9) * np.eye(len(whole))
    return math.sqrt(1.0 / float(np.linalg.inv(whole)[0, 0]) / max(float(whole[-1, -1]), 1e-9))
