"""The shipped network on real DIGIT frames, through `slipguard measure`; needs the recordings, never committed."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from real_backgrounds import no_contact_frames, stale

from slipguard.cli.measure import ReferenceChoice, measure
from slipguard.datasets.mask_scores import iou
from slipguard.devices import Frame
from slipguard.perception.background import DeadLines
from slipguard.perception.image_quality import LIMITS, pixel_figures
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from tests.campaigns.real_frames import RealFrame, real_frames

pytestmark = pytest.mark.real


def masks_of(paths: list[Path], background: Path | None, out: Path, independent: bool) -> dict[str, np.ndarray]:
    """Contact masks by stem, as `slipguard measure --masks` writes them."""
    measure(
        paths,
        background=background,
        masks=out,
        plot=None,
        json=True,
        independent=independent,
        reference=ReferenceChoice.stable,
        model=None,
        estimator=None,
    )
    return {path.stem: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127 for path in out.glob("*.png")}


def mean_iou(frames: list[RealFrame], masks: dict[str, np.ndarray]) -> float:
    scores = [iou(masks[frame.name], frame.mask) for frame in frames]
    print(f"{len(scores)} frames, mean IoU {np.mean(scores):.3f}, lowest {np.min(scores):.3f}")
    return float(np.mean(scores))


def of(real_data: Path, group: str, split: str) -> list[RealFrame]:
    return [frame for frame in real_frames(real_data) if frame.group == group and frame.split in split]


@pytest.mark.parametrize("split", ["tune", "test"])
def test_ball_presses(real_data: Path, tmp_path: Path, split: str) -> None:
    folder = real_data / "taxim_sphere"
    frames = of(real_data, "taxim_sphere", split)
    assert len(frames) == 15
    files = [folder / f"{frame.name}.png" for frame in frames]
    assert mean_iou(frames, masks_of(files, folder / "background.png", tmp_path, independent=True)) >= 0.84


@pytest.mark.parametrize("split", ["tune", "test"])
def test_indenter_video(real_data: Path, tmp_path: Path, split: str) -> None:
    folder = real_data / "anytouch2_force2"
    frames = of(real_data, "anytouch2_force2", split)
    assert len(frames) > 20
    files = [folder / "frames" / f"{frame.name}.png" for frame in frames]
    assert mean_iou(frames, masks_of(files, folder / "background.png", tmp_path, independent=False)) >= 0.88


def test_a_frame_of_the_source_paper_without_its_background(real_data: Path, tmp_path: Path) -> None:
    frames = of(real_data, "aurova", "test")
    found = masks_of([real_data / "aurova" / "frame.png"], None, tmp_path, independent=True)
    # The faint lower third of a broad, smooth bulge is missed.
    assert mean_iou(frames, found) >= 0.68


def test_no_contact_is_reported_on_untouched_gels(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    days = 5
    frames = no_contact_frames(real_data, days)
    assert len(frames) == 6 * days
    for number, frame in enumerate(frames):
        assert frame.background is not None
        background, image = tmp_path / f"unit-{number}.png", tmp_path / f"{frame.name}.png"
        cv2.imwrite(str(background), frame.background)
        cv2.imwrite(str(image), frame.image)
        masks_of([image], background, tmp_path / "masks", independent=True)
        said = json.loads(capsys.readouterr().out)
        assert said["contact"] is False, f"{frame.name}: {said['contact_area_px']} px called contact"


@pytest.mark.parametrize("known", [True, False])
def test_untouched_gels_show_no_contact_with_a_stale_background_image_or_none(real_data: Path, known: bool) -> None:
    """Half of the frames are of units on which the limit was not chosen (the last three)."""
    rng = np.random.default_rng(16)
    segmenter, frames, false_contacts = Segmenter(), 0, 0
    for path in sorted((real_data / "backgrounds").glob("*.png")):
        background = cv2.imread(str(path))
        for image in [background, *(stale(background, rng) for _ in range(9))]:
            pipeline = Pipeline(segmenter, PerceptionSettings(), background if known else None, None, 18.5)
            frames += 1
            false_contacts += pipeline.process(Frame(image, 0.0, frames)).contact
    print(f"{false_contacts} of {frames} untouched gels show a contact")
    assert frames == 60
    assert false_contacts <= 0.1 * frames if known else false_contacts == 0


@pytest.mark.parametrize("group", ["taxim_sphere", "anytouch2_force2"])
@pytest.mark.parametrize("split", ["tune", "test"])
def test_masks_without_a_background_image(real_data: Path, group: str, split: str) -> None:
    scores = []
    for frame in of(real_data, group, split):
        pipeline = Pipeline(Segmenter(), PerceptionSettings(), None, None, 18.5)
        pipeline.process(Frame(frame.image, 0.0, 0))
        scores.append(iou(pipeline.last_mask > 0, frame.mask))
    print(f"{group}, {split}: {len(scores)} frames, mean IoU {np.mean(scores):.3f}")
    assert np.mean(scores) >= 0.75


def test_no_real_gel_has_a_stuck_line(real_data: Path) -> None:
    frame_images = [cv2.imread(str(path)) for path in sorted(real_data.glob("**/*.png")) if "masks" not in path.parts]
    frames = [
        frame_image for frame_image in frame_images if frame_image is not None and frame_image.shape == (320, 240, 3)
    ]
    assert len(frames) > 50
    assert all(DeadLines(frame).interpolate(frame) is frame for frame in frames)


def test_no_real_frame_is_called_coarse_even_as_a_camera_compresses_it(real_data: Path) -> None:
    paths = [path for path in sorted(real_data.rglob("*.png")) if "mask" not in f"{path.parent.name} {path.stem}"]
    images = [image for path in paths if (image := cv2.imread(str(path))).shape == (320, 240, 3)]
    assert len(images) >= 90
    packed = [cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 75])[1], 1) for image in images]
    found = [
        (k, what)
        for k, image in enumerate(images + packed)
        for what, value in pixel_figures(image)
        if LIMITS[what].is_beyond(value)
    ]
    assert not found
