"""`slipguard soak` in short: it runs the whole daemon, tells what it holds on to, and would notice what grows."""

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
from tests.campaigns.soak.checks import SoakCheck, StorageLimits, WorkDone, check_soak, growth
from tests.campaigns.soak.page import PageProcess
from tests.campaigns.soak.resources import ResourceSample, feel

STILL = ResourceSample(0.0, 100.0, 10.0, 50_000, 20, 3, 12, 2, 4, 5, 8.0, 2.0)
EMPTY = replace(STILL, tasks=1, threads=1, files=5, children=0)
LIMITS = StorageLimits(30, 100.0, 50.0)
WORK = WorkDone(lifts=1, dropped=0, calibrations=1, recording_stops=0, left_out=0, pictures=1, connections_lost=0)


def too_much(
    pulses: list[ResourceSample], after: ResourceSample = EMPTY, missed: int = 0, work: WorkDone = WORK
) -> list[str]:
    return [one.what for one in check_soak(pulses, EMPTY, after, LIMITS, work, missed, 1000) if not one.good]


def test_what_stays_the_same_is_good() -> None:
    assert too_much([replace(STILL, at_s=float(at)) for at in range(50)], missed=1) == []


def test_a_file_that_is_once_not_open_makes_the_others_no_growth() -> None:
    pulses = [replace(STILL, at_s=float(at)) for at in range(50)]
    pulses[9] = replace(pulses[9], files=STILL.files - 1)
    assert too_much(pulses) == []


@pytest.mark.parametrize(
    ("name", "step", "what"),
    [
        ("rss_mb", 0.1, "memory growth"),
        ("blocks", 50, "growth of what Python has allocated, blocks"),
        ("children_mb", 0.02, "memory growth of the child processes"),
        ("tasks", 1, "tasks more at the end than after the warm-up"),
        ("threads", 1, "threads more"),
        ("files", 1, "open files more"),
        ("children", 1, "child processes more"),
        ("state_files", 1, "files in the state directory"),
        ("ring_files", 1, "files in the ring"),
        ("ring_mb", 2.0, "megabytes in the ring"),
        ("kept_mb", 1.0, "megabytes kept"),
    ],
)
def test_what_grows_is_named(name: str, step: float, what: str) -> None:
    pulses = [replace(STILL, **{name: getattr(STILL, name) + at * step}) for at in range(50)]
    assert too_much(pulses) == [what]


@pytest.mark.parametrize("name", ["tasks", "threads", "files", "children"])
def test_what_is_left_at_the_end_is_named(name: str) -> None:
    (left,) = too_much([STILL] * 50, after=replace(EMPTY, **{name: getattr(EMPTY, name) + 1}))
    assert left.endswith(("left", "left when the daemon has ended"))


def test_missed_deadlines_and_a_soak_without_a_look_are_no_good() -> None:
    assert too_much([STILL] * 50, missed=2) == ["deadlines missed, share"]
    assert "memory growth" in too_much([])
    assert "megabytes recorded" in too_much([])


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("lifts", 0, "lifts"),
        ("dropped", 1, "dropped"),
        ("recording_stops", 1, "times the recording stopped"),
        ("left_out", 1, "values left out of the recordings"),
        ("pictures", 0, "pictures on the page"),
        ("connections_lost", 1, "connections the page lost"),
    ],
)
def test_a_daemon_that_does_not_do_its_work_does_not_pass(name: str, value: int, what: str) -> None:
    assert too_much([STILL] * 50, work=replace(WORK, **{name: value})) == [what]


def test_without_recordings_and_page_nothing_is_asked_of_them() -> None:
    without = WorkDone(lifts=1, dropped=0, calibrations=1)
    unrecorded = replace(STILL, ring_files=0, ring_mb=0.0, kept_mb=0.0)
    assert too_much([unrecorded] * 50, work=without) == []
    assert too_much([unrecorded] * 50) == ["megabytes recorded"]
    assert too_much([replace(unrecorded, kept_mb=1.0)] * 50) == []


def test_every_calibration_leaves_two_files_a_finger_until_the_oldest_go() -> None:
    files = [replace(WORK, calibrations=count).state_files for count in (1, 2, 21, 22, 500)]
    assert files[1] - files[0] == 4
    assert files[2] == files[3] == files[4]


def test_growth_leaves_the_warm_up_out() -> None:
    assert growth([10.0] * 15 + [100.0] * 85) == pytest.approx(0.0)
    assert growth([*range(100, 200)]) > 0.5


async def test_a_pulse_sees_a_task_a_thread_a_file_and_a_child(tmp_path: Path) -> None:
    def look() -> ResourceSample:
        return feel(0.0, tmp_path, tmp_path / "recordings")

    before, held = look(), threading.Event()
    task = asyncio.create_task(asyncio.sleep(60.0))
    thread = threading.Thread(target=held.wait)
    thread.start()
    child = await asyncio.create_subprocess_exec("sleep", "60")
    (tmp_path / "recordings" / "ring").mkdir(parents=True)
    (tmp_path / "recordings" / "ring" / "a.mcap").write_bytes(bytes(2**20))
    with (tmp_path / "left.json").open("w"):
        after = look()
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


def test_a_short_one_with_the_page_open(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pulses = tmp_path / "pulses.jsonl"
    code = run(["soak", "--minutes", "0.6", "--page", "--pulses", str(pulses), "--json"])
    found = json.loads(capfd.readouterr().out)
    assert [one["what"] for one in found["findings"] if not SoakCheck(**one).good] == []
    assert (code, found["good"]) == (0, True)
    assert found["counts"]["cycles"] >= 1
    assert found["counts"]["dropped"] == 0
    assert found["counts"]["page: history"] == 1
    assert found["counts"]["page: state"] > 5
    assert found["counts"]["page: pictures"] >= 4
    assert found["left_out"] == 0
    assert len(pulses.read_text().splitlines()) == len(found["pulses"])


def test_one_that_is_ended_from_outside_says_so(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def short_day(self: object, service: object) -> None:
        os.kill(os.getpid(), signal.SIGTERM)  # the daemon heeds it by now
        await asyncio.get_running_loop().create_future()

    monkeypatch.setattr("tests.campaigns.soak.run._Run.day", short_day)
    assert run(["soak", "--hours", "1"]) == 1
    assert capfd.readouterr().err == "slipguard: the soak was ended before its time\n"


def test_too_short_or_two_things_at_once_is_misuse(capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["soak"]) == 2
    assert "--hours 8" in capfd.readouterr().err
    assert run(["soak", "--minutes", "1", "--recording-cost", "2"]) == 2
    assert "--recording-cost" in capfd.readouterr().err


async def test_the_page_in_a_process_of_its_own_ends_and_tells(tmp_path: Path) -> None:
    page = PageProcess()
    await page.open(tmp_path / "no daemon here.sock")
    async with asyncio.timeout(30.0):
        assert set(await page.close()) <= {"connections lost"}


def test_soak_on_either_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    virtual: list[bool] = []
    monkeypatch.setattr(soak, "_endure", lambda length_s, clock, *others: virtual.append(clock) or True)
    for words in (["--clock", "real"], ["--clock", "virtual"], []):
        assert run(["soak", "--minutes", "1", *words]) == 0
    assert virtual == [False, True, True]
