"""The object's rotation in the gripper, from two markers in the images of a fixed camera.

One model covers a whole lift: the camera is fixed and the gripper does not rotate, so the orientation of the gripper's
marker is the same in all frames; the object rotates about the grasp axis only, so its marker's orientation follows from
one fixed rotation. Each frame adds two positions and one rotation. Gauss-Newton over all frames, with the unknowns of
the frames eliminated (Schur complement): a small marker's tilt is not observable in one image, but in all together.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.camera_calibration import Intrinsics
from slipguard.evaluation.markers import MarkerCorners

Array = NDArray[np.float64]
FRAMES_MIN = 5
"""Minimum number of frames with both markers."""
REFERENCE_FRAMES = 10
STILL_S = 0.3
"""The object rests at first; rotations are relative to the mean over this time."""
CANDIDATES = 24
ITERATIONS = 12
STEP = 1e-6
RMS_MAX_PX = 1.0
"""Corners are accurate to 0.03-0.3 px; a larger residual contradicts the model. Wrong intrinsics that still pass
(say, a focal length off by half) cost some tenths of a degree."""
OUTLIER_RMS = 4.0
CORNER_SIGMA_MIN_PX = 0.05


@dataclass(frozen=True, slots=True)
class RotationTrace:
    """Rotations in degrees, counter-clockwise for the camera, zero at the start (mean of the first 0.3 s).

    Attributes:
        time_s, rotation_deg, sigma_deg: (n,), frames in which both markers were found.
        gaps: number of other frames.
        rms_px: reprojection error of the corners.
    """

    time_s: Array
    rotation_deg: Array
    sigma_deg: Array
    gaps: int
    rms_px: float


def rotations(frames: list[MarkerCorners], intrinsics: Intrinsics, side_mm: float) -> RotationTrace:
    """Return the rotation in every frame that shows both markers.

    Args:
        side_mm: side of the markers' black squares.

    Raises:
        InputError: too few frames show both, or no rigid motion about one axis explains the corners.
    """
    both = [
        (one.time_s, np.stack([one.gripper_px, one.object_px]))
        for one in frames
        if one.gripper_px is not None and one.object_px is not None
    ]
    _check_found(frames, len(both))
    corners = np.stack([seen for _, seen in both]).astype(np.float64)  # (n, 2, 4, 2)
    rays = intrinsics.rays(corners.reshape(-1, 2)).reshape(corners.shape)
    model = _Model(rays, intrinsics.focal_px, _square(side_mm))
    fit = model.solve()
    frame_rms = np.sqrt((fit.residual_px**2).mean(1))
    good = frame_rms <= OUTLIER_RMS * np.median(frame_rms)
    if good.sum() >= FRAMES_MIN and not good.all():
        fit = _Model(rays[good], intrinsics.focal_px, _square(side_mm)).solve()
    rms_px = float(np.sqrt((fit.residual_px**2).mean()))
    if rms_px > RMS_MAX_PX:
        raise InputError(
            f"the markers do not move like a rigid gripper and object (corners {rms_px:.1f} px rms off, limit "
            f"{RMS_MAX_PX:g}): check that the intrinsics are this camera's, that it does not move, and that both "
            "markers are flat"
        )
    angle = np.degrees(np.unwrap(fit.rotation_rad))
    sigma = np.degrees(fit.sigma_rad)
    time_s = np.array([time_s for (time_s, _), keep in zip(both, good, strict=True) if keep])
    still = time_s <= time_s[0] + STILL_S
    start_sigma = float(np.sqrt((sigma[still] ** 2).mean() / still.sum()))
    return RotationTrace(
        time_s, angle - angle[still].mean(), np.hypot(sigma, start_sigma), len(frames) - len(time_s), rms_px
    )


def _check_found(frames: list[MarkerCorners], both: int) -> None:
    if both >= FRAMES_MIN:
        return
    total = len(frames)
    gripper = sum(one.gripper_px is not None for one in frames)
    thing = sum(one.object_px is not None for one in frames)
    if gripper == 0 and thing == 0:
        raise InputError(f"no marker was found in {total} images; print them with `slipguard evaluate markers`")
    if gripper == 0 or thing == 0:
        missing, number = ("gripper", 0) if gripper == 0 else ("object", 1)
        raise InputError(
            f"the marker of the {missing} (id {number}) was not found in any of {total} images; both are needed"
        )
    raise InputError(f"both markers were found together in {both} of {total} images; at least {FRAMES_MIN} are needed")


def _square(side_mm: float) -> Array:
    """Return (4, 3) corners in the marker's frame, clockwise from upper left like the detector's; y up, z outwards."""
    half = side_mm / 2.0
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


@dataclass(slots=True)
class _Fit:
    rotation_rad: Array
    sigma_rad: Array
    residual_px: Array


class _Model:
    """The model of one lift. rays: (n, 2, 4, 2) normalized image points of the gripper's and the object's corners."""

    def __init__(self, rays: Array, focal_px: float, square: Array) -> None:
        self.rays, self.focal_px, self.square = rays, focal_px, square

    def solve(self) -> _Fit:
        count = len(self.rays)
        gripper = self._best_rotation(0, None)
        thing = self._best_rotation(1, gripper)
        fixed = gripper.T @ thing
        local = np.zeros((count, 7))
        local[:, 0] = self._first_rotations(gripper, fixed)
        local[:, 1:4] = _positions(self.rays[:, 0], self.square @ gripper.T)
        rotated = gripper @ _about_z(local[:, 0]) @ fixed
        local[:, 4:7] = _positions(self.rays[:, 1], np.einsum("kj,nij->nki", self.square, rotated))
        normal = np.zeros((count, 7, 7))
        residual = self._residual(gripper, fixed, np.zeros(6), local)
        damping = 1e-6
        for _ in range(ITERATIONS):
            step_all, step_local, normal = self._step(gripper, fixed, local, residual, damping)
            tried = local + step_local
            new_gripper, new_fixed = _rotated(step_all[:3]) @ gripper, _rotated(step_all[3:]) @ fixed
            now = self._residual(new_gripper, new_fixed, np.zeros(6), tried)
            if (now**2).sum() <= (residual**2).sum():
                done = (residual**2).sum() - (now**2).sum() < 1e-9 * (residual**2).sum()
                gripper, fixed, local, residual, damping = new_gripper, new_fixed, tried, now, damping / 10
                if done:
                    break
            else:
                damping = max(damping, 1e-9) * 100
        freedom = residual.size - 7 * count - 6
        corner = max(float(np.sqrt((residual**2).sum() / max(freedom, 1))), CORNER_SIGMA_MIN_PX)
        sigma = corner * np.sqrt(np.linalg.inv(normal)[:, 0, 0])
        return _Fit(local[:, 0], sigma, residual)

    def _residual(self, gripper: Array, fixed: Array, small: Array, local: Array) -> Array:
        """Return (n, 16) pixels. small: (6,) rotations added to both fixed orientations."""
        gripper, fixed = _rotated(small[:3]) @ gripper, _rotated(small[3:]) @ fixed
        on_gripper = (self.square @ gripper.T)[None] + local[:, None, 1:4]
        thing = gripper @ _about_z(local[:, 0]) @ fixed
        on_thing = np.einsum("kj,nij->nki", self.square, thing) + local[:, None, 4:7]
        seen = np.stack([on_gripper, on_thing], 1)
        flat = seen[..., :2] / seen[..., 2:]
        return np.asarray(self.focal_px * (flat - self.rays).reshape(len(local), -1), np.float64)

    def _step(
        self, gripper: Array, fixed: Array, local: Array, residual: Array, damping: float
    ) -> tuple[Array, Array, Array]:
        """Return a Gauss-Newton step: common (6,), per frame (n, 7), and information matrices (n, 7, 7)."""
        scale = np.array([1.0, *[np.abs(local[:, 3]).mean()] * 6])
        own = np.empty((*residual.shape, 7))
        for k in range(7):
            moved = local.copy()
            moved[:, k] += STEP * scale[k]
            own[..., k] = (self._residual(gripper, fixed, np.zeros(6), moved) - residual) / (STEP * scale[k])
        common = np.empty((*residual.shape, 6))
        for k in range(6):
            common[..., k] = (self._residual(gripper, fixed, STEP * np.eye(6)[k], local) - residual) / STEP
        normal = np.einsum("nri,nrj->nij", own, own)
        damped = normal * (1.0 + damping * np.eye(7))
        cross = np.einsum("nri,nrj->nij", common, own)
        solved = np.linalg.solve(damped, np.swapaxes(cross, 1, 2))
        gradient = np.einsum("nri,nr->ni", own, residual)
        own_part = np.linalg.solve(damped, gradient[..., None])[..., 0]
        left = np.einsum("nri,nrj->ij", common, common) - np.einsum("nij,njk->ik", cross, solved)
        right = np.einsum("nri,nr->i", common, residual) - np.einsum("nij,nj->i", cross, own_part)
        # The rotation about the axis belongs to the frames; the common one (third of the fixed rotation) is not free.
        left[5, :], left[:, 5], left[5, 5], right[5] = 0.0, 0.0, 1.0, 0.0
        step = -np.linalg.solve(left + 1e-9 * np.diag(np.diag(left)), right)
        return step, -own_part - np.einsum("nij,j->ni", solved, step), normal

    def _best_rotation(self, which: int, gripper: Array | None) -> Array:
        """Return the orientation of a marker that explains its corners best; a single square has two candidates.

        The gripper's marker is fitted in all frames, the object's at the start.
        """
        rays = self.rays[:, which] if gripper is None else self.rays[:REFERENCE_FRAMES, which]
        picked = rays[np.linspace(0, len(rays) - 1, min(len(rays), CANDIDATES)).astype(int)]
        candidates = [rotation for one in picked for rotation in _square_poses(one, self.square)]
        misses = [self._miss(rays, rotation) for rotation in candidates]
        return candidates[int(np.argmin(misses))]

    def _miss(self, rays: Array, rotation: Array) -> float:
        points = self.square @ rotation.T
        seen = points[None] + _positions(rays, points)[:, None]
        return float(np.median(np.abs(seen[..., :2] / seen[..., 2:] - rays)))

    def _first_rotations(self, gripper: Array, fixed: Array) -> Array:
        """Return (n,) initial rotations: of each frame's two object poses the one closer to the axis."""
        rotations = np.zeros(len(self.rays))
        for number, one in enumerate(self.rays[:, 1]):
            best = -np.inf
            for rotation in _square_poses(one, self.square):
                rotated = gripper.T @ rotation @ fixed.T
                if rotated[2, 2] > best:
                    best = rotated[2, 2]
                    rotations[number] = np.arctan2(rotated[1, 0] - rotated[0, 1], rotated[0, 0] + rotated[1, 1])
        return np.unwrap(rotations)


def _square_poses(rays: Array, square: Array) -> list[Array]:
    """Return both orientations of a square that explain four rays about equally well."""
    found, rotations, _, _ = cv2.solvePnPGeneric(
        square, rays.reshape(4, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return (
        [np.asarray(cv2.Rodrigues(one)[0], np.float64) for one in rotations] if found else [np.diag([1.0, -1.0, -1.0])]
    )


def _positions(rays: Array, points: Array) -> Array:
    """Return the (n, 3) positions of bodies of known orientation, a linear problem. points: (4, 3) or (n, 4, 3)."""
    points = np.broadcast_to(points, (len(rays), 4, 3))
    one, zero = np.ones(rays.shape[:2]), np.zeros(rays.shape[:2])
    rows = np.stack([np.stack([one, zero, -rays[..., 0]], -1), np.stack([zero, one, -rays[..., 1]], -1)], -2)
    right = rays * points[..., 2:] - points[..., :2]
    a, b = rows.reshape(len(rays), 8, 3), right.reshape(len(rays), 8)
    solved = np.linalg.solve(np.swapaxes(a, 1, 2) @ a, np.einsum("nij,ni->nj", a, b)[..., None])
    return np.asarray(solved[..., 0], np.float64)


def _about_z(angles: Array) -> Array:
    c, s, zero, one = np.cos(angles), np.sin(angles), np.zeros(len(angles)), np.ones(len(angles))
    return np.asarray(np.stack([c, -s, zero, s, c, zero, zero, zero, one], -1).reshape(-1, 3, 3), np.float64)


def _rotated(vector: Array) -> Array:
    return np.asarray(cv2.Rodrigues(vector)[0], np.float64)
