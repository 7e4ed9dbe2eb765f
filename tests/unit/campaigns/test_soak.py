"""A short soak runs the whole daemon, and its checks detect growth, leaks and missing work."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from tests.campaigns.command_line import run
from tests.campaigns.soak import command as soak
from tests.campaigns.soak.checks import GROWTH_SAMPLES_MIN, SoakCheck, StorageLimits, WorkDone, check_soak, growth
from tests.campaigns.soak.page_client import PageProcess
from tests.campaigns.soak.resources import ResourceSample, take_sample
from tests.campaigns.soak.run import SoakResult
from tests.campaigns.soak.settings import SoakSettings

pytestmark = pytest.mark.campaign

STILL = ResourceSample(0.0, 100.0, 10.0, 50_000, 20, 3, 12, 2, 4, 5, 8.0, 2.0)
EMPTY = replace(STILL, tasks=1, threads=1, files=5, children=0)
LIMITS = StorageLimits(30, 100.0, 50.0)
WORK = WorkDone(lifts=1, dropped=0, calibrations=1, recording_stops=0, left_out=0, images=1, connections_lost=0)


def failed_checks(
    samples: list[ResourceSample], after: ResourceSample = EMPTY, missed: int = 0, work: WorkDone = WORK
) -> list[str]:
    return [one.what for one in check_soak(samples, EMPTY, after, LIMITS, work, missed, 1000) if not one.good]


def test_constant_resources_pass() -> None:
    assert failed_checks([replace(STILL, at_s=float(at)) for at in range(50)], missed=1) == []


def test_a_file_that_is_briefly_closed_is_no_growth() -> None:
    samples = [replace(STILL, at_s=float(at)) for at in range(50)]
    samples[9] = replace(samples[9], files=STILL.files - 1)
    assert failed_checks(samples) == []


@pytest.mark.parametrize(
    ("name", "step", "what"),
    [
        ("rss_mb", 0.1, "memory growth"),
        ("blocks", 50, "growth of allocated Python memory blocks"),
        ("children_mb", 0.02, "memory growth of the child processes"),
        ("tasks", 1, "rise of tasks from warm-up to end"),
        ("threads", 1, "rise of threads"),
        ("files", 1, "rise of open files"),
        ("children", 1, "rise of child processes"),
        ("state_files", 1, "files in the state directory"),
        ("ring_files", 1, "files in the ring"),
        ("ring_mb", 2.0, "megabytes in the ring"),
        ("kept_mb", 1.0, "megabytes kept"),
    ],
)
def test_growth_is_named(name: str, step: float, what: str) -> None:
    samples = [replace(STILL, **{name: getattr(STILL, name) + at * step}) for at in range(50)]
    assert failed_checks(samples) == [what]


@pytest.mark.parametrize("name", ["tasks", "threads", "files", "children"])
def test_resources_left_after_shutdown_are_named(name: str) -> None:
    (left,) = failed_checks([STILL] * 50, after=replace(EMPTY, **{name: getattr(EMPTY, name) + 1}))
    assert left.endswith("left after shutdown")


def test_growth_is_not_judged_with_too_few_samples() -> None:
    grown = replace(STILL, rss_mb=1.5 * STILL.rss_mb)
    assert failed_checks([STILL, grown]) == []
    assert failed_checks([*[STILL] * GROWTH_SAMPLES_MIN, grown, grown]) == ["memory growth"]


def test_missed_deadlines_and_a_soak_without_samples_fail() -> None:
    assert failed_checks([STILL] * 50, missed=2) == ["share of missed deadlines"]
    assert "memory growth" in failed_checks([])
    assert "megabytes recorded" in failed_checks([])


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("lifts", 0, "lifts"),
        ("dropped", 1, "dropped"),
        ("recording_stops", 1, "times the recording stopped"),
        ("left_out", 1, "values left out of the recordings"),
        ("images", 0, "images on the page"),
        ("connections_lost", 1, "connections the page lost"),
    ],
)
def test_a_daemon_that_does_not_do_its_work_fails(name: str, value: int, what: str) -> None:
    assert failed_checks([STILL] * 50, work=replace(WORK, **{name: value})) == [what]


def test_recordings_and_page_are_not_checked_when_disabled() -> None:
    without = WorkDone(lifts=1, dropped=0, calibrations=1)
    unrecorded = replace(STILL, ring_files=0, ring_mb=0.0, kept_mb=0.0)
    assert failed_checks([unrecorded] * 50, work=without) == []
    assert failed_checks([unrecorded] * 50) == ["megabytes recorded"]
    assert failed_checks([replace(unrecorded, kept_mb=1.0)] * 50) == []


def test_each_calibration_adds_two_files_per_finger_until_the_oldest_are_deleted() -> None:
    files = [replace(WORK, calibrations=count).state_files for count in (1, 2, 21, 22, 500)]
    assert files[1] - files[0] == 4
    assert files[2] == files[3] == files[4]


def test_growth_ignores_the_warm_up() -> None:
    assert growth([10.0] * 15 + [100.0] * 85) == pytest.approx(0.0)
    assert growth([*range(100, 200)]) > 0.5


async def test_a_sample_counts_a_task_a_thread_a_file_and_a_child(tmp_path: Path) -> None:
    def sample() -> ResourceSample:
        return take_sample(0.0, tmp_path, tmp_path / "recordings")

    before, held = sample(), threading.Event()
    task = asyncio.create_task(asyncio.sleep(60.0))
    thread = threading.Thread(target=held.wait)
    thread.start()
    child = await asyncio.create_subprocess_exec("sleep", "60")
    (tmp_path / "recordings" / "ring").mkdir(parents=True)
    (tmp_path / "recordings" / "ring" / "a.mcap").write_bytes(bytes(2**20))
    with (tmp_path / "left.json").open("w"):
        after = sample()
    child.kill()
    await child.wait()
    held.set()
    thread.join()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    grown = {name: getattr(after, name) - getattr(before, name) for name in ("tasks", "threads", "children")}
    assert (grown["tasks"], grown["children"]) == (1, 1)
    assert grown["threads"] >= 1
    assert after.files > before.files
    assert (after.state_files, after.ring_files, after.ring_mb) == (1, 1, 1.0)


def test_a_short_soak_with_the_page_open_passes(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    samples = tmp_path / "samples.jsonl"
    code = run(["soak", "--minutes", "0.6", "--page", "--samples", str(samples), "--json"])
    found = json.loads(capfd.readouterr().out)
    assert [one["what"] for one in found["checks"] if not SoakCheck(**one).good] == []
    assert (code, found["good"]) == (0, True)
    assert found["counts"]["cycles"] >= 1
    assert found["counts"]["dropped"] == 0
    assert found["counts"]["page: history"] == 1
    assert found["counts"]["page: state"] > 5
    assert found["counts"]["page: images"] >= 4
    assert found["left_out"] == 0
    assert len(samples.read_text().splitlines()) == len(found["samples"])


def test_a_soak_ended_from_outside_reports_it(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def ended_early(self: object, service: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)  # the daemon handles the signal by now
        await asyncio.get_running_loop().create_future()

    monkeypatch.setattr("tests.campaigns.soak.run._SoakRun.work", ended_early)
    assert run(["soak", "--hours", "1"]) == 1
    assert capfd.readouterr().err == "slipguard: the soak was ended early\n"


def test_a_duration_that_is_too_short_is_misuse(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["soak"]) == 2
    assert "--hours 8" in capfd.readouterr().err


async def test_the_page_process_ends_and_reports(tmp_path: Path) -> None:
    page = PageProcess()
    await page.open(tmp_path / "no daemon here.sock")
    async with asyncio.timeout(30.0):
        assert set(await page.close()) <= {"connections lost"}


def test_soak_on_either_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    virtual: list[bool] = []

    def noted(settings: SoakSettings, samples: Path | None) -> SoakResult:
        virtual.append(settings.virtual)
        return SoakResult(settings, [SoakCheck("lifts", 1, 1, at_least=True)], samples=[STILL])

    monkeypatch.setattr(soak, "_run", noted)
    for words in (["--clock", "real"], ["--clock", "virtual"], []):
        assert run(["soak", "--minutes", "1", *words]) == 0
    assert virtual == [False, True, True]
