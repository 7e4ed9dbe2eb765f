"""`slipguard --sim --speed fast`: JSON, table, and exit code."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from command_line import Ran, slipguard
from rich.console import Console

from slipguard.cli import simulate
from slipguard.sim.world import World
from slipguard.sim_lifts import campaign
from slipguard.sim_lifts.campaign import CampaignSettings
from slipguard.sim_lifts.lift_record import EstimatedRotation, LiftRecord
from slipguard.sim_lifts.report import print_lines, print_tables

SUMMARY = {
    "lifts", "held", "dropped", "refused", "turn_error_lifts", "turn_error_mean_deg", "turn_error_worst_object_deg",
    "true_turn_median_deg", "true_turn_max_deg", "true_slip_median_deg", "true_slip_max_deg",
    "over_20_deg_or_dropped", "latency_p50_ms", "latency_p99_ms",
    "skipped_share", "deadlines_missed",
}  # fmt: skip


@pytest.fixture(autouse=True)
def _short_lifts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "LIFT_HEIGHT_MM", 60.0)
    monkeypatch.setattr(campaign, "HOLD_S", 0.2)


@pytest.mark.campaign
def test_one_lift_as_json(capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple[str, float | None]] = []

    @contextmanager
    def display(console: Console) -> Iterator[Callable[[campaign.LiftProgress], None]]:
        yield lambda live: shown.append((live.object_name, live.latency_ms))

    monkeypatch.setattr(simulate, "_display", display)
    ran = slipguard(capfd, "--sim", "--speed", "fast", "--lifts", 1, "--json", "--out", tmp_path / "new" / "out")
    assert ran.code == 0
    lines: list[dict[str, Any]] = [json.loads(line) for line in ran.out.splitlines()]
    assert all(len(line) == 1 for line in lines)
    assert [key for line in lines for key in line].count("summary") == 1
    found = lines[-1]["summary"]
    assert set(found) == SUMMARY
    assert (found["lifts"], found["held"], found["dropped"], found["refused"]) == (1, 1, 0, 0)
    assert found["latency_p50_ms"] is None
    assert found["latency_p99_ms"] is None
    assert set(shown) == {("bar", None)}, "a virtual clock measures no latency"
    assert lines[0]["lift"]["object"] == "bar"
    plot = cv2.imread(str(tmp_path / "new" / "out" / "guarded.png"))
    assert plot.std() > 5.0
    assert ran.err.startswith("plot: ")


def record(name: str, outcome: str, why: str = "") -> LiftRecord:
    made = LiftRecord(object_name=name, outcome=outcome, why=why, hard="heavy" if name == "bar" else "")
    empty = World().truth(0.0)
    for step in range(50):
        moved = {"rotation_deg": -0.9 * step, "force_n": 40.0 + 1.8 * step, "height_mm": 3.0 * step}
        made.truth.append(replace(empty, time_s=0.1 * step, needed_force_n=66.0, **moved))
        made.fused.append(EstimatedRotation(0.1 * step, -0.9 * step + 0.2, 0.39))
    made.latency_s = [0.0042, 0.0118]
    made.deadlines_missed = 12
    return made


def printed(records: list[LiftRecord], width: int, *, realtime: bool = True) -> str:
    console = Console(width=width, record=True, quiet=False, highlight=False, file=open("/dev/null", "w"))  # noqa: SIM115
    try:
        print_tables(console, records, realtime=realtime)
    finally:
        console.file.close()
    return console.export_text()


def test_the_table_fits_80_columns() -> None:
    names = ["bar", "knife_edge", "screwdriver"]
    text = printed([record(name, "dropped", "rotated more than 60 deg") for name in names], 80)
    assert "…" not in text
    row = next(line for line in text.splitlines() if line.startswith("screwdriver"))
    assert row.split()[:6] == ["screwdriver", "-44.1", "-43.9", "0.20", "0.39", "128/66"]
    assert row.split()[6:] == ["dropped", "8.0/11.7", "–", "12"]
    assert "bar (heavy)" in text
    assert "screwdriver dropped: rotated more than 60 deg" in text
    assert "p50 8.0 ms, p99 11.8 ms" in " ".join(text.split())


def test_a_campaign_without_frames_gives_valid_json(capfd: pytest.CaptureFixture[str]) -> None:
    print_lines([LiftRecord(object_name="bar", outcome="refused", why="no contact")], realtime=True)
    lines = capfd.readouterr().out.splitlines()
    assert set(json.loads(lines[-1])["summary"]) == SUMMARY
    assert "NaN" not in "".join(lines)


def sim(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, outcome: str, *words: str) -> Ran:
    async def campaign_of_one(settings: object, show: object) -> list[LiftRecord]:
        return [record("bar", outcome)]

    monkeypatch.setattr(campaign, "run_campaign", campaign_of_one)
    return slipguard(capfd, "--sim", "--speed", "fast", *words)


@pytest.mark.parametrize(("outcome", "code"), [("held", 0), ("refused", 0), ("dropped", 1)])
def test_only_a_dropped_object_is_a_failure(
    outcome: str, code: int, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert sim(capfd, monkeypatch, outcome).code == code
    assert sim(capfd, monkeypatch, outcome, "--json").code == code


@pytest.mark.parametrize("why", ["frames lost", "loop late", "machine too busy", "cannot grasp: not ready: left"])
def test_a_machine_that_is_too_slow_gets_a_virtual_clock(
    why: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks = list[bool]()

    async def campaign_of_two(settings: CampaignSettings, show: object) -> list[LiftRecord]:
        clocks.append(settings.realtime)
        return [record("bar", "held"), record("ball", "refused", why) if settings.realtime else record("ball", "held")]

    monkeypatch.setattr(campaign, "run_campaign", campaign_of_two)
    for words in ((), ("--json",)):
        clocks.clear()
        ran = slipguard(capfd, "--sim", *words)
        assert ran.code == 0
        assert clocks == [True, False]
        assert ran.err.count("\n") == 1
        assert ran.err.startswith(f"lift 2 ended early ({why}): this machine is too busy or too slow")
        assert "2 held" in ran.out or '"held": 2' in ran.out
    assert slipguard(capfd, "--sim", "--speed", "fast").code == 0
    assert clocks[2:] == [False]


def test_it_prints_what_happens_and_the_next_commands(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    guarded = sim(capfd, monkeypatch, "held", "--seed", "3")
    assert guarded.out.startswith("10 lifts of objects")
    assert "tightens the grip" in guarded.out
    assert "slipguard --sim --no-guard --seed 3" in guarded.out
    unguarded = sim(capfd, monkeypatch, "dropped", "--no-guard", "--lifts", "1")
    assert unguarded.out.startswith("1 lift of")
    assert "the same lifts with the guard" in unguarded.out
