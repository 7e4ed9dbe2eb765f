"""Parts of the bench: grasps, results, comparison pipelines, thinning times, and reports of given figures."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from slipguard.bench import tables
from slipguard.bench.comparison_pipelines import (
    AxialRotation,
    BackgroundSubtraction,
    FrameNetwork,
    PaperPipeline,
    axis_of_points,
)
from slipguard.bench.effects import EffectErrors, effect_result
from slipguard.bench.holding import HoldingScene
from slipguard.bench.pipeline_results import GraspErrors, PipelineResults, errors_by_quarter, within_sigma_se
from slipguard.bench.pipelines import PEER_MODEL, BenchPipeline, network_files, with_small_network
from slipguard.bench.plot import draw_bench
from slipguard.bench.results import BenchReport, BenchRow, SkipResult, ThinningResult, pareto_front
from slipguard.bench.thinning_times import compare_thinning
from slipguard.datasets.mask_scores import dice
from slipguard.datasets.rendered_grasps import EMPTY_FRAMES, ROTATION_DEG, RenderedGrasp, render_grasp
from slipguard.devices import Frame
from slipguard.errors import ModelError
from slipguard.perception.segmenter import default_model_path

KEYS = [
    "name", "network", "estimator", "p50_ms", "p99_ms", "skipped_p50_ms", "turn_error_mean_deg",
    "turn_error_worst_object_deg", "declined_share", "dice", "iou", "frames", "sequences",
]  # fmt: skip
MORE_KEYS = {
    "mean_ms_per_frame_grasp", "round_textured_error_mean_deg", "round_plain_declined_share", "within_1_sigma",
    "within_2_sigma", "turn_error_sd_deg", "turn_error_p95_deg", "turn_error_by_quartile_deg", "stage_ms", "pareto",
    "cpu_s_per_minute_grasp", "within_1_sigma_se", "within_2_sigma_se", "turns", "turn_sequences",
}  # fmt: skip
PEER_PATH = default_model_path().with_name(PEER_MODEL)
PAPER_PATH = Path(__file__).resolve().parents[3] / "models" / "deeplabv3plus-resnet18.onnx"


def found() -> BenchReport:
    ours = BenchRow(
        "net + registration", "net", "registration", 3.0, 5.0, 0.3, 0.6, 1.2, 0.05, 0.95, math.nan, 700, 10,
        mean_ms_per_frame_grasp=0.7, turn_error_by_quartile_deg=(0.1, 0.2, 0.3, 0.4), pareto=True,
        stage_ms={"segment": (1.3, 1.5, 1.4), "thin": (0.3, 0.4, 0.1)},
    )  # fmt: skip
    peer = BenchRow("paper", "peer", "skeleton", 150.0, 160.0, None, None, None, None, None, None, 24, None,
               resolution="240×320", mean_ms_per_frame_grasp=150.0)  # fmt: skip
    plain = replace(ours, name="subtraction + pca", network="subtraction", estimator="pca", pareto=False)
    ratios = {"cv2": 5.0, "scikit-image thin": 20.0, "scikit-image skeletonize": 1.5}
    thin = [
        ThinningResult(size, 9, 1.0, ratios, {**ratios, "cv2": ratio}, 0) for size, ratio in (("a", 18.0), ("b", 5.0))
    ]
    slip = effect_result("partial slip", EffectErrors(5, [(0.5, 1.0), (9.0, 2.0)], [3.0] * 5, [7.0], [0.1, 0.5], 5), 1)
    skip = SkipResult("unchanged", True, 2.0, 1.4, 0.001, 0, "of 3600 frames")
    machine = {"processor": "test", "onnxruntime": "1", "opencv": "4"}
    return BenchReport(machine, (ours,), (peer, plain), ours.name, tuple(thin), (skip,), ("a note",), (slip,))


def test_the_json_has_the_public_keys_in_order_and_null_for_unknown_values() -> None:
    result = json.loads(json.dumps(found().as_json(), allow_nan=False))
    assert list(result)[:5] == ["machine", "pipelines", "peers", "default", "thinning_vs_cv2"]
    assert list(result["pipelines"][0])[: len(KEYS)] == list(result["peers"][0])[: len(KEYS)] == KEYS
    assert set(result["pipelines"][0]) > MORE_KEYS
    assert result["peers"][0]["turn_error_mean_deg"] is None
    assert result["pipelines"][0]["iou"] is None
    assert result["default"] == result["pipelines"][0]["name"]
    assert result["thinning_vs_cv2"] == 5.0
    [effect] = result["effects"]
    assert (effect["effect"], effect["n"], effect["mean_deg"], effect["worst_deg"]) == ("partial slip", 5, 4.75, 9.0)
    assert (effect["declined_share"], effect["within_1_sigma"], effect["within_2_sigma"]) == (0.6, 0.5, 0.5)
    assert (effect["beyond_3_sigma"], effect["beyond_4_sigma"], effect["error_over_sigma_p99"]) == (0.5, 0.5, 4.46)
    assert effect["shift_wrong_share"] == 0.5
    assert effect["zero"] == {"mean_deg": 3.0, "worst_deg": 3.0, "declined_share": 0.0}
    assert effect["paper_axis"] == {"mean_deg": 7.0, "worst_deg": 7.0, "declined_share": 0.8}


def test_the_tables_show_the_ratio_to_the_paper_and_the_plot_is_drawn(tmp_path: Path) -> None:
    console = Console(width=80, file=StringIO())
    bench = found()
    long = replace(bench.peers[0], name="the paper's pipeline: peer-deeplabv3plus-resnet18 240×320 + OpenCV thinning")
    console.print(*tables.bench_tables(replace(bench, peers=(long,))), *tables.notes(bench), *tables.skip_notes(bench))
    text = cast("StringIO", console.file).getvalue()
    assert "50.0" in text
    assert "default" in text
    assert "…" not in text
    for title in ("partial slip", "zero", "declined", "240×320", "skeletonize, ×", "ms per frame", "pixels unlike"):
        assert title in text
    assert "published, on a real cell" in " ".join(text.split())
    draw_bench(found(), tmp_path / "bench.png")
    assert (tmp_path / "bench.png").stat().st_size > 5_000


def test_times_are_compared_with_the_first_network_of_a_size_on_its_fastest_number_of_threads() -> None:
    bench = found()
    one, row = bench.peers[0], bench.pipelines[0]
    two = replace(one, name="paper, 2 threads", threads=2, p50_ms=90.0)
    other = replace(one, name="paper, other", network="quicker", p50_ms=10.0)
    small = replace(one, name="paper, small", resolution="120×160", p50_ms=60.0, turn_error_mean_deg=13.0)
    bench = replace(bench, peers=(small, one, two, other, bench.peers[1]))
    assert bench.reference("240×320") == two
    assert bench.reference("96×128") is None
    assert tables.cells_of(row, bench)[-2:] == ["30.0", "20.0"]
    assert tables.cells_of(row, replace(bench, peers=()))[-2:] == ["–", "–"]
    text = " ".join(tables.notes(bench))
    assert "90.00 ms on 2 threads, its fastest number (arbitrary weights, time only)" in text
    assert "60.00 ms on one thread, its fastest number (trained weights)" in text


def test_no_row_beats_a_row_of_the_pareto_front_in_time_and_error() -> None:
    base = found().pipelines[0]
    rows = [
        replace(base, name=name, mean_ms_per_frame_grasp=ms, turn_error_mean_deg=error)
        for name, ms, error in (("fast", 1.0, 2.0), ("good", 3.0, 0.5), ("bad", 3.0, 2.5), ("unknown", 0.1, None))
    ]
    assert pareto_front(rows) == {"fast", "good"}


def test_errors_are_split_into_quarters_from_easy_to_hard() -> None:
    grasps = [GraspErrors("bar", True, k / 8, 1, [(float(k), 0.0, None)]) for k in range(8)]
    assert errors_by_quarter(grasps[::-1]) == (0.5, 2.5, 4.5, 6.5)


def short(grasp: RenderedGrasp, count: int = 12) -> RenderedGrasp:
    start = next(index for index, shot in enumerate(grasp.shots) if shot.compared) - 8
    return replace(grasp, shots=grasp.shots[:2] + grasp.shots[start : start + count])


@pytest.mark.realtime
def test_results_of_one_grasp_give_a_row() -> None:
    grasp = short(render_grasp("key", 2, with_masks=True))
    pipeline_under_test = next(
        one for one in with_small_network(None, all_without_skipping=False) if one.estimator == "registration"
    )
    results = PipelineResults()
    results.run(pipeline_under_test.open(grasp), grasp, grasp.shots)
    row = results.row(pipeline_under_test, results, 1.0, 3.6)
    assert row.sequences == 1
    assert row.frames == sum(shot.compared for shot in grasp.shots)
    assert row.turn_error_mean_deg is not None
    assert row.turn_error_mean_deg < 3.0
    assert row.dice is not None
    assert row.dice > 0.85
    assert row.skipped_p50_ms is not None
    assert row.skipped_p50_ms < (row.p50_ms or 0.0)
    assert row.round_plain_declined_share is None
    assert {"gate", "segment"} < set(row.stage_ms)
    assert row.turns == len(results.grasps[0].found) > 0
    assert row.turn_sequences == 1


def test_background_subtraction_has_the_right_sign() -> None:
    grasp = render_grasp("bar", 2)
    compared = [shot for shot in grasp.shots if shot.compared]
    for axis in ("pca", "ellipse"):
        pipeline = BackgroundSubtraction(grasp.background, "ellipse" if axis == "ellipse" else "pca")
        estimates = [pipeline.process(shot.frame).rotation_deg for shot in compared]
        truth = [shot.rotation_deg - compared[0].rotation_deg for shot in compared]
        assert np.corrcoef(np.array(estimates, float), truth)[0, 1] > 0.95


def test_axes_are_counter_clockwise_and_rotate_by_less_than_90_degrees() -> None:
    steps = np.arange(50)
    assert axis_of_points(steps, -steps) == pytest.approx(45.0)
    rotation = AxialRotation()
    estimates = [
        rotation.estimate(Frame(np.zeros((1, 1, 3), np.uint8), 0.0, k), 80.0 + 15.0 * k, 900, "pca") for k in range(5)
    ]
    assert [one.rotation_deg for one in estimates] == pytest.approx([0.0, 15.0, 30.0, 45.0, 60.0])
    assert rotation.estimate(Frame(np.zeros((1, 1, 3), np.uint8), 0.0, 9), math.nan, 900, "pca").declined


def test_thinning_is_timed_and_equals_opencv() -> None:
    mask = np.zeros((320, 240), np.uint8)
    mask[60:260, 80:120] = 1
    sizes = compare_thinning([mask], repeats=1)
    assert len(sizes) == 3
    assert all(one.pixels_different_from_cv2 == 0 and one.ratios["cv2"] > 0 for one in sizes)


def test_the_holding_scene_has_60_frames_per_second() -> None:
    scene = HoldingScene()
    assert scene.sensor().background.shape == (320, 240, 3)
    first = [shot for _, shot in zip(range(40), scene.shots(), strict=False)]
    assert not first[0].contact
    assert first[-1].contact
    assert first[1].frame.captured_at_s == pytest.approx(1 / 60)


def test_a_rendered_grasp_is_repeatable_and_starts_without_rotation() -> None:
    one, again = render_grasp("battery", 3, with_masks=True), render_grasp("battery", 3)
    assert [s.rotation_deg for s in one.shots] == [s.rotation_deg for s in again.shots]
    np.testing.assert_array_equal(one.shots[20].frame.image, again.shots[20].frame.image)
    assert not any(s.contact for s in one.shots[:EMPTY_FRAMES])
    compared = [s for s in one.shots if s.compared]
    assert abs(compared[0].rotation_deg) < 6.0
    rotations = [s.rotation_deg for s in compared]
    assert ROTATION_DEG[0] <= abs(rotations[-1]) <= ROTATION_DEG[1]
    assert min(rotations) * max(rotations) < 0.0
    assert max(map(abs, rotations)) <= ROTATION_DEG[1]
    assert 1.0 <= one.growth < 2.0
    assert one.peak_deg_s > 0.0
    assert all(s.mask is not None for s in one.shots)
    assert one.shots[20].mask is not None
    assert one.shots[20].mask.any()
    assert not np.array_equal(one.shots[20].frame.image, render_grasp("battery", 4).shots[20].frame.image)


def test_the_paper_pipeline_runs_with_the_timing_network() -> None:
    grasp = short(render_grasp("bar", 2, with_masks=True), 10)
    masks = {shot.frame.sequence: shot.mask for shot in grasp.shots if shot.mask is not None}
    network = FrameNetwork(PEER_PATH)
    assert network.timing_only
    pipeline = PaperPipeline(network, masks)
    estimates = [pipeline.process(shot.frame) for shot in grasp.shots[-3:]]
    assert all(one.contact and one.rotation_deg is not None and one.sigma_deg is None for one in estimates)
    assert network.segment(grasp.shots[0].frame.image, None).shape == (160, 120)
    assert pipeline.last_mask.shape == (320, 240)
    pipeline_under_test = BenchPipeline("paper", "peer", "skeleton", PEER_PATH, "frame", "240×320")
    results = PipelineResults(busy_ms=[80.0])
    assert results.row(pipeline_under_test, results, 80.0, 288.0).turn_error_mean_deg is None


def test_the_paper_pipeline_thins_at_the_size_of_its_network(monkeypatch: pytest.MonkeyPatch) -> None:
    grasp = short(render_grasp("bar", 2, with_masks=True), 10)
    thinned: list[tuple[int, ...]] = []
    whole = cv2.ximgproc.thinning

    def counted(mask: NDArray[np.uint8], thinningType: int) -> NDArray[np.uint8]:
        thinned.append(mask.shape)
        return cast("NDArray[np.uint8]", whole(mask, thinningType=thinningType))

    monkeypatch.setattr(cv2.ximgproc, "thinning", counted)
    network = FrameNetwork(PAPER_PATH)
    pipeline = PaperPipeline(network)
    shot = grasp.shots[-1]
    seen = pipeline.process(shot.frame)
    assert thinned == [(network.height, network.width)] == [(160, 120)]
    assert shot.mask is not None
    assert dice(pipeline.last_mask > 0, shot.mask > 0) > 0.7
    assert seen.contact_area_px == np.count_nonzero(pipeline.last_mask)


def test_network_files_are_sorted_by_their_inputs(tmp_path: Path) -> None:
    (tmp_path / "ours.onnx").write_bytes(default_model_path().read_bytes())
    (tmp_path / "theirs.onnx").write_bytes(PEER_PATH.read_bytes())
    assert network_files(tmp_path) == ([tmp_path / "ours.onnx"], [tmp_path / "theirs.onnx"])
    (tmp_path / "broken.onnx").write_bytes(b"no network")
    with pytest.raises(ModelError, match="broken"):
        network_files(tmp_path)
    with pytest.raises(ModelError, match="no such folder"):
        network_files(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ModelError, match=r"no \.onnx file in it"):
        network_files(tmp_path / "empty")


def test_the_standard_error_within_sigma_follows_from_differences_between_grasps() -> None:
    def grasp(inside: int, outside: int) -> GraspErrors:
        found = [(0.5, 1.0, 1.0)] * inside + [(1.5, 1.0, 1.0)] * outside + [(9.0, 9.0, None)]
        return GraspErrors("bar", True, 0.0, len(found), found)

    equal = [grasp(8, 2)] * 9
    assert within_sigma_se(equal, 1.0) == 0.0
    assert within_sigma_se([grasp(10, 0), grasp(0, 10)], 1.0) == pytest.approx(0.5)
    shares = [1.0, 0.8, 0.6, 0.2]
    differing = [grasp(round(20 * share), 20 - round(20 * share)) for share in shares]
    assert within_sigma_se(differing, 1.0) == pytest.approx(np.std(shares, ddof=1) / 2.0)
    assert within_sigma_se(differing, 2.0) == 0.0
    assert within_sigma_se(equal[:1], 1.0) is None
