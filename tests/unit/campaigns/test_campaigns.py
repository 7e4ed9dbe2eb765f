"""Campaigns in short form, and that each would notice what it looks for."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from tests.campaigns import fuzz_cases, soak
from tests.campaigns.command_line import run
from tests.campaigns.figures import Figure
from tests.campaigns.fuzz import run_kind
from tests.campaigns.fuzz_cases import KINDS, changed_bytes, changed_value, run_case
from tests.campaigns.hostile_clients import HostileResult, run_attack
from tests.campaigns.soak import GROWTH_SAMPLES_MIN, Sample, Soak, soak_figures


def exceeded(figures: list[Figure]) -> list[str]:
    return [one.what for one in figures if not one.good]


# --- soak ---

STILL: Sample = {
    "rss_mb": 100.0, "blocks": 50_000, "tasks": 20, "threads": 3, "files": 12, "children": 1,
    "state_files": 5, "ring_files": 5, "ring_mb": 8.0, "kept_mb": 2.0,
}  # fmt: skip
EMPTY = STILL | {"tasks": 1, "threads": 1, "files": 5, "children": 0}


def soaked(samples: list[Sample], **changes: object) -> list[str]:
    found = Soak(samples, EMPTY, EMPTY, {"lifts": 1, "dropped": 0})
    for name, value in changes.items():
        setattr(found, name, value)
    return exceeded(soak_figures(found))


def test_constant_resources_and_a_briefly_closed_file_pass() -> None:
    samples = [dict(STILL) for _ in range(50)]
    samples[9]["files"] -= 1
    assert soaked(samples, missed=0.001) == []


@pytest.mark.parametrize(
    ("name", "step", "what"),
    [
        ("rss_mb", 0.1, "growth of rss_mb"),
        ("blocks", 50, "growth of blocks"),
        ("tasks", 1, "rise of tasks"),
        ("threads", 1, "rise of threads"),
        ("files", 1, "rise of files"),
        ("children", 1, "rise of children"),
        ("state_files", 1, "files in the state directory"),
        ("ring_files", 1, "files in the ring"),
        ("ring_mb", 2.0, "megabytes in the ring"),
        ("kept_mb", 1.0, "megabytes kept"),
    ],
)
def test_growth_is_named(name: str, step: float, what: str) -> None:
    assert soaked([STILL | {name: STILL[name] + at * step} for at in range(50)]) == [what]


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"after": EMPTY | {"threads": 2}}, ["threads left after shutdown"]),
        ({"missed": 0.002}, ["share of missed deadlines"]),
        ({"counts": {"dropped": 1}}, ["lifts", "dropped"]),
        ({"recording_stops": 1, "left_out": 2}, ["times the recording stopped", "values left out of the recordings"]),
    ],
)
def test_what_is_left_missed_or_dropped_is_named(changes: dict[str, object], what: list[str]) -> None:
    assert soaked([STILL] * 50, **changes) == what


def test_growth_is_judged_with_enough_samples_and_without_any() -> None:
    grown = STILL | {"rss_mb": 150.0}
    assert soaked([STILL, grown]) == []
    assert soaked([*[STILL] * GROWTH_SAMPLES_MIN, grown, grown]) == ["growth of rss_mb"]
    assert {"growth of rss_mb", "megabytes recorded"} <= set(soaked([]))


@pytest.mark.campaign
def test_a_short_soak_of_the_whole_daemon_passes(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["soak", "--hours", "0.05", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert found["lifts"] >= 2
    assert found["exceeded"] == []


def test_an_ended_and_a_too_short_soak_fail(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    async def ended_early(shift: soak.WorkShift) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.get_running_loop().create_future()

    monkeypatch.setattr(soak.WorkShift, "start", ended_early)
    assert run(["soak", "--hours", "1"]) == 1
    assert capfd.readouterr().err == "slipguard: the soak was ended early\n"
    assert run(["soak", "--hours", "0.001"]) == 2
    assert "too short for one lift" in capfd.readouterr().err


# --- fuzz ---


@pytest.mark.campaign
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_inputs_are_one_line(kind: str, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["fuzz", kind, "--cases", "40", "--json", "--keep", str(tmp_path)]) == 0, list(tmp_path.iterdir())
    found = json.loads(capfd.readouterr().out)
    assert found[f"{kind}: cases"] == 40
    assert len(found[kind]["outcomes"]) > 1, "some are refused, and some are not"


def test_a_case_depends_on_its_number_and_the_seed_alone() -> None:
    def made(seed: int) -> str:
        draw = Random(seed)
        return f"{changed_bytes(draw, b'0123456789' * 9)!r} {changed_value(draw, {'a': [1, 2.0, {'b': 'c'}]})}"

    assert made(3) == made(3)
    assert len({made(seed) for seed in range(20)}) > 15


@pytest.mark.parametrize(
    ("raised", "failure"),
    [
        (ValueError("a mistake"), "ValueError: a mistake ("),
        (MemoryError(), "MemoryError: "),
        (SystemExit(3), "SystemExit: 3"),
        (None, "exit code 7"),
    ],
)
def test_an_unexpected_end_is_a_failure_and_its_input_is_kept(
    raised: BaseException | None, failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(draw: Random, folder: Path) -> int:
        (folder / "input").write_text("hostile")
        if raised is not None:
            raise raised
        return 7

    monkeypatch.setitem(fuzz_cases.KINDS, "image", fails)
    assert run_case("image", 0, 5, tmp_path, tmp_path / "kept")["failure"].startswith(failure)
    assert (tmp_path / "kept" / "image-0-5" / "input").read_text() == "hostile"


def test_a_crash_is_a_failure_and_the_next_case_follows(capfd: pytest.CaptureFixture[str]) -> None:
    found = run_kind("image", 2, "no number", 10, None, lambda share: None)  # type: ignore[arg-type]
    assert found.failures == ["case 10: the process crashed or hung (1)", "case 11: the process crashed or hung (1)"]
    assert run(["fuzz", "imagge"]) == 2
    assert "imagge: no such kind; choose from configuration" in capfd.readouterr().err


# --- hostile clients ---


@pytest.mark.campaign
@pytest.mark.realtime
def test_release_and_clear_are_answered_in_time_during_an_attack() -> None:
    found = asyncio.run(run_attack(5.0, 400, 0, lambda step, share: None))
    assert exceeded(found.figures) == []
    assert len(found.attacks) == 27
    assert sum(found.attacks.values()) > 1000


@pytest.mark.parametrize(
    ("times_ms", "statuses", "kept", "failures"),
    [
        ([5.0] * 200 + [199.0, 900.0], {200: 1, 409: 1}, True, []),
        ([5.0, 203.0], {200: 2}, True, ["tcp: p99_ms"]),
        ([5.0], {0: 1}, True, ["wrong responses"]),
        ([5.0], {200: 1}, False, ["web process replaced"]),
    ],
)
def test_a_late_or_missing_response_fails_the_campaign(
    times_ms: list[float], statuses: dict[int, int], kept: bool, failures: list[str]
) -> None:
    found = HostileResult({"unix": [1.0], "tcp": times_ms}, Counter(statuses), {"noise, reads": 3}, kept)
    assert exceeded(found.figures) == failures
