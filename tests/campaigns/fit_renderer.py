"""A fit of the renderer's optics to real presses of a ball, evaluated on presses that were not fitted.

Least squares over the optics of the unit, the ball's radius, and position and depth of every press. The first half of
the presses is fitted, the second half is the test set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.imprint import Imprinter
from slipguard.sim.raster import Field, f32
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.sim.shapes import sphere
from tests.campaigns.ball_presses import RealPress, read_presses, write_sheet

Vector = NDArray[np.float64]
POSE_STEPS = np.array([0.03, 0.03, 0.03])
"""Steps of the derivatives in x, y and depth, mm: half a pixel."""
BALL_RADIUS_MM = 4.28
"""Fitted with `Unit.default()`."""


@dataclass(frozen=True, slots=True)
class FitParameter:
    """One fitted number of a sensor unit: field, index within it (() for a scalar), and the step of its derivative.

    Relative values are fitted as logarithms, so they stay positive.
    """

    field: str
    index: tuple[int, ...]
    step: float
    relative: bool = True


PARAMETERS = (
    *(FitParameter("led_height_mm", (c,), 0.05) for c in range(3)),
    *(FitParameter("led_azimuth_deg", (c,), 3.0, relative=False) for c in range(3)),
    *(FitParameter("gain_bgr", (c,), 0.05) for c in range(3)),
    *(FitParameter("crosstalk", (r, c), 0.03, relative=False) for r in range(3) for c in range(3) if r != c),
    FitParameter("glow_share", (), 0.1, relative=False),
    FitParameter("falloff", (), 0.2, relative=False),
    FitParameter("skirt_mm", (), 0.05),
    FitParameter("foundation", (), 0.01, relative=False),
    FitParameter("shadow", (), 0.05, relative=False),
    FitParameter("shadow_soft_mm", (), 0.1),
    FitParameter("psf_px", (), 0.1),
    FitParameter("dome_radius_mm", (), 0.1),
)


@dataclass(frozen=True, slots=True)
class RendererFit:
    """Fitted optics, ball radius, and (x_mm, y_mm, depth_mm) of each press."""

    unit: SensorUnit
    radius_mm: float
    poses: tuple[Vector, ...]


def fit(presses: Sequence[RealPress], start: RendererFit, rounds: int, progress: Callable[[str], None]) -> RendererFit:
    """Run Levenberg-Marquardt over optics and poses together; `progress` gets one line per round."""
    best, damping = start, 1e-2
    error = _total(presses, best)
    for count in range(rounds):
        system = _Normal(len(PARAMETERS) + 1, len(presses))
        for index, press in enumerate(presses):
            system.add(index, *_linearised(best, press, index))
        before = error
        for _ in range(5):
            trial = _moved(best, system.solve(damping))
            tried = _total(presses, trial)
            if tried < error:
                best, error, damping = trial, tried, damping / 4
                break
            damping *= 5
        progress(f"round {count + 1}: rms {np.sqrt(error):.2f} gray levels")
        if error > 0.9995 * before:
            break
    return best


def refined_pose(unit: SensorUnit, radius_mm: float, press: RealPress, rounds: int = 8) -> Vector:
    """Return the pose (x_mm, y_mm, depth_mm) at which the rendered image is closest to a press."""
    imprinter, surface = Imprinter(unit, press.background), _ball(radius_mm)
    pose = start_pose(unit, press)
    target = press.reduced(press.difference)
    damping = 1e-2
    drawn = press.reduced(_drawn(imprinter, surface, pose))
    for _ in range(rounds):
        columns = [
            (press.reduced(_drawn(imprinter, surface, pose + step)) - drawn) / step.sum()
            for step in np.diag(POSE_STEPS)
        ]
        slopes = np.stack(columns, axis=1)
        gram, right = slopes.T @ slopes, slopes.T @ (target - drawn)
        for _ in range(4):
            trial = pose + np.clip(np.linalg.solve(gram + damping * np.diag(np.diag(gram)), right), -0.4, 0.4)
            trial[2] = np.clip(trial[2], 0.1, 3.0)
            redrawn = press.reduced(_drawn(imprinter, surface, trial))
            if np.sum((target - redrawn) ** 2) < np.sum((target - drawn) ** 2):
                pose, drawn, damping = trial, redrawn, damping / 4
                break
            damping *= 5
        else:
            break
    return pose


def start_pose(unit: SensorUnit, press: RealPress) -> Vector:
    """Return an initial pose from the labeled circle."""
    x = (press.center_px[0] - (FRAME_WIDTH_PX - 1) / 2) / unit.px_per_mm
    y = -(press.center_px[1] - (FRAME_HEIGHT_PX - 1) / 2) / unit.px_per_mm
    return np.array([x, y, 1.3])


def drawn_difference(unit: SensorUnit, radius_mm: float, press: RealPress, pose: Vector) -> Field:
    """Return the rendered change of a ball press against the background, (320, 240, 3) float32 gray levels."""
    return _drawn(Imprinter(unit, press.background), _ball(radius_mm), pose)


def correlation(press: RealPress, drawn: Field) -> float:
    """Return the Pearson correlation of real and rendered difference image within 5 mm of the press, all channels."""
    real = press.difference[press.near]
    return float(np.corrcoef(real.ravel(), drawn[press.near].ravel())[0, 1])


def _ball(radius_mm: float) -> HeightRaster:
    return HeightRaster.of(lambda u, v: sphere(u, v, radius_mm), 4.0, 24.0)


def _drawn(imprinter: Imprinter, surface: HeightRaster, pose: Vector) -> Field:
    view = GelView("ball", x_mm=float(pose[0]), y_mm=float(pose[1]), depth_mm=float(pose[2]))
    imprint = imprinter.imprint(view, 0.0, surface)
    image = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), np.float32)
    if imprint is not None:
        image[imprint.window] = imprint.change_bgr
    return image


def _total(presses: Sequence[RealPress], state: RendererFit) -> float:
    """Return the mean squared residual, gray levels squared."""
    imprinter, surface = Imprinter(state.unit, presses[0].background), _ball(state.radius_mm)
    squares = [
        np.mean((press.reduced(press.difference) - press.reduced(_drawn(imprinter, surface, pose))) ** 2)
        for press, pose in zip(presses, state.poses, strict=True)
    ]
    return float(np.mean(squares))


def _linearised(state: RendererFit, press: RealPress, index: int) -> tuple[Field, Field, Field]:
    """Return the residual and its derivatives by the shared parameters (ball radius last) and by the pose."""
    pose = state.poses[index]
    here = press.reduced(_drawn(Imprinter(state.unit, press.background), _ball(state.radius_mm), pose))
    by_parameter = []
    for k, parameter in enumerate((*PARAMETERS, None)):
        step = np.zeros(len(PARAMETERS) + 1)
        step[k] = parameter.step if parameter is not None else 0.02
        moved = _moved(state, np.concatenate([step, np.zeros(3 * len(state.poses))]))
        drawn = _drawn(Imprinter(moved.unit, press.background), _ball(moved.radius_mm), pose)
        by_parameter.append((press.reduced(drawn) - here) / np.float32(step[k]))
    imprinter, surface = Imprinter(state.unit, press.background), _ball(state.radius_mm)
    by_pose = [
        (press.reduced(_drawn(imprinter, surface, pose + d)) - here) / np.float32(d.sum()) for d in np.diag(POSE_STEPS)
    ]
    return f32(press.reduced(press.difference) - here), np.stack(by_parameter, axis=1), np.stack(by_pose, axis=1)


class _Normal:
    """Normal equations of all presses: the optics are shared, each press has its own three pose numbers."""

    def __init__(self, shared: int, presses: int) -> None:
        self._shared = shared
        size = shared + 3 * presses
        self._matrix = np.zeros((size, size))
        self._right = np.zeros(size)

    def add(self, index: int, residual: Field, by_parameter: Field, by_pose: Field) -> None:
        slopes = np.concatenate([by_parameter, by_pose], axis=1)
        first = self._shared + 3 * index
        where = np.r_[0 : self._shared, first : first + 3]
        self._matrix[np.ix_(where, where)] += slopes.T @ slopes
        self._right[where] += slopes.T @ residual

    def solve(self, damping: float) -> Vector:
        diagonal = np.diag(self._matrix)
        damped = self._matrix + np.diag(damping * diagonal + 1e-9 * diagonal.max())
        return np.asarray(np.linalg.solve(damped, self._right), np.float64)


def _moved(state: RendererFit, step: Vector) -> RendererFit:
    """Return the state after a step in the parameters, the logarithm of the ball's radius, and the poses."""
    changes: dict[str, Any] = {}
    for parameter, size in zip(PARAMETERS, step, strict=False):
        values = np.array(changes.get(parameter.field, getattr(state.unit, parameter.field)), np.float64)
        size = float(np.clip(size, -5 * parameter.step, 5 * parameter.step))
        values[parameter.index] = (
            values[parameter.index] * np.exp(size) if parameter.relative else values[parameter.index] + size
        )
        changes[parameter.field] = _limited(parameter.field, values)
    poses = tuple(
        pose + np.clip(step[len(PARAMETERS) + 1 + 3 * k :][:3], -0.3, 0.3) for k, pose in enumerate(state.poses)
    )
    radius_mm = state.radius_mm * float(np.exp(np.clip(step[len(PARAMETERS)], -0.1, 0.1)))
    return RendererFit(
        replace(state.unit, **{name: _plain(value) for name, value in changes.items()}), radius_mm, poses
    )


_LIMITS = {
    "foundation": (0.5, 1.0), "glow_share": (0.0, 1.0), "shadow": (0.0, 1.0), "psf_px": (0.5, 2.2),
    "falloff": (0.0, 4.0), "shadow_soft_mm": (0.02, 2.0), "crosstalk": (-0.4, 1.0), "skirt_mm": (0.1, 1.5),
    "dome_radius_mm": (20.0, 90.0),
}  # fmt: skip


def _limited(field: str, values: Vector) -> Vector:
    low, high = _LIMITS.get(field, (-np.inf, np.inf))
    return np.clip(values, low, high)


def _plain(value: Any) -> Any:
    """Return nested tuples of floats."""
    return tuple(_plain(item) for item in value) if np.ndim(value) else float(value)


def fit_and_report(folder: Path, rounds: int, sheet: Path | None) -> None:
    """RendererFit the first half of the presses in a folder, print the result, write the sheet of the second half."""
    cv2.setNumThreads(1)
    presses = read_presses(folder)
    half = len(presses) // 2
    unit = SensorUnit()
    poses = tuple(refined_pose(unit, BALL_RADIUS_MM, press) for press in presses[:half])
    fitted = fit(presses[:half], RendererFit(unit, BALL_RADIUS_MM, poses), rounds, print)
    print(fitted.unit, f"ball radius {fitted.radius_mm:.3f} mm", sep="\n")
    report(presses, fitted.unit, fitted.radius_mm, sheet)


def report(presses: Sequence[RealPress], unit: SensorUnit, radius_mm: float, sheet: Path | None) -> None:
    """Print correlations of both halves, poses refitted; write the sheet of the second half."""
    half = len(presses) // 2
    drawn = [drawn_difference(unit, radius_mm, press, refined_pose(unit, radius_mm, press)) for press in presses]
    values = [correlation(press, image) for press, image in zip(presses, drawn, strict=True)]
    for name, part in (("fitted", values[:half]), ("held out", values[half:])):
        print(f"{name}: correlation mean {np.mean(part):.3f}, worst {min(part):.3f}, n {len(part)}")
    if sheet is not None:
        write_sheet(presses[half:], drawn[half:], sheet)
