"""Contours that are the gel's own: smooth contacts on a long dome, rendered."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.gel_contour import GelContour
from slipguard.perception.rotation.texture_map import ImageWindow, TextureMap
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.raster import f32
from slipguard.sim.sensor_unit import SensorUnit

UNIT = replace(SensorUnit(), dome_radius_mm=40.0, dome_aspect=1.8, dome_share=1.0)
FRAME_S = 1.0 / 60.0
HELD_FRAMES = 6
Surface = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]


def flat_face(u: NDArray[np.float32], _v: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.zeros_like(u)


def cylinder(u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a bottle of 28 mm diameter."""
    return f32(-v * v / 28.0)


def box(u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
    return f32(np.where((np.abs(u) < 5.0) & (np.abs(v) < 3.0), 0.0, -1.5))


def estimates(surface: Surface, depth_mm: float, start_deg: float) -> Iterator[tuple[float, Estimate]]:
    """Yield rotation and estimate of each frame of a rotation by 30 degrees."""
    camera, raster = GelCamera(UNIT), HeightRaster.of(surface)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), camera.no_contact(), UNIT.noise_bgr, 18.5)
    for k in range(HELD_FRAMES + 10):
        rotation = 3.0 * max(k + 1 - HELD_FRAMES, 0)
        image = camera.draw(GelView("bar", 0.3, -0.4, start_deg + rotation, depth_mm), raster=raster)
        yield rotation, pipeline.process(Frame(image, k * FRAME_S, k))


def test_a_flat_face_on_a_long_dome_is_declined() -> None:
    found = list(estimates(flat_face, 0.3, 12.0))
    assert all(estimate.contact for _, estimate in found)
    assert all(estimate.rotation_deg is None for _, estimate in found[HELD_FRAMES:])
    assert found[-1][1].decline_reason == "contour may be the gel's own"


def test_the_error_of_a_large_cylinder_is_covered_by_sigma() -> None:
    for rotation, estimate in list(estimates(cylinder, 0.3, 25.0))[HELD_FRAMES:]:
        if estimate.rotation_deg is not None and estimate.sigma_deg is not None:
            assert abs(estimate.rotation_deg - rotation) < 3.0 * estimate.sigma_deg


def test_a_face_with_edges_is_measured() -> None:
    for rotation, estimate in list(estimates(box, 0.4, 12.0))[HELD_FRAMES:]:
        assert estimate.rotation_deg == pytest.approx(rotation, abs=0.5)


def rectangle(width_px: int, height_px: int) -> Patch:
    probability = np.zeros((160, 120), np.float32)
    probability[80 - height_px // 2 : 80 + height_px // 2, 60 - width_px // 2 : 60 + width_px // 2] = 1.0
    patch = find_patch(probability, 0.5, 100, 2.0)
    assert patch is not None
    return patch


@pytest.mark.parametrize(
    ("height_px", "lean", "moved_px", "sigma_deg"),
    [(60, 0.0, 0.0, 0.3), (60, 0.0, 40.0, 0.3), (40, 0.0, 1.0, 0.3), (40, 0.0, 40.0, 5.0), (60, 0.53, 0.0, 1.53)],
)
def test_a_contact_that_leans_or_moves_and_shrinks_is_less_certain(
    height_px: int, lean: float, moved_px: float, sigma_deg: float
) -> None:
    edges = np.asarray(np.random.default_rng(1).normal(0.0, 30.0, (160, 120)), np.float32)
    slopes = np.ones((160, 120), np.float32)
    contour = GelContour(TextureMap(ImageWindow(0, 0, 120, 160), edges), (slopes, slopes), rectangle(30, 60))
    assert not contour.smooth
    found = contour.check(RotationEstimate(5.0, 0.3), rectangle(30, height_px), 1.0, lean, moved_px)
    assert found.sigma_deg == pytest.approx(sigma_deg, abs=0.02)


@pytest.mark.parametrize(("moved_px", "declined"), [(0.0, False), (20.0, False), (45.0, True)])
def test_a_smooth_contact_that_has_moved_by_more_than_two_millimeters_is_declined(
    moved_px: float, declined: bool
) -> None:
    slightly_bent, slopes = np.full((160, 120), 4.0, np.float32), np.full((160, 120), 40.0, np.float32)
    patch = rectangle(40, 70)
    contour = GelContour(TextureMap(ImageWindow(0, 0, 120, 160), slightly_bent), (slopes, slopes), patch)
    assert contour.smooth
    found = contour.check(RotationEstimate(0.0, 0.3), patch, 1.0, 0.0, moved_px)
    assert found.sigma_deg is not None
    assert (found.sigma_deg > PerceptionSettings().sigma_max_deg) == declined
