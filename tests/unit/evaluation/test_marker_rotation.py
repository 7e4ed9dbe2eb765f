"""Known rotations in images of a rendered camera, measured by the two markers."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from sampled import sampled

from slipguard.errors import InputError
from slipguard.evaluation.camera_calibration import Intrinsics
from slipguard.evaluation.marker_rotation import RotationTrace, rotations
from slipguard.evaluation.markers import MarkerCorners, MarkerDetector, cells
from slipguard.evaluation.simulated_lifts import intrinsics_of
from slipguard.sim.external_camera import ExternalCameraModel, ExternalCameraRenderer, MarkerPlate, MarkerScene

LOOK = ExternalCameraModel(
    gripper=MarkerPlate(cells(0), 40.0, (0.0, 95.0, 3.0), roll_deg=4.0),
    object=MarkerPlate(cells(1), 40.0, (70.0, 0.0, 6.0), roll_deg=-15.0),
    aim_mm=(30.0, 70.0, 0.0),
)
FRAMES = 24


def motion(sign: float = 1.0, largest_deg: float = 35.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, true rotations and heights: at rest, then rotating while lifted."""
    time_s = np.linspace(0.0, 2.5, FRAMES)
    rotation_deg = sign * np.clip((time_s - 0.8) * 22.0, 0.0, largest_deg)
    return time_s, rotation_deg, np.maximum(time_s - 0.7, 0.0) * 25.0


def seen(
    look: ExternalCameraModel, sign: float = 1.0, covered: range = range(0), what: str = "object"
) -> list[MarkerCorners]:
    studio, detector = ExternalCameraRenderer(look, 3), MarkerDetector()
    frames = []
    for number, (time_s, rotation_deg, height_mm) in enumerate(zip(*motion(sign), strict=True)):
        hidden = frozenset({what}) if number in covered else frozenset()
        image = studio.draw(MarkerScene(float(rotation_deg), float(height_mm), covered=hidden))
        frames.append(detector.detect(image, float(time_s)))
    return frames


def errors(trace: RotationTrace, sign: float = 1.0) -> np.ndarray:
    time_s, rotation_deg, _ = motion(sign)
    return np.asarray(trace.rotation_deg - np.interp(trace.time_s, time_s, rotation_deg))


GRID = list(itertools.product((300.0, 600.0, 1000.0), (0.0, 20.0, 40.0)))


@pytest.mark.parametrize(("distance_mm", "tilt_deg"), sampled(GRID, every=4))
def test_rotations_are_measured_at_every_distance_and_tilt(distance_mm: float, tilt_deg: float) -> None:
    azimuth = 37.0 * GRID.index((distance_mm, tilt_deg))
    aim = (30.0, 60.0, 0.0) if distance_mm > 400.0 else (30.0, 80.0, 0.0)
    blur, noise = (0.6, 2.0) if tilt_deg < 30.0 else (1.2, 4.0)
    look = replace(
        LOOK, distance_mm=distance_mm, tilt_deg=tilt_deg, azimuth_deg=azimuth, aim_mm=aim, blur_px=blur, noise=noise
    )
    sign = -1.0 if tilt_deg == 20.0 else 1.0
    trace = rotations(seen(look, sign), intrinsics_of(look.lens), 40.0)
    error = np.abs(errors(trace, sign))
    assert error.mean() <= 0.3
    assert error.max() <= 1.0
    assert len(trace.time_s) >= FRAMES // 2  # at 0.3 m the lift leaves the image


def test_covered_markers_are_gaps_and_not_guesses() -> None:
    frames = seen(LOOK, covered=range(10, 16))
    trace = rotations(frames, intrinsics_of(LOOK.lens), 40.0)
    assert trace.gaps == 6
    times = [one.time_s for one in frames]
    assert not set(times[10:16]) & set(trace.time_s)
    assert np.abs(errors(trace)).max() <= 0.5


def test_sigma_matches_the_size_of_the_errors() -> None:
    look = replace(LOOK, distance_mm=900.0, noise=5.0, blur_px=1.0, tilt_deg=15.0)
    trace = rotations(seen(look), intrinsics_of(look.lens), 40.0)
    scaled = np.abs(errors(trace)) / trace.sigma_deg
    assert np.mean(scaled <= 2.0) >= 0.85
    assert np.median(scaled) >= 0.2


def test_a_marker_that_is_never_found_is_named() -> None:
    lens = intrinsics_of(LOOK.lens)
    with pytest.raises(InputError, match=r"marker of the object \(id 1\) was not found"):
        rotations(seen(LOOK, covered=range(FRAMES)), lens, 40.0)
    with pytest.raises(InputError, match=r"marker of the gripper \(id 0\) was not found"):
        rotations(seen(LOOK, covered=range(FRAMES), what="gripper"), lens, 40.0)
    with pytest.raises(InputError, match="no marker was found in 3 images"):
        rotations([MarkerCorners(0.1 * k, None, None) for k in range(3)], lens, 40.0)


def test_too_few_images_are_rejected() -> None:
    with pytest.raises(InputError, match="at least 5 are needed"):
        rotations(seen(LOOK)[:4], intrinsics_of(LOOK.lens), 40.0)


def test_intrinsics_of_another_camera_are_detected() -> None:
    frontal = replace(LOOK, tilt_deg=0.0)
    wrong = intrinsics_of(frontal.lens).model_copy(update={"fy_px": 1150.0})
    with pytest.raises(InputError, match="check that the intrinsics are this camera's"):
        rotations(seen(frontal), wrong, 40.0)


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"fx_px": 50.0, "fy_px": 50.0}, "focal length"),
        ({"fy_px": 2000.0}, "differ too much"),
        ({"cx_px": 5.0}, "middle"),
        ({"fx_px": float("nan")}, "finite"),
    ],
)
def test_implausible_intrinsics_are_rejected(changed: dict[str, float], word: str) -> None:
    good = intrinsics_of(LOOK.lens).model_dump()
    with pytest.raises(ValueError, match=word):
        Intrinsics.model_validate(good | changed)


def test_images_of_another_size_are_rejected() -> None:
    with pytest.raises(InputError, match="640x480, the intrinsics are for 1280x720"):
        intrinsics_of(LOOK.lens).check_size(640, 480, "film.mp4")
