"""A rendered external camera: it sees gripper and object with a marker on each.

Millimeters in the gripper's frame: x to the right, y up, z along the grasp axis towards the camera, origin between the
fingertips. A positive rotation is counter-clockwise as seen by the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
OVERSAMPLING = 3
"""Markers are drawn at this scale and averaged down, like a sensor's pixels."""
BODY_BGR, FINGER_BGR, OBJECT_BGR = (70, 66, 62), (48, 46, 44), (96, 132, 176)


@dataclass(frozen=True, slots=True)
class LensModel:
    """Intrinsics of a camera. Focal length and center in pixels; k1, k2: radial distortion as in OpenCV."""

    width_px: int = 1280
    height_px: int = 720
    focal_px: float = 1000.0
    center_px: tuple[float, float] = (644.0, 356.0)
    k1: float = -0.08
    k2: float = 0.03

    def matrix(self) -> Points:
        """Return the (3, 3) camera matrix."""
        (u, v), f = self.center_px, self.focal_px
        return np.array([[f, 0.0, u], [0.0, f, v], [0.0, 0.0, 1.0]])

    def distortion(self) -> Points:
        """Return (5,) k1 k2 p1 p2 k3."""
        return np.array([self.k1, self.k2, 0.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class MarkerPlate:
    """One square marker. side_mm: of its black square; cells: (n, n) of 0 and 1, black border included."""

    cells: NDArray[np.uint8]
    side_mm: float
    center_mm: tuple[float, float, float]
    roll_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class ExternalCameraModel:
    """Pose and image quality of the camera, and both markers.

    Attributes:
        distance_mm: from the aim point.
        tilt_deg: of the optical axis against the grasp axis.
        azimuth_deg: direction of the tilt, 0 right, 90 up.
        roll_deg: about the optical axis.
        aim_mm: point on the optical axis.
    """

    gripper: MarkerPlate
    object: MarkerPlate
    lens: LensModel = field(default_factory=LensModel)
    distance_mm: float = 600.0
    tilt_deg: float = 10.0
    azimuth_deg: float = 40.0
    roll_deg: float = 0.0
    aim_mm: tuple[float, float, float] = (0.0, 60.0, 0.0)
    blur_px: float = 0.6
    noise: float = 2.0
    light: float = 1.0


@dataclass(frozen=True, slots=True)
class MarkerScene:
    """The state to render. height_mm: of the gripper; covered: hidden markers, "gripper", "object"."""

    rotation_deg: float = 0.0
    height_mm: float = 0.0
    slip_mm: float = 0.0
    covered: frozenset[str] = frozenset()


class ExternalCameraRenderer:
    """Renders scenes for one camera; deterministic for seed and order of calls."""

    def __init__(self, model: ExternalCameraModel, seed: int = 0) -> None:
        self.model = model
        self._rng = np.random.default_rng(seed)
        lens = model.lens
        self._rotation, self._center = _camera_pose(model)
        self._background = _background(lens)
        grid = np.stack(np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px)), -1).reshape(-1, 1, 2)
        ideal = cv2.undistortPoints(grid.astype(np.float64), lens.matrix(), lens.distortion(), P=lens.matrix())
        self._ideal = ideal.reshape(lens.height_px, lens.width_px, 2).astype(np.float32)
        self._noise = (model.noise * self._rng.normal(0.0, 1.0, (2 * lens.height_px, 2 * lens.width_px, 1))).astype(
            np.float32
        )
        self._empty = self._exposed(self._background, 0, 0)

    def draw(self, scene: MarkerScene) -> NDArray[np.uint8]:
        """Return (height, width, 3) uint8 BGR. Away from gripper and object the noise is constant, to save time."""
        model = self.model
        up = np.array([0.0, scene.height_mm, 0.0])
        down = np.array([0.0, scene.slip_mm, 0.0])
        rotation = _rotated(math.radians(scene.rotation_deg))
        body = np.array([[-55, 38, 0], [55, 38, 0], [48, 150, 0], [-48, 150, 0]], np.float64) + up
        palm = np.array([[-14, -14, 2], [14, -14, 2], [14, 40, 2], [-14, 40, 2]], np.float64) + up
        bar = np.array([[-22, -14, 4], [130, -14, 4], [130, 14, 4], [-22, 14, 4]], np.float64)
        rod = bar @ rotation.T + up - down
        shapes = ((body, BODY_BGR), (rod, OBJECT_BGR), (palm, FINGER_BGR))
        image = self._background.copy()
        for shape, color in shapes:
            self._fill(image, shape, color)
        if "gripper" not in scene.covered:
            self._draw_marker(image, model.gripper, np.eye(3), up)
        if "object" not in scene.covered:
            self._draw_marker(image, model.object, rotation, up - down)
        left, top, right, bottom = self._window(np.concatenate([shape for shape, _ in shapes]))
        exposed = self._empty.copy()
        exposed[top:bottom, left:right] = self._exposed(image, left, top, right, bottom)
        return exposed

    def _window(self, corners_mm: Points) -> tuple[int, int, int, int]:
        """Return the part of the image that changes: left, top, right, bottom, with a margin."""
        lens = self.model.lens
        corners = self.project(corners_mm)
        margin = 40
        low = np.clip(np.floor(corners.min(0)) - margin, 0, (lens.width_px, lens.height_px)).astype(int)
        high = np.clip(np.ceil(corners.max(0)) + margin, 0, (lens.width_px, lens.height_px)).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def _exposed(
        self, image: NDArray[np.float32], left: int, top: int, right: int | None = None, bottom: int | None = None
    ) -> NDArray[np.uint8]:
        """Return part of the image after lens and sensor: distorted, blurred, noisy."""
        model = self.model
        where = self._ideal[top:bottom, left:right]
        if where.size == 0:
            return np.zeros((*where.shape[:2], 3), np.uint8)
        exposed = cv2.remap(image, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if model.blur_px > 0.0:
            exposed = cv2.GaussianBlur(exposed, (0, 0), model.blur_px)
        height, width = exposed.shape[:2]
        y = int(self._rng.integers(self._noise.shape[0] - height + 1))
        x = int(self._rng.integers(self._noise.shape[1] - width + 1))
        exposed = cv2.add(model.light * exposed, np.repeat(self._noise[y : y + height, x : x + width], 3, axis=2))
        return np.clip(exposed, 0, 255).astype(np.uint8)

    def project(self, points_mm: Points) -> Points:
        """Project (n, 3) points in the gripper's rest frame to (n, 2) pixels without distortion."""
        camera_mm = (points_mm - self._center) @ self._rotation.T
        lens = self.model.lens
        return np.asarray(lens.focal_px * camera_mm[:, :2] / camera_mm[:, 2:] + np.array(lens.center_px))

    def _fill(self, image: NDArray[np.float32], corners_mm: Points, color: tuple[int, int, int]) -> None:
        fixed = np.round(self.project(corners_mm) * 16).astype(np.int32)
        cv2.fillConvexPoly(image, fixed, color, cv2.LINE_AA, 4)

    def _draw_marker(self, image: NDArray[np.float32], plate: MarkerPlate, rotation: Points, offset_mm: Points) -> None:
        """Draw a marker with its white margin of one cell, in perspective and averaged over pixels."""
        count = len(plate.cells)
        cell_mm = plate.side_mm / count
        half = plate.side_mm / 2 + cell_mm
        flat = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]], np.float64)
        flat = flat @ _rotated(math.radians(plate.roll_deg)).T + np.array(plate.center_mm)
        corners = self.project(flat @ rotation.T + offset_mm)
        low = np.floor(corners.min(0)).astype(int) - 2
        high = np.ceil(corners.max(0)).astype(int) + 3
        low, high = np.maximum(low, 0), np.minimum(high, (image.shape[1], image.shape[0]))
        if np.any(high - low < 4):
            return
        scale = 8
        texture = np.pad(plate.cells, 1, constant_values=1).astype(np.float32)
        texture = np.kron(texture, np.ones((scale, scale), np.float32))
        side = float(scale * (count + 2))
        corner_px = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32) - 0.5
        target = (corners - low + 0.5) * OVERSAMPLING - 0.5
        warp = cv2.getPerspectiveTransform(corner_px, target.astype(np.float32))
        size = tuple(int(v) for v in (high - low) * OVERSAMPLING)
        ink = cv2.warpPerspective(texture, warp, size, flags=cv2.INTER_LINEAR)
        cover = cv2.warpPerspective(np.ones_like(texture), warp, size, flags=cv2.INTER_LINEAR)
        small = (size[0] // OVERSAMPLING, size[1] // OVERSAMPLING)
        ink, cover = (cv2.resize(one, small, interpolation=cv2.INTER_AREA)[..., None] for one in (ink, cover))
        part = image[low[1] : high[1], low[0] : high[0]]
        part *= 1.0 - cover
        part += 25.0 * cover + 205.0 * ink


def _rotated(angle_rad: float) -> Points:
    """Return the rotation about z, counter-clockwise."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _camera_pose(model: ExternalCameraModel) -> tuple[Points, Points]:
    """Return the camera's axes (right, down, forward) as rows, and its position."""
    tilt, azimuth = math.radians(model.tilt_deg), math.radians(model.azimuth_deg)
    away = np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)])
    center = np.array(model.aim_mm) + model.distance_mm * away
    forward = -away
    right = np.cross(forward, np.array([0.0, 1.0, 0.0]))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    roll = math.radians(model.roll_deg)
    rotated = math.cos(roll) * right + math.sin(roll) * down, math.cos(roll) * down - math.sin(roll) * right
    return np.stack([*rotated, forward]), center


def _background(lens: LensModel) -> NDArray[np.float32]:
    rows = np.linspace(0.0, 1.0, lens.height_px, dtype=np.float32)[:, None, None]
    columns = np.linspace(-1.0, 1.0, lens.width_px, dtype=np.float32)[None, :, None]
    wall = 150.0 - 50.0 * rows + 14.0 * columns
    table = 98.0 + 30.0 * (rows - 0.78) - 8.0 * columns
    return np.ascontiguousarray(np.broadcast_to(np.where(rows > 0.78, table, wall), (lens.height_px, lens.width_px, 3)))
