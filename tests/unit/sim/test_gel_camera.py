"""The rendered gel: properties that its images must and must not have, with and without the effects of a soft gel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.sim.catalogue import find_object
from slipguard.sim.contact_label import PRESS_SHARE, label
from slipguard.sim.gel_camera import GelCamera, GelTruth
from slipguard.sim.gel_effects import GelEffects, GelMemory
from slipguard.sim.gel_view import GelView, decode_view, encode_view
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.imprint import Imprinter
from slipguard.sim.sensor_unit import NOISE_STD_BGR, LightChange, SensorUnit, random_unit
from slipguard.sim.shapes import grooves

NOTHING = GelView(object_name="", depth_mm=-1.0)
GRAY = np.full((320, 240, 3), 90, np.uint8)
QUIET = replace(SensorUnit(), noise_bgr=(0.0, 0.0, 0.0), stripe_bgr=(0.0, 0.0, 0.0), dome_share=0.0)


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


def test_light_changes_the_frame_and_not_the_reference() -> None:
    camera = GelCamera(QUIET, GRAY)
    camera.set_light(LightChange(1.0, (5.0, 0.0, -5.0), (0.0, 3.0, 0.0), (0.0, 0.0, 2.0)))
    off = camera.draw(NOTHING).astype(float) - camera.no_contact()
    assert off[160, 120] == pytest.approx([5.0, 0.0, -5.0], abs=0.6)
    assert off[160, 239, 1] - off[160, 0, 1] == pytest.approx(6.0, abs=1.1)
    assert off[0, 120, 2] - off[319, 120, 2] == pytest.approx(4.0, abs=1.1)
    assert np.array_equal(camera.no_contact(), GRAY)


@pytest.mark.parametrize("field", ["x_mm", "angle_deg", "depth_mm", "rate_deg_s"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_rejected(field: str, value: float) -> None:
    view = replace(GelView("bar", depth_mm=0.5), **{field: value})
    with pytest.raises(InputError, match="must be finite"):
        GelCamera(QUIET).draw(view)


def test_a_background_of_another_shape_is_rejected() -> None:
    with pytest.raises(InputError, match="240 wide"):
        GelCamera(QUIET, np.zeros((240, 320, 3), np.uint8))


def gel_mm(view: GelView, unit: SensorUnit = QUIET) -> NDArray[np.float32]:
    return GelCamera(unit, GRAY).draw_with_truth(view).displacement_mm


def center_mm(pressed: NDArray[np.generic]) -> tuple[float, float]:
    """Center of a field from the image center, right and up."""
    rows, columns = np.mgrid[0:320, 0:240]
    total = pressed.sum()
    right = float((pressed * (columns - 119.5)).sum() / total)
    return right / QUIET.px_per_mm, float(-(pressed * (rows - 159.5)).sum() / total) / QUIET.px_per_mm


@pytest.mark.parametrize("name", ["bar", "banana", "coin"])
def test_without_deviations_the_imprint_is_that_of_a_rigid_object(name: str) -> None:
    view = GelView(name, 0.7, -0.4, 25.0, 0.7)
    imprinter = Imprinter(SensorUnit(), GRAY)
    plain, neutral = imprinter.imprint(view, 0.008), imprinter.imprint(replace(view, effects=GelEffects()), 0.008)
    assert plain is not None
    assert neutral is not None
    assert plain.window == neutral.window
    assert np.abs(plain.change_bgr - neutral.change_bgr).max() < 1.5


def test_a_rolling_object_touches_on_the_side_that_comes_closer() -> None:
    view = GelView("banana", depth_mm=0.7)
    level = center_mm(gel_mm(view))
    for pitch_deg in (5.0, -5.0):
        moved = center_mm(gel_mm(replace(view, effects=GelEffects(pitch_deg=pitch_deg))))
        assert np.sign(moved[0] - level[0]) == np.sign(pitch_deg)
        assert abs(moved[0] - level[0]) > 1.0


def test_the_sticking_middle_follows_and_the_rim_lags() -> None:
    """A star of grooves: its phase shows the rotation at each radius."""
    raster = HeightRaster.of(lambda u, v: -grooves(np.arctan2(v, u), 2 * np.pi / 6, 0.4))
    effects = GelEffects(twist_deg=10.0, stick_mm=2.5)
    shown = GelCamera(QUIET, GRAY).draw_with_truth(GelView("", 0.0, 0.0, 0.0, 0.5, effects=effects), raster=raster)
    rows, columns = np.mgrid[0:320, 0:240]
    right, up = (columns - 119.5) / QUIET.px_per_mm, (159.5 - rows) / QUIET.px_per_mm
    radius, angle = np.hypot(right, up), np.arctan2(up, right)
    seen = []
    for r in (1.6, 5.8):
        ring = np.abs(radius - r) < 0.2
        phase = np.angle((shown.displacement_mm[ring] * np.exp(-6j * angle[ring])).sum())
        seen.append(-float(np.degrees(phase)) / 6.0)
    assert abs(seen[0]) < 1.0
    assert seen[1] == pytest.approx(-10.0, abs=1.0)


def test_the_gel_remembers_and_forgets() -> None:
    camera = GelCamera(QUIET, GRAY, memory=GelMemory(0.3, 0.1))
    pressed, gone = GelView("bar", depth_mm=0.6), GelView("", depth_mm=-1.0)
    camera.draw(pressed)
    camera.settle()
    shown = [np.abs(camera.draw(gone).astype(float) - GRAY).mean() for _ in range(31)]
    whole = np.abs(GelCamera(QUIET, GRAY).draw(pressed).astype(float) - GRAY).mean()
    assert shown[0] == pytest.approx(0.3 * whole, rel=0.1)
    assert shown[6] == pytest.approx(np.exp(-1.0) * shown[0], rel=0.15)
    assert shown[30] < 0.05 * shown[0]


@pytest.mark.parametrize(
    "effects", [GelEffects(pitch_deg=13.0), GelEffects(twist_deg=np.nan), GelEffects(stick_mm=0.0)]
)
def test_impossible_effects_are_rejected(effects: GelEffects) -> None:
    with pytest.raises(InputError):
        GelCamera(QUIET, GRAY).draw(GelView(find_object("bar").name, depth_mm=0.5, effects=effects))


numbers = st.floats(-1e6, 1e6)


@given(st.lists(numbers, min_size=7, max_size=7), st.tuples(numbers, numbers, numbers), st.booleans())
def test_an_encoded_view_is_decoded(values: list[float], light: tuple[float, float, float], there: bool) -> None:
    view = GelView("object" if there else "", *values)
    image = encode_view(view, light, 3)
    assert image.shape == (320, 240, 3)
    assert image.dtype == np.uint8
    assert decode_view(image) == (view, light)


def test_two_of_the_same_view_differ_in_every_row() -> None:
    one, other = (encode_view(GelView(""), (0.0, 0.0, 0.0), number) for number in (1, 2))
    assert (one != other).any(axis=(1, 2)).all()


def truth(displacement_mm: np.ndarray, press_mm: float) -> GelTruth:
    image = np.zeros((320, 240, 3), np.uint8)
    return GelTruth(image, displacement_mm >= press_mm, displacement_mm.astype(np.float32), press_mm)


def cone(press_mm: float, slope_mm_px: float = 0.02) -> np.ndarray:
    y, x = np.mgrid[0:320, 0:240]
    return np.maximum(press_mm - slope_mm_px * np.hypot(x - 120, y - 160), 0.0)


def test_the_label_ends_where_the_displacement_reaches_the_share() -> None:
    mask = label(truth(cone(1.0), 1.0))
    radius_px = np.sqrt(mask.sum() / np.pi)
    assert mask.dtype == np.uint8
    assert radius_px == pytest.approx((1.0 - PRESS_SHARE) / 0.02, abs=1.0)


def test_gaps_between_ribs_are_closed_but_two_things_apart_stay_two() -> None:
    ribs = np.zeros((320, 240))
    ribs[100:200, 60:70] = ribs[100:200, 85:95] = 0.8
    assert label(truth(ribs, 0.8))[150, 60:95].all()
    apart = np.zeros((320, 240))
    apart[100:200, 40:60] = apart[100:200, 160:180] = 0.8
    assert not label(truth(apart, 0.8))[150, 80:140].any()


def test_nothing_visible_is_no_contact() -> None:
    assert not label(truth(np.zeros((320, 240)), 0.0)).any()
    assert not label(truth(cone(0.01), 0.01)).any()
    assert not label(truth(np.full((320, 240), 0.05), 1.0)).any(), "the skirt of something outside the image"
