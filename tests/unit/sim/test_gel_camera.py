"""The rendered gel: properties that its images must and must not have."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.imprint import Imprinter
from slipguard.sim.sensor_unit import NOISE_STD_BGR, LightChange, SensorUnit, random_unit
from slipguard.sim.shapes import sphere

NOTHING = GelView(object_name="", depth_mm=-1.0)
GRAY = np.full((320, 240, 3), 90, np.uint8)
QUIET = replace(SensorUnit(), noise_bgr=(0.0, 0.0, 0.0), stripe_bgr=(0.0, 0.0, 0.0), dome_share=0.0)


def change(unit: SensorUnit, view: GelView, raster: HeightRaster | None = None) -> NDArray[np.float64]:
    """Drawn minus no contact, without noise."""
    camera = GelCamera(unit, GRAY)
    return camera.draw(view, raster=raster).astype(float) - camera.no_contact()


def axis_deg(mask: NDArray[np.bool_]) -> float:
    """Orientation of a patch as a viewer sees it, counter-clockwise from the right."""
    rows, columns = np.nonzero(mask)
    x, y = columns - columns.mean(), -(rows - rows.mean())
    return float(np.degrees(0.5 * np.arctan2(2 * (x * y).mean(), (x * x).mean() - (y * y).mean())))


def test_the_same_seed_gives_the_same_images() -> None:
    views = [NOTHING, GelView("bar", depth_mm=0.6), GelView("bar", angle_deg=5.0, depth_mm=0.7, rate_deg_s=200.0)]

    def film(seed: int) -> NDArray[np.uint8]:
        camera = GelCamera(random_unit(np.random.default_rng(7)), seed=seed)
        return np.stack([camera.draw(view) for view in views])

    assert np.array_equal(film(3), film(3))
    assert not np.array_equal(film(3), film(4))


def test_draw_and_draw_with_truth_give_the_same_image() -> None:
    view = GelView("key", x_mm=1.0, angle_deg=20.0, depth_mm=0.8)
    unit = SensorUnit()
    assert np.array_equal(GelCamera(unit, seed=2).draw(view), GelCamera(unit, seed=2).draw_with_truth(view).image)


def test_without_contact_the_image_is_the_background_and_noise() -> None:
    camera = GelCamera(SensorUnit(), GRAY, seed=1)
    truth = camera.draw_with_truth(replace(NOTHING, object_name="bar"))
    assert not truth.contact.any()
    assert truth.press_mm == 0.0
    assert float(truth.displacement_mm.max()) == 0.0
    off = truth.image.astype(float) - camera.no_contact()
    assert np.abs(off.mean(axis=(0, 1))).max() < 0.5
    assert np.abs(off).max() < 25


def test_noise_has_the_measured_size_and_correlation() -> None:
    camera = GelCamera(replace(SensorUnit(), stripe_bgr=(0.0, 0.0, 0.0)), GRAY, seed=5)
    noise = np.stack([camera.draw(NOTHING) for _ in range(8)]).astype(float) - GRAY
    assert noise.std(axis=(0, 1, 2)) == pytest.approx(NOISE_STD_BGR, rel=0.04)
    for channel in range(3):
        plane = noise[..., channel]
        along = np.corrcoef(plane[:, :, 1:].ravel(), plane[:, :, :-1].ravel())[0, 1]
        down = np.corrcoef(plane[:, 1:].ravel(), plane[:, :-1].ravel())[0, 1]
        assert (along, down) == pytest.approx((0.65, 0.65), abs=0.04)
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.05


def test_a_rotation_is_counter_clockwise_and_y_is_up() -> None:
    camera = GelCamera(QUIET)
    level = camera.draw_with_truth(GelView("bar", depth_mm=0.6)).contact
    rotated = camera.draw_with_truth(GelView("bar", angle_deg=30.0, depth_mm=0.6)).contact
    assert axis_deg(level) == pytest.approx(0.0, abs=0.3)
    assert axis_deg(rotated) == pytest.approx(30.0, abs=0.3)
    moved = camera.draw_with_truth(GelView("ring", x_mm=1.0, y_mm=2.0, depth_mm=0.6)).contact
    rows, columns = np.nonzero(moved)
    assert columns.mean() - 119.5 == pytest.approx(1.0 * QUIET.px_per_mm, abs=1.0)
    assert 159.5 - rows.mean() == pytest.approx(2.0 * QUIET.px_per_mm, abs=1.0)


def test_each_light_brightens_the_slope_that_faces_it() -> None:
    """Blue from below, green from the upper left, red from the upper right."""
    unit = replace(QUIET, crosstalk=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), shadow=0.0)
    ball = HeightRaster.of(lambda u, v: sphere(u, v, 2.35), 4.0)
    drawn = change(unit, GelView("", depth_mm=1.0), ball)
    rows, columns = np.mgrid[0:320, 0:240]
    for channel, azimuth_deg in enumerate((270.0, 150.0, 30.0)):
        bright = np.maximum(drawn[..., channel], 0.0)
        x = (bright * (columns - 119.5)).sum() / bright.sum()
        y = -(bright * (rows - 159.5)).sum() / bright.sum()
        # The near side of a bump faces the light; pressed towards the camera, a ball is a bump in the gel.
        seen_deg = float(np.degrees(np.arctan2(y, x))) % 360
        assert abs((seen_deg - azimuth_deg + 180) % 360 - 180) < 25, (channel, seen_deg)


def test_a_deeper_press_touches_more() -> None:
    camera = GelCamera(QUIET)
    truths = [camera.draw_with_truth(GelView("ball", depth_mm=depth)) for depth in (0.2, 0.5, 0.9, 1.4)]
    areas = [int(truth.contact.sum()) for truth in truths]
    assert areas == sorted(areas)
    assert areas[-1] > 3 * areas[0] > 0
    for truth in truths:
        assert float(truth.displacement_mm.max()) == pytest.approx(truth.press_mm, rel=0.05)
        assert (truth.displacement_mm >= 0).all()


@pytest.mark.parametrize("name", ["bar", "ball", "screwdriver", "pins", "rod"])
@pytest.mark.parametrize(("x_mm", "y_mm", "rate_deg_s"), [(0.5, -1.0, 0.0), (5.5, 7.0, 0.0), (-2.0, 1.0, 250.0)])
def test_drawing_a_part_equals_drawing_the_whole(name: str, x_mm: float, y_mm: float, rate_deg_s: float) -> None:
    imprinter = Imprinter(SensorUnit(), GRAY)
    view = GelView(name, x_mm, y_mm, 35.0, find_object(name).press_mm, rate_deg_s=rate_deg_s)
    images = []
    for whole in (False, True):
        image = np.zeros((320, 240, 3), np.float32)
        imprint = imprinter.imprint(view, 0.008, whole=whole)
        assert imprint is not None
        image[imprint.window] = imprint.change_bgr
        images.append(image)
    assert np.abs(images[0] - images[1]).max() < 1.0


def test_motion_smears_along_the_motion() -> None:
    still = change(QUIET, GelView("bar", depth_mm=0.6))
    # Sideways motion of a level bar blurs its short ends, not its long sides.
    moving = change(QUIET, GelView("bar", depth_mm=0.6, vx_mm_s=60.0))
    middle, end = np.s_[110:210, 110:130], np.s_[110:150, 190:210]
    assert np.abs(moving[middle] - still[middle]).max() < 3.0
    sharp = [np.abs(np.diff(image[160, 180:], axis=0)).max() for image in (still, moving)]
    assert sharp[1] < 0.8 * sharp[0]
    rotating = change(QUIET, GelView("bar", depth_mm=0.6, rate_deg_s=900.0))
    assert np.abs(rotating[middle] - still[middle]).max() < 6.0
    assert np.abs(rotating[end] - still[end]).max() > 10.0


def test_a_slow_rotation_is_rendered_without_blur() -> None:
    fast = change(QUIET, GelView("cross", angle_deg=10.0, depth_mm=0.6, rate_deg_s=100.0))
    still = change(QUIET, GelView("cross", angle_deg=10.0, depth_mm=0.6))
    assert np.corrcoef(fast.ravel(), still.ravel())[0, 1] > 0.95


def test_light_changes_the_frame_and_not_the_reference() -> None:
    camera = GelCamera(QUIET, GRAY)
    camera.set_light(LightChange(1.0, (5.0, 0.0, -5.0), (0.0, 3.0, 0.0), (0.0, 0.0, 2.0)))
    off = camera.draw(NOTHING).astype(float) - camera.no_contact()
    assert off[160, 120] == pytest.approx([5.0, 0.0, -5.0], abs=0.6)
    assert off[160, 239, 1] - off[160, 0, 1] == pytest.approx(6.0, abs=1.1)
    assert off[0, 120, 2] - off[319, 120, 2] == pytest.approx(4.0, abs=1.1)
    assert np.array_equal(camera.no_contact(), GRAY)


def test_units_differ() -> None:
    views = GelView("ring", depth_mm=0.8)
    images = [GelCamera(random_unit(np.random.default_rng(seed))).draw(views).astype(float) for seed in range(4)]
    for k in range(3):
        assert np.abs(images[k] - images[k + 1]).mean() > 10


def test_half_of_the_units_carry_a_real_background() -> None:
    real = [np.full((320, 240, 3), level, np.uint8) for level in (40, 80)]
    units = [random_unit(np.random.default_rng(seed), real) for seed in range(60)]
    carried = [unit for unit in units if unit.background is not None]
    assert 18 <= len(carried) <= 42
    assert {int(unit.background[0, 0, 0]) for unit in carried if unit.background is not None} == {40, 80}
    assert np.array_equal(GelCamera(carried[0]).no_contact(), carried[0].background)


def test_procedural_backgrounds_are_smooth_and_use_the_range() -> None:
    for seed in range(10):
        image = GelCamera(random_unit(np.random.default_rng(seed))).no_contact()
        assert image.shape == (320, 240, 3)
        assert image.max() < 255
        assert image.mean() > 15
        fine = image.astype(np.float32) - cv2.GaussianBlur(image.astype(np.float32), (0, 0), 3.0)
        assert fine.std() < 4.0


def test_something_pressed_outside_the_frame_leaves_it_alone() -> None:
    assert np.array_equal(change(QUIET, GelView("ball", x_mm=12.0, depth_mm=1.0)), np.zeros((320, 240, 3)))
    assert np.array_equal(change(QUIET, GelView("ball", y_mm=-40.0, depth_mm=1.0)), np.zeros((320, 240, 3)))


@pytest.mark.parametrize("field", ["x_mm", "angle_deg", "depth_mm", "rate_deg_s"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_rejected(field: str, value: float) -> None:
    view = replace(GelView("bar", depth_mm=0.5), **{field: value})
    with pytest.raises(InputError, match="must be finite"):
        GelCamera(QUIET).draw(view)


def test_a_background_of_another_shape_is_rejected() -> None:
    with pytest.raises(InputError, match="240 wide"):
        GelCamera(QUIET, np.zeros((240, 320, 3), np.uint8))
