"""The segmenter fulfills the model contract, rejects networks that do not, and estimates a missing background."""

from pathlib import Path

import numpy as np
import pytest

from slipguard.errors import InputError, ModelError
from slipguard.perception.background import estimate_background
from slipguard.perception.segmenter import Segmenter, default_model_path
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit

CAMERA = GelCamera(SensorUnit(), seed=7)


TOUCH = GelView("ball", x_mm=0.5, y_mm=1.0, angle_deg=0.0, depth_mm=0.6)


CENTER = (70, 64)


"""Row and column of the ball at network resolution: 1 mm up and 0.5 mm right of the middle."""


UNTOUCHED = GelView("", depth_mm=-1.0)


def gel(seed: int = 0) -> np.ndarray:
    """The untouched gel with camera noise, (320, 240, 3) uint8."""
    CAMERA.reseed(seed)
    return CAMERA.draw(UNTOUCHED)


def with_ball(seed: int = 0) -> np.ndarray:
    """A ball pressed in above and right of the middle."""
    CAMERA.reseed(seed)
    return CAMERA.draw(TOUCH)


@pytest.fixture(scope="module")
def segmenter() -> Segmenter:
    return Segmenter()


def changed_model(tmp_path: Path, old: bytes, new: bytes) -> Path:
    data = default_model_path().read_bytes()
    assert len(old) == len(new)
    assert old in data
    path = tmp_path / "changed.onnx"
    path.write_bytes(data.replace(old, new))
    return path


def test_the_output_is_a_probability_at_network_size(segmenter: Segmenter) -> None:
    estimate = segmenter.segment(gel(1), gel(2))
    assert estimate.shape == (160, 120)
    assert estimate.dtype == np.float32
    assert estimate.min() >= 0.0
    assert estimate.max() <= 1.0
    assert segmenter.input_size == (120, 160)
    assert 0.0 < segmenter.threshold < 1.0


def test_a_ball_is_found_and_an_untouched_gel_has_no_contact(segmenter: Segmenter) -> None:
    background = gel(1)
    mask = segmenter.segment(with_ball(2), background) > segmenter.threshold
    rows, columns = np.nonzero(mask)
    assert mask.sum() > 500
    assert abs(rows.mean() - CENTER[0]) < 4
    assert abs(columns.mean() - CENTER[1]) < 4
    assert not (segmenter.segment(gel(3), background) > segmenter.threshold).any()


def test_a_new_background_replaces_the_remembered_one(segmenter: Segmenter) -> None:
    frame = with_ball(2)
    before = segmenter.segment(frame, gel(1))
    itself = segmenter.segment(frame, frame.copy())
    assert (before > segmenter.threshold).sum() > 500
    assert not (itself > segmenter.threshold).any()
    np.testing.assert_array_equal(segmenter.segment(frame, gel(1)), before)


def test_without_a_background_a_clear_press_is_still_found(segmenter: Segmenter) -> None:
    mask = segmenter.segment(with_ball(2), None) > segmenter.threshold
    row, column = CENTER
    assert mask[row - 8 : row + 8, column - 8 : column + 8].mean() > 0.9


def test_an_estimated_background_follows_the_glow_and_passes_under_a_press() -> None:
    glow, pressed = gel(1), with_ball(1)
    estimated = estimate_background(pressed).astype(int)
    assert estimated.shape == pressed.shape
    patch = np.s_[2 * CENTER[0] - 30 : 2 * CENTER[0] + 30, 2 * CENTER[1] - 30 : 2 * CENTER[1] + 30]
    assert np.abs(estimated - pressed)[patch].mean() > 1.5 * np.abs(estimated - glow)[patch].mean()
    smooth = np.full((320, 240, 3), (90, 60, 140), np.uint8)
    np.testing.assert_allclose(estimate_background(smooth), smooth, atol=1)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320, 3), np.uint8),
        np.zeros((320, 240), np.uint8),
        np.full((320, 240, 3), np.nan, np.float32),
        np.zeros((1, 1, 3), np.uint8),
    ],
    ids=["on its side", "gray", "NaN", "one pixel"],
)
def test_other_images_are_rejected_with_a_message(segmenter: Segmenter, image: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"\(320, 240, 3\)"):
        segmenter.segment(image, None)
    with pytest.raises(InputError, match="background image"):
        segmenter.segment(gel(), image)


def test_missing_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"none\.onnx: no such file"):
        Segmenter(tmp_path / "none.onnx")


@pytest.mark.parametrize("keep", [0, 40, 20_000, -200])
def test_corrupt_model_is_one_line(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "cut.onnx"
    path.write_bytes(default_model_path().read_bytes()[:keep])
    with pytest.raises(ModelError) as caught:
        Segmenter(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"background_known", b"background_knewn", "background_knewn"),
        (b"slipguard_contract", b"slipguard_contrakt", "slipguard_contract missing"),
        (b"slipguard_contract\x12\x011", b"slipguard_contract\x12\x019", "contract 9"),
        (b"threshold\x12\x030.5", b"threshold\x12\x037.5", "threshold is '7.5'"),
        (b"threshold\x12\x030.5", b"threshold\x12\x03abc", "threshold is 'abc'"),
    ],
    ids=["input", "metadata", "contract", "threshold range", "threshold text"],
)
def test_models_that_break_the_contract_are_rejected(tmp_path: Path, old: bytes, new: bytes, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        Segmenter(changed_model(tmp_path, old, new))


@pytest.mark.parametrize("value", [np.nan, 1.5, -0.2])
def test_an_output_that_is_no_probability_is_an_error(value: float) -> None:
    class Broken:
        def run(self, names: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
            return [np.full((1, 1, 160, 120), value, np.float32)]

    segmenter = Segmenter()
    segmenter._session = Broken()
    with pytest.raises(ModelError, match=r"expected a probability in 0\.\.1"):
        segmenter.segment(gel(), gel(1))
