"""The segmenter keeps its contract, refuses what does not, and guesses a background where none is known."""

from pathlib import Path

import numpy as np
import pytest

from slipguard.errors import InputError, ModelError
from slipguard.perception.background import guess_background
from slipguard.perception.segment import Segmenter, default_model_path


def gel(seed: int = 0) -> np.ndarray:
    """A smooth coloured glow with camera noise, (320, 240, 3) uint8."""
    y, x = np.mgrid[0:320, 0:240].astype(np.float32)
    glow = np.stack([90 - 40 * y / 320, 60 + 60 * x / 240, 140 - 80 * x / 240], -1)
    noise = np.random.default_rng(seed).normal(0.0, 1.5, glow.shape)
    return np.clip(glow + noise, 0, 255).astype(np.uint8)


def with_ball(image: np.ndarray, strength: float = 70.0) -> np.ndarray:
    """A press by a ball: a disc whose colours follow the slope under lamps at 30, 150 and 270 degrees."""
    y, x = np.mgrid[0:320, 0:240].astype(np.float32)
    right, up = (x - 120) / 38, -(y - 150) / 38
    inside = np.exp(-(np.maximum(np.hypot(right, up) - 0.9, 0) ** 2) / 0.02)
    change = [strength * inside * (right * np.cos(a) + up * np.sin(a)) for a in np.radians([270.0, 150.0, 30.0])]
    return np.clip(image + np.stack(change, -1), 0, 255).astype(np.uint8)


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


def test_answer_is_a_probability_at_network_size(segmenter: Segmenter) -> None:
    answer = segmenter.segment(gel(1), gel(2))
    assert answer.shape == (160, 120)
    assert answer.dtype == np.float32
    assert answer.min() >= 0.0
    assert answer.max() <= 1.0
    assert segmenter.input_size == (120, 160)
    assert 0.0 < segmenter.threshold < 1.0


def test_a_ball_is_found_where_it_is_and_nothing_where_there_is_none(segmenter: Segmenter) -> None:
    background = gel(1)
    mask = segmenter.segment(with_ball(gel(2)), background) > segmenter.threshold
    rows, columns = np.nonzero(mask)
    assert mask.sum() > 500
    assert abs(rows.mean() - 75) < 4
    assert abs(columns.mean() - 60) < 4
    assert not (segmenter.segment(gel(3), background) > segmenter.threshold).any()


def test_a_new_background_replaces_the_remembered_one(segmenter: Segmenter) -> None:
    frame = with_ball(gel(2))
    before = segmenter.segment(frame, gel(1))
    itself = segmenter.segment(frame, frame.copy())
    assert (before > segmenter.threshold).sum() > 500
    assert not (itself > segmenter.threshold).any()
    np.testing.assert_array_equal(segmenter.segment(frame, gel(1)), before)


def test_without_a_background_a_clear_press_is_still_found(segmenter: Segmenter) -> None:
    mask = segmenter.segment(with_ball(gel(2)), None) > segmenter.threshold
    assert mask[75 - 8 : 75 + 8, 60 - 8 : 60 + 8].mean() > 0.9


def test_guessed_background_follows_the_glow_and_passes_under_a_press() -> None:
    glow, pressed = gel(1), with_ball(gel(1))
    guess = guess_background(pressed).astype(int)
    assert guess.shape == pressed.shape
    assert np.abs(guess - glow).mean() < 3.0
    assert np.abs(guess - pressed)[130:170, 90:150].mean() > 2.0 * np.abs(guess - glow)[130:170, 90:150].mean()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320, 3), np.uint8),
        np.zeros((320, 240), np.uint8),
        np.full((320, 240, 3), np.nan, np.float32),
        np.zeros((1, 1, 3), np.uint8),
    ],
    ids=["on its side", "grey", "NaN", "one pixel"],
)
def test_other_images_are_refused_in_words(segmenter: Segmenter, image: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"\(320, 240, 3\) is needed"):
        segmenter.segment(image, None)
    with pytest.raises(InputError, match="no-contact image"):
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
def test_models_that_break_the_contract_are_refused(tmp_path: Path, old: bytes, new: bytes, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        Segmenter(changed_model(tmp_path, old, new))


@pytest.mark.parametrize("value", [np.nan, 1.5, -0.2])
def test_an_output_that_is_no_probability_is_an_error(value: float) -> None:
    class Broken:
        def run(self, names: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
            return [np.full((1, 1, 160, 120), value, np.float32)]

    segmenter = Segmenter()
    segmenter._session = Broken()
    with pytest.raises(ModelError, match=r"a probability in 0\.\.1 is needed"):
        segmenter.segment(gel(), gel(1))
