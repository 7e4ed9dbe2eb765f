"""Torn frames: found at every line of rows and columns where the captures differ, and nowhere else."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.control.params import GuardTuning
from slipguard.devices import Frame
from slipguard.errors import FrameTorn
from slipguard.perception.image_quality import REFUSED_MAX_S, find_tear
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim import shapes
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.sensor_unit import SensorUnit

Image = NDArray[np.uint8]
STEPPED = HeightRaster.of(lambda u, v: shapes.plateau(shapes.box(u, v, 14.0, 2.5), 0.02))
"""A box with vertical walls, wider than the gel."""


def camera(seed: int = 0, psf_px: float = 2.2) -> GelCamera:
    return GelCamera(replace(SensorUnit(), psf_px=psf_px), seed=seed)


def wrench(gel: GelCamera, angle_deg: float) -> Image:
    return gel.draw(GelView("wrench", 0.4, -0.3, angle_deg, 0.6))


def spliced(first: Image, second: Image, along: str, line: int) -> Image:
    image = second.copy()
    part = (slice(0, line),) if along == "row" else (slice(None), slice(0, line))
    image[part] = first[part]
    return image


@pytest.mark.parametrize("along", ["row", "column"])
def test_a_tear_through_a_moving_contact_is_found_at_its_line(along: str) -> None:
    gel = camera()
    previous, first, second = wrench(gel, 30.0), wrench(gel, 30.0), wrench(gel, 36.0)
    lines = range(100, 220, 10) if along == "row" else range(80, 160, 10)
    found = [find_tear(spliced(first, second, along, line), previous) for line in lines]
    assert found == [f"{along} {line}" for line in lines]


def test_both_parts_may_be_newer_than_the_previous_frame() -> None:
    gel = camera()
    previous, first, second = wrench(gel, 30.0), wrench(gel, 36.0), wrench(gel, 42.0)
    assert find_tear(spliced(first, second, "column", 120), previous) == "column 120"


@pytest.mark.parametrize("angle_deg", [0.0, 90.0])
@pytest.mark.parametrize("psf_px", [0.8, 2.2])
def test_straight_edges_along_the_lines_are_no_tears(angle_deg: float, psf_px: float) -> None:
    gel = camera(psf_px=psf_px)
    images = [gel.draw(GelView(""))]
    for k in range(6):  # the box appears at once, slides across its edges at 0.3 m/s, and is gone
        pose = GelView("box", 0.7 * k - 2.0, 0.7 * k - 2.0, angle_deg, 0.9, 40.0, 40.0)
        images.append(gel.draw(pose, raster=STEPPED))
    images.append(images[0])
    assert not any(find_tear(now, before) for before, now in pairwise(images))


def test_a_fast_rotation_is_no_tear() -> None:
    gel = camera()
    images = [gel.draw(GelView("wrench", angle_deg=25.0 * k, depth_mm=0.6, rate_deg_s=1500.0)) for k in range(12)]
    assert not any(find_tear(now, before) for before, now in pairwise(images))


def test_flickering_columns_and_steps_of_the_light_are_no_tears() -> None:
    gel = camera()
    image = wrench(gel, 30.0).astype(np.int16)
    flicker = np.random.default_rng(0).integers(-6, 7, (1, 240, 3))
    brighter = np.where(np.arange(240) < 100, 0, 12)[:, np.newaxis]
    for change in (flicker, flicker + brighter):
        assert find_tear(np.clip(image + change, 0, 255).astype(np.uint8), wrench(gel, 30.0)) is None


def test_captures_that_do_not_differ_need_no_rejection() -> None:
    gel = camera()
    assert find_tear(spliced(wrench(gel, 30.0), wrench(gel, 30.0), "column", 120), wrench(gel, 30.0)) is None


def test_images_without_noise_are_no_tears() -> None:
    flat = np.full((320, 240, 3), 90, np.uint8)
    assert find_tear(flat, flat) is None
    assert find_tear(flat + np.uint8(40), flat) is None


def test_half_size_frames_are_tested_as_well() -> None:
    gel = camera()
    first, second = wrench(gel, 30.0), wrench(gel, 40.0)
    torn = spliced(first[::2, ::2], second[::2, ::2], "row", 80)
    assert find_tear(torn, wrench(gel, 30.0)[::2, ::2]) == "row 80"


def test_the_tear_of_an_earlier_frame_is_not_held_against_a_good_one() -> None:
    gel = camera()
    torn = spliced(wrench(gel, 30.0), wrench(gel, 36.0), "column", 120)
    assert find_tear(wrench(gel, 30.0), torn) is None
    assert find_tear(wrench(gel, 36.0), torn) is None


def test_the_pipeline_refuses_a_torn_frame_and_goes_on_with_the_next() -> None:
    gel = camera()
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), gel.no_contact(), (2.9, 1.5, 2.4), 18.5)

    def seen(image: Image, k: int) -> float | None:
        return pipeline.process(Frame(image, k / 60.0, k)).rotation_deg

    for k in range(12):
        seen(wrench(gel, 30.0), k)
    with pytest.raises(FrameTorn, match="frame 12 is torn at column 120"):
        seen(spliced(wrench(gel, 30.0), wrench(gel, 36.0), "column", 120), 12)
    assert seen(wrench(gel, 33.0), 13) == pytest.approx(3.0, abs=0.6)


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_a_sharp_line_that_stays_is_accepted_before_the_frames_time_out(fps: float) -> None:
    gel = camera()
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), gel.no_contact(), (2.9, 1.5, 2.4), 18.5)
    for k in range(12):
        pipeline.process(Frame(wrench(gel, 30.0), 10.0 + k / 60.0, k))
    since_s, accepted_s = 10.0 + 11 / 60.0, []
    for k in range(1, 16):
        with contextlib.suppress(FrameTorn):
            torn = spliced(wrench(gel, 30.0), wrench(gel, 45.0), "column", 120)
            pipeline.process(Frame(torn, since_s + k / fps, 12 + k))
            accepted_s.append(k / fps)
    assert REFUSED_MAX_S <= accepted_s[0] < REFUSED_MAX_S + 1.0 / fps
    assert GuardTuning().frames_timeout_s >= 2.0 * REFUSED_MAX_S
