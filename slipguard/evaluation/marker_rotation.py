"""How far the object has turned in the gripper, from the two markers that a fixed camera sees.

One model for a whole lift: the camera stands still and the gripper does not turn, so one orientation of the gripper's
marker holds for all frames; the object turns about the grasp axis alone, so one fixed rotation takes its marker there
from the gripper's. Each frame adds two positions and one turn. Gauss-Newton over all of it, with the frames' own
unknowns eliminated (Schur complement): a small marker's tilt, which one picture does not tell, all of them do.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.intrinsics import Intrinsics
from slipguard.evaluation.marker_detector import MarkerCorners

Array = NDArray[np.float64]
FRAMES_MIN = 5
"""Fewer frames with both markers do not make a turn."""
REFERENCE_FRAMES = 10
STILL_S = 0.3
"""The object lies still at first; all turns count from the mean of this time."""
CANDIDATES = 24
ITERATIONS = 12
STEP = 1e-6
RMS_MAX_PX = 1.0
"""Corners are found to 0.03-0.3 px; a model that misses them by more does not hold. Intrinsics that are wrong and still
pass (a focal length off by half, say) cost some tenths of a degree."""
OUTLIER_RMS = 4.0
CORNER_SIGMA_MIN_PX = 0.05


@dataclass(frozen=True, slots=True)
class RotationTrace:
    """Turns in degrees, counter-clockwise for the camera, zero at the start (mean of the first 0.3 s).

    time_s, rotation_deg, sigma_deg: (n,), frames in which both markers were seen well. gaps: how many were not.
    rms_px: mean distance of model and corners.
    """

    time_s: Array
    rotation_deg: Array
    sigma_deg: Array
    gaps: int
    rms_px: float


def rotations(sightings: list[MarkerCorners], intrinsics: Intrinsics, side_mm: float) -> RotationTrace:
    """The turn in every frame that shows both markers; side_mm: of their black squares.

    Raises InputError where too few frames do, or where no rigid motion about one axis explains the corners.
    """
    both = [
        (one.time_s, np.stack([one.gripper_px, one.object_px]))
        for one in sightings
        if one.gripper_px is not None and one.object_px is not None
    ]
    _check_seen(sightings, len(both))
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
            f"the markers move as no rigid gripper and object would (corners are off by {rms_px:.1f} px on average, "
            f"at most {RMS_MAX_PX:g}): check that the intrinsics are this camera's, that it stands still, and that "
            "both markers are flat"
        )
    angle = np.degrees(np.unwrap(fit.rotation_rad))
    sigma = np.degrees(fit.sigma_rad)
    time_s = np.array([time_s for (time_s, _), keep in zip(both, good, strict=True) if keep])
    still = time_s <= time_s[0] + STILL_S
    start_sigma = float(np.sqrt((sigma[still] ** 2).mean() / still.sum()))
    return RotationTrace(
        time_s, angle - angle[still].mean(), np.hypot(sigma, start_sigma), len(sightings) - len(time_s), rms_px
    )


def _check_seen(sightings: list[MarkerCorners], both: int) -> None:
    if both >= FRAMES_MIN:
        return
    total = len(sightings)
    gripper = sum(one.gripper_px is not None for one in sightings)
    thing = sum(one.object_px is not None for one in sightings)
    if gripper == 0 and thing == 0:
        raise InputError(f"no marker was seen in {total} pictures; print them with `slipguard evaluate markers`")
    if gripper == 0 or thing == 0:
        missing, number = ("gripper", 0) if gripper == 0 else ("object", 1)
        raise InputError(
            f"the marker of the {missing} (id {number}) was never seen in {total} pictures; both are needed"
        )
    raise InputError(f"both markers were seen together in {both} of {total} pictures; at least {FRAMES_MIN} are needed")


def _square(side_mm: float) -> Array:
    """(4, 3) corners in the marker's frame, in the detector's order: clockwise from upper left; y up, z outwards."""
    half = side_mm / 2.0
    return np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])


@dataclass(slots=True)
class _Fit:
    rotation_rad: Array
    sigma_rad: Array
    residual_px: Array


class _Model:
    """rays: (n, 2, 4, 2) normalised image points of gripper's and object's corners."""

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
        """(n, 16) in pixels. small: (6,) rotations added to both fixed orientations."""
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
        """Gauss-Newton: common (6,), the frames' own (n, 7), and their information matrices (n, 7, 7)."""
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
        # The turn about the axis is the frames' own: a common one is no unknown (third of the fixed rotation).
        left[5, :], left[:, 5], left[5, 5], right[5] = 0.0, 0.0, 1.0, 0.0
        step = -np.linalg.solve(left + 1e-9 * np.diag(np.diag(left)), right)
        return step, -own_part - np.einsum("nij,j->ni", solved, step), normal

    def _best_rotation(self, which: int, gripper: Array | None) -> Array:
        """The orientation of a marker that explains its corners best: the gripper's in all frames, the object's at the
        start. A single square has two that nearly do."""
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
        """(n,) turns to begin with: of each frame's two poses of the object the one nearer to the axis."""
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
    """Both orientations of a square that explain four rays about equally well."""
    found, rotations, _, _ = cv2.solvePnPGeneric(
        square, rays.reshape(4, 1, 2), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    return (
        [np.asarray(cv2.Rodrigues(one)[0], np.float64) for one in rotations] if found else [np.diag([1.0, -1.0, -1.0])]
    )


def _positions(rays: Array, points: Array) -> Array:
    """(n, 3) where bodies of known orientation are: linear in the position. points: (4, 3) or (n, 4, 3)."""
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
