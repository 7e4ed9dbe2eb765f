"""The bench: pipelines, outcomes of scenes, their figures, and reports of given figures."""

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

from slipguard.bench import run, scenes, tables
from slipguard.bench.comparison_pipelines import (
    AxialRotation,
    BackgroundSubtraction,
    FrameNetwork,
    PaperPipeline,
    axis_of_mask,
)
from slipguard.bench.pipelines import NO_SKIP, PEER_MODEL, BenchPipeline, network_files, with_small_network
from slipguard.bench.plot import draw_bench
from slipguard.bench.results import (
    BenchReport,
    BenchRow,
    SkipResult,
    ThinningResult,
    bench_row,
    effect_result,
    errors_by_quarter,
    pareto_front,
    skip_result,
    within_sigma_se,
)
from slipguard.bench.scenes import Scene, SceneOutcome, held_frames, measure
from slipguard.datasets.mask_scores import dice
from slipguard.datasets.rendered_grasps import EMPTY_FRAMES, ROTATION_DEG, GraspFrame, RenderedGrasp, render_grasp
from slipguard.devices import Frame
from slipguard.errors import ModelError
from slipguard.perception.estimate import Estimate
from slipguard.perception.segmenter import default_model_path
from slipguard.perception.skipping import ALL_SKIPS
from slipguard.tools.experiment import Case

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


def outcome(object_name: str = "bar", **changes: object) -> SceneOutcome:
    return replace(SceneOutcome(object_name, object_name == "bar", 0.0), **changes)  # type: ignore[arg-type]


def found() -> BenchReport:
    ours = BenchRow(
        "net + registration", "net", "registration", 3.0, 5.0, 0.3, 0.6, 1.2, 0.05, 0.95, math.nan, 700, 10,
        mean_ms_per_frame_grasp=0.7, turn_error_by_quartile_deg=(0.1, 0.2, 0.3, 0.4), pareto=True,
        stage_ms={"segment": (1.3, 1.5, 1.4), "thin": (0.3, 0.4, 0.1)},
    )  # fmt: skip
    peer = BenchRow("paper", "peer", "skeleton", 150.0, 160.0, None, None, None, None, None, None, 24, None,
               resolution="240×320", mean_ms_per_frame_grasp=150.0)  # fmt: skip
    plain = replace(ours, name="subtraction + pca", network="subtraction", estimator="pca", pareto=False)
    thin = ThinningResult("240×320", 9, 1.0, {"cv2": 5.0}, {"cv2": 5.0}, 0)
    errors: list[tuple[float, float, float | None]] = [(0.5, 0.5, 1.0), (9.0, 9.0, 2.0)]
    zero = outcome(compared=5, errors=[(3.0, 0.0, None)] * 5)
    axis = outcome(compared=5, errors=[(7.0, 7.0, None)])
    slip = effect_result("partial slip", [outcome(compared=5, errors=errors, shifts_mm=[0.1, 0.5])], [zero], [axis])
    skip = SkipResult("unchanged", True, 2861, 3600, 2.0, 1.4, 0.001)
    machine = {"processor": "test", "onnxruntime": "1", "opencv": "4"}
    return BenchReport(machine, (ours,), (peer, plain), ours.name, (thin,), (skip,), ("a note",), (slip,))


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
    console.print(*tables.bench_tables(replace(bench, peers=(long,))), *tables.notes(bench))
    text = cast("StringIO", console.file).getvalue()
    assert "50.0" in text
    assert "default" in text
    assert "…" not in text
    for title in ("partial slip", "zero", "declined", "240×320", "ms per frame", "2,861"):
        assert title in text
    assert "published, on a real cell" in " ".join(text.split())
    draw_bench(found(), tmp_path / "bench.png")
    assert (tmp_path / "bench.png").stat().st_size > 5_000


def test_times_are_compared_with_the_first_network_of_a_size_on_its_faster_number_of_threads() -> None:
    bench = found()
    one, row = bench.peers[0], bench.pipelines[0]
    two = replace(one, name="paper, 2 threads", threads=2, p50_ms=90.0)
    other = replace(one, name="paper, other", network="quicker", p50_ms=10.0)
    small = replace(one, name="paper, small", resolution="120×160", p50_ms=60.0, turn_error_mean_deg=13.0)
    bench = replace(bench, peers=(small, one, two, other, bench.peers[1]))
    assert bench.reference("240×320") == two
    assert bench.reference("96×128") is None
    assert tables.pipeline_cells(row, bench)[-1] == "30.0"
    assert tables.pipeline_cells(row, replace(bench, peers=()))[-1] == "–"
    text = " ".join(tables.notes(bench))
    assert "90.00 ms on 2 threads, its faster number (arbitrary weights, time only)" in text
    assert "60.00 ms on one thread, its faster number (trained weights)" in text


def test_no_row_beats_a_row_of_the_pareto_front_in_time_and_error() -> None:
    base = found().pipelines[0]
    rows = [
        replace(base, name=name, mean_ms_per_frame_grasp=ms, turn_error_mean_deg=error)
        for name, ms, error in (("fast", 1.0, 2.0), ("good", 3.0, 0.5), ("bad", 3.0, 2.5), ("unknown", 0.1, None))
    ]
    assert pareto_front(rows) == {"fast", "good"}
    marked = replace(found(), pipelines=tuple(rows), peers=()).with_front()
    assert [row.pareto for row in marked.pipelines] == [True, True, False, False]


def test_errors_are_split_into_quarters_from_easy_to_hard() -> None:
    outcomes = [outcome(difficulty=k / 8, errors=[(float(k), 0.0, None)]) for k in range(8)]
    assert errors_by_quarter(outcomes[::-1]) == (0.5, 2.5, 4.5, 6.5)


def test_errors_exclude_declined_frames_and_objects_outside_the_manifest() -> None:
    outcomes = [
        outcome(compared=6, errors=[(1.0, 1.0, 1.0)] * 4),
        outcome("ring", compared=9),
        outcome("plain_disc", compared=5),
    ]
    row = bench_row(with_small_network(None)[0], outcomes, outcomes, 1.0)
    assert (row.frames, row.sequences, row.turns, row.turn_sequences) == (20, 3, 4, 1)
    assert row.round_plain_declined_share == 1.0


def test_the_standard_error_within_sigma_follows_from_differences_between_grasps() -> None:
    def grasp(inside: int, outside: int) -> SceneOutcome:
        return outcome(errors=[(0.5, 1.0, 1.0)] * inside + [(1.5, 1.0, 1.0)] * outside + [(9.0, 9.0, None)])

    equal = [grasp(8, 2)] * 9
    assert within_sigma_se(equal, 1.0) == 0.0
    assert within_sigma_se([grasp(10, 0), grasp(0, 10)], 1.0) == pytest.approx(0.5)
    shares = [1.0, 0.8, 0.6, 0.2]
    differing = [grasp(round(20 * share), 20 - round(20 * share)) for share in shares]
    assert within_sigma_se(differing, 1.0) == pytest.approx(np.std(shares, ddof=1) / 2.0)
    assert within_sigma_se(differing, 2.0) == 0.0
    assert within_sigma_se(equal[:1], 1.0) is None


def test_a_skip_saves_the_difference_of_the_mean_times() -> None:
    used = outcome(times_ms={"contact": [2.0], "unchanged": [0.1] * 9}, errors=[(0.2, 0.2, 0.1)])
    without = outcome(times_ms={"contact": [2.0] * 10}, errors=[(0.1, 0.1, 0.1)])
    result = skip_result("unchanged: the last estimate", used, without)
    assert (result.skipped, result.frames) == (9, 10)
    assert result.saved_ms_per_frame_grasp == pytest.approx(2.0 - 0.29)
    assert result.saved_ms == pytest.approx((2.0 - 0.29) * 10 / 9)
    assert result.error_added_deg == pytest.approx(0.1)
    assert skip_result("moves as a whole: no network", used, without).saved_ms is None


def short(grasp: RenderedGrasp, count: int = 22) -> RenderedGrasp:
    """Two empty frames, the frames around the first rotation, and the last one; masks stay on every fourth frame."""
    start = next(index for index, shot in enumerate(grasp.shots) if shot.compared) - 8
    start -= (start - 2) % 4
    return replace(grasp, shots=grasp.shots[:2] + grasp.shots[start : start + count] + grasp.shots[-1:])


@pytest.mark.realtime
def test_outcomes_of_one_grasp_give_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "render_grasp", lambda *args, **options: short(render_grasp(*args, **options)))
    default = with_small_network(None)[0]
    assert (default.estimator, default.skips) == ("registration", ALL_SKIPS)
    ran = measure(Case("key", 2, Scene("grasp", (default,), mask_every=1)))[default.name]
    row = bench_row(default, [ran], [ran], 1.0)
    assert row.sequences == 1
    assert row.frames == ran.compared > 0
    assert row.turn_error_mean_deg is not None
    assert row.turn_error_mean_deg < 3.0
    assert row.dice is not None
    assert row.dice > 0.85
    assert row.skipped_p50_ms is not None
    assert row.skipped_p50_ms < (row.p50_ms or 0.0)
    assert row.round_plain_declined_share is None
    assert {"gate", "segment"} < set(row.stage_ms)
    assert row.turns == len(ran.errors) > 0


class FixedProcessor:
    """A processor that finds the labeled mask and reports every frame as skipped for this reason."""

    def __init__(self, mask: NDArray[np.uint8], skipped: str | None) -> None:
        self.last_mask, self._skipped = mask, skipped

    def process(self, frame: Frame) -> Estimate:
        contact = self._skipped is None
        return Estimate(frame.sequence, 0.0, 0.0, contact, 900, "registration", declined="fixed", skipped=self._skipped)


def test_a_contact_skipped_as_no_contact_has_no_overlap() -> None:
    mask = np.zeros((320, 240), np.uint8)
    mask[100:200, 50:150] = 1
    shot = GraspFrame(Frame(np.zeros((320, 240, 3), np.uint8), 0.0, 0), True, 0.0, True, mask)
    for skipped, label, overlaps in (
        (None, mask, [(1.0, 1.0)]),
        ("no contact", mask, [(0.0, 0.0)]),
        ("no contact", np.zeros_like(mask), []),  # touched too lightly for a label
        ("unchanged", mask, []),
    ):
        taken = outcome()
        taken.take(FixedProcessor(mask, skipped), replace(shot, mask=label))
        assert taken.overlaps == overlaps


@pytest.mark.realtime
def test_most_frames_of_a_held_object_are_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "HOLD_S", 4.0)
    default = with_small_network(None)[0]
    bare = replace(default, skips=NO_SKIP)
    held = measure(Case("wrench", 6000, Scene("holding", (default, bare))))
    used = held[default.name]
    assert sum(map(len, used.times_ms.values())) == 240
    assert len(used.times_ms["unchanged"]) > 60
    assert sum(map(len, held[bare.name].times_ms.values())) < 180
    assert np.mean([error for error, _, _ in used.errors]) < 0.5
    first = [shot for _, shot in zip(range(40), held_frames("wrench", 6000), strict=False)]
    assert not first[0].contact
    assert first[-1].contact
    assert first[1].frame.captured_at_s == pytest.approx(1 / 60)


def test_background_subtraction_has_the_right_sign() -> None:
    grasp = render_grasp("bar", 2)
    compared = [shot for shot in grasp.shots if shot.compared]
    pipeline = BackgroundSubtraction(grasp.background)
    estimates = [pipeline.process(shot.frame).rotation_deg for shot in compared]
    truth = [shot.rotation_deg - compared[0].rotation_deg for shot in compared]
    assert np.corrcoef(np.array(estimates, float), truth)[0, 1] > 0.95


def test_axes_are_counter_clockwise_and_rotate_by_less_than_90_degrees() -> None:
    assert axis_of_mask(np.eye(50, dtype=np.uint8)[::-1]) == pytest.approx(45.0)
    assert math.isnan(axis_of_mask(np.zeros((9, 9), np.uint8)))
    rotation, frame = AxialRotation(), Frame(np.zeros((1, 1, 3), np.uint8), 0.0, 0)
    estimates = [rotation.estimate(frame, 80.0 + 15.0 * k, "pca") for k in range(5)]
    assert [one.rotation_deg for one in estimates] == pytest.approx([0.0, 15.0, 30.0, 45.0, 60.0])
    assert rotation.estimate(frame, math.nan, "pca").declined


def test_thinning_is_timed_and_equals_opencv() -> None:
    mask = np.zeros((320, 240), np.uint8)
    mask[60:260, 80:120] = 1
    result = run.compare_thinning([mask], repeats=1)
    assert result.pixels_different_from_cv2 == 0
    assert result.ratios["cv2"] > 0.0


def test_a_rendered_grasp_is_repeatable_and_starts_without_rotation() -> None:
    one, again = render_grasp("battery", 3, with_masks=True), render_grasp("battery", 3)
    assert [s.rotation_deg for s in one.shots] == [s.rotation_deg for s in again.shots]
    np.testing.assert_array_equal(one.shots[20].frame.image, again.shots[20].frame.image)
    assert not any(s.contact for s in one.shots[:EMPTY_FRAMES])
    rotations = [s.rotation_deg for s in one.shots if s.compared]
    assert abs(rotations[0]) < 6.0
    assert ROTATION_DEG[0] <= abs(rotations[-1]) <= ROTATION_DEG[1]
    assert min(rotations) * max(rotations) < 0.0
    assert all(s.mask is not None for s in one.shots)
    assert not np.array_equal(one.shots[20].frame.image, render_grasp("battery", 4).shots[20].frame.image)


def test_the_paper_pipeline_runs_with_the_timing_network() -> None:
    grasp = short(render_grasp("bar", 2, with_masks=True), 10)
    paper = BenchPipeline("paper", "peer", "skeleton", PEER_PATH, "frame", "240×320")
    assert paper.timing_only
    processor = paper.open(grasp)
    estimates = [processor.process(shot.frame) for shot in grasp.shots[-4:-1]]
    assert all(one.contact and one.rotation_deg is not None and one.sigma_deg is None for one in estimates)
    assert processor.last_mask.shape == (320, 240)
    assert FrameNetwork(PEER_PATH).segment(grasp.shots[0].frame.image, None).shape == (160, 120)
    timed = outcome(times_ms={"contact": [80.0]}, errors=[(1.0, 1.0, None)])
    assert bench_row(paper, [timed], [timed], 80.0).turn_error_mean_deg is None


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
    shot = grasp.shots[-2]
    assert pipeline.process(shot.frame).contact
    assert thinned == [(network.height, network.width)] == [(160, 120)]
    assert shot.mask is not None
    assert dice(pipeline.last_mask > 0, shot.mask > 0) > 0.7


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
