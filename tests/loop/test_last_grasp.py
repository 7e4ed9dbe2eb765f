"""The force of a grip is saved as it changes, restored after a restart of the daemon, and deleted with the object."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path

import pytest
from loop_cell import Cell, on_cell, running
from sampled import sampled

from slipguard.config import parse_config
from slipguard.control.control_step import ControlState
from slipguard.control.messages import Observation, StepOutput
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import Adoption, GraspState, HandsOff, PersonNear, Phase, RememberedGrip
from slipguard.daemon.api.requests import ClearRequest, MoveJawsRequest, ReleaseRequest
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.run import build_service
from slipguard.daemon.store import dated_file
from slipguard.daemon.store.disk_writer import RETRY_S
from slipguard.daemon.store.last_grasp import LastGraspSaver, restore_control_state
from slipguard.daemon.store.state_dir import LastGrasp, StateDir
from slipguard.errors import ConfigError
from slipguard.sim.world import World, WorldSettings

MAY_HOLD = ControlState(GraspState(adoption=Adoption(outdated=True)))


def save_grip(cell: Cell, store: StateDir) -> None:
    cell.service.observers.append(LastGraspSaver(store, cell.messages.append, cell.messages.append).add_decision)


@on_cell("wrench", 1)
async def test_the_grip_is_saved_tightened_and_deleted(cell: Cell, tmp_path: Path) -> None:
    store = StateDir(tmp_path)
    save_grip(cell, store)
    await cell.grasp()
    await asyncio.sleep(0.1)
    first = store.load_last_grasp()
    assert first is not None
    assert first.force_n == cell.service.state.grip.target_n
    await cell.lift()
    await asyncio.sleep(0.5)
    tightened = store.load_last_grasp()
    assert tightened is not None
    assert tightened.force_n == cell.service.state.grip.target_n > first.force_n
    assert restore_control_state(store).grasp.adoption.remembered == RememberedGrip(
        tightened.force_n, tightened.width_mm, applied=True, lift_start_mm=(0.0, 0.0, 0.0)
    )
    await cell.lower()
    await cell.release()
    await asyncio.sleep(0.1)
    assert store.load_last_grasp() is None


@on_cell("wrench", 1)
async def test_a_repaired_disk_gets_the_grip_though_the_force_has_not_changed(cell: Cell, tmp_path: Path) -> None:
    class Repaired(StateDir):
        writes = 0

        def save_last_grasp(self, last: LastGrasp) -> None:
            self.writes += 1
            if self.writes <= 2:
                raise ConfigError("last_grasp.json: cannot be written (No space left on device)")
            super().save_last_grasp(last)

    store, reported = Repaired(tmp_path), list[str]()
    cell.service.observers.append(LastGraspSaver(store, reported.append, reported.append).add_decision)
    await cell.grasp()
    await cell.until(lambda: store.writes > 0)
    before, force_n = store.writes, cell.service.state.grip.target_n
    await asyncio.sleep(1.0)
    assert (store.writes, before) == (1, 1), "not at once again"
    await asyncio.sleep(3 * RETRY_S)
    last = store.load_last_grasp()
    assert last is not None
    assert last.force_n == force_n == cell.service.state.grip.target_n
    assert [line.partition(" for a restart")[0] for line in reported] == [
        "the grip could not be saved",
        "the grip can be saved",
    ]


@on_cell("wrench", 1)
async def test_a_force_counts_as_applied_once_the_gripper_confirms_it(cell: Cell, tmp_path: Path) -> None:
    """A daemon killed between a command and its effect must leave nothing behind that looks like a firm grip."""
    store = StateDir(tmp_path)
    save_grip(cell, store)
    await cell.grasp()
    await asyncio.sleep(0.1)
    assert cell.service.state.grip.target_n == pytest.approx(40.0, abs=0.85)
    assert (await saved_grip(store)).applied
    cell.world.faults.fail("gripper", "timeout")
    await cell.submit(MoveJawsRequest(force_n=120.0))
    await asyncio.sleep(0.15)
    not_applied = await saved_grip(store)
    assert not_applied.force_n == pytest.approx(120.0, abs=0.85)
    assert not not_applied.applied
    cell.world.faults.repair("gripper")
    await cell.until(lambda: cell.truth.force_n > 115.0)
    await asyncio.sleep(0.3)
    assert (await saved_grip(store)).applied


async def saved_grip(store: StateDir) -> RememberedGrip:
    """Return the grip that a daemon started now would restore."""
    await asyncio.sleep(0.05)
    grip = restore_control_state(store).grasp.adoption.remembered
    assert grip is not None
    return grip


@on_cell("wrench", 1, watched=False)
async def test_a_latched_fault_is_saved_until_it_is_cleared(cell: Cell, tmp_path: Path) -> None:
    store = StateDir(tmp_path)
    save_grip(cell, store)
    await cell.grasp()
    grip = await saved_grip(store)
    cell.world.faults.fail("gripper", "disconnect")
    await cell.until(lambda: cell.phase is Phase.FAULT)
    await asyncio.sleep(0.1)
    grasp = restore_control_state(store).grasp
    assert (grasp.phase, grasp.fault) == (Phase.FAULT, cell.service.state.fault)
    assert grasp.adoption.remembered == grip, "as of the gripper's last response"
    old = restore_control_state(store, datetime.now(UTC) + timedelta(days=3)).grasp
    assert (old.phase, old.fault, old.adoption.remembered) == (Phase.FAULT, grasp.fault, None)
    cell.world.faults.repair("gripper")
    await cell.ready()
    await cell.submit(ClearRequest())
    await cell.until(cell.steady)
    assert await saved_grip(store) == grip
    assert restore_control_state(store).grasp.fault is None
    cell.world.clear(cell.now_s)
    await cell.until(lambda: cell.phase is Phase.FAULT)
    await cell.until(lambda: restore_control_state(store).grasp.fault is not None)
    await cell.submit(ReleaseRequest(confirm=True))
    await asyncio.sleep(0.1)
    assert restore_control_state(store).grasp.fault is None
    await cell.until(lambda: cell.phase is Phase.IDLE)
    await asyncio.sleep(0.1)
    assert store.load_last_grasp() is None


SAVED = '{"format": 5, "force_n": 40.0, "width_mm": 18.0, "saved_at": '


@pytest.mark.parametrize(
    ("content", "damage"),
    [
        ('{"format": 1}', "saved_at: missing"),
        ("not JSON", "not valid JSON: "),
        ("[" * 10_000, "not valid JSON: recursion limit"),
        (" " * 2_000_000, "larger than 1048576 bytes"),
        (SAVED + '"2026-01-01T00:00:00Z", "lift_start_mm": [0, 0, NaN]}', "lift_start_mm"),
        (SAVED + '"2026-01-01T00:00:00Z", "force_n": -Infinity}', "force_n"),
        (SAVED + '"2026-01-01T00:00:00Z", "fault": {"code": "x", "observed": "", "what_to_do": ""}}', "fault.code"),
        (SAVED + '"2026-01-01T00:00:00", "boot_id": "another"}', "saved_at = '2026-01-01T00:00:00': "),
        (SAVED + '1e300, "boot_id": "another"}', "saved_at = 1e+300: "),
        (SAVED + '"2026-01-01T00:00:00Z", "boot_id": "BOOT", "uptime_s": 1e300}', "uptime_s = 1e+300: "),
    ],
)
def test_after_a_damaged_file_it_is_unknown_whether_something_is_held(
    tmp_path: Path, content: str, damage: str
) -> None:
    content = content.replace("BOOT", dated_file._boot_id())
    (tmp_path / "last_grasp.json").write_text(content)
    lines: list[str] = []
    assert restore_control_state(StateDir(tmp_path), warning=lines.append) == MAY_HOLD
    (line,) = lines
    assert line.startswith(f"it is unknown what was held before the restart: {tmp_path}/last_grasp.json: ")
    assert damage in line
    (aside,) = tmp_path.glob("last_grasp.unreadable-*.json")
    assert aside.read_text() == content
    assert f"(kept as {aside.name})" in line
    assert restore_control_state(StateDir(tmp_path), warning=lines.append) == MAY_HOLD, "at each start until a grip"
    assert len(lines) == 1


def a_folder(path: Path) -> None:
    path.mkdir()
    (path / "file").write_text("")


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.symlink_to(path.parent / "missing"), "No such file"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
        (lambda path: path.symlink_to("/dev/zero"), "not a regular file"),
        (os.mkfifo, "not a regular file"),
        (a_folder, "Is a directory"),
    ],
)
def test_what_is_no_file_does_not_say_that_nothing_was_held(
    tmp_path: Path, make: Callable[[Path], object], reason: str
) -> None:
    make(tmp_path / "last_grasp.json")
    lines: list[str] = []
    assert restore_control_state(StateDir(tmp_path), warning=lines.append) == MAY_HOLD
    assert reason in lines[0]
    assert restore_control_state(StateDir(tmp_path), warning=lines.append) == MAY_HOLD
    assert len(lines) == 1, "the next start reads a valid file"


def test_after_a_damaged_file_the_held_object_is_kept_and_guarded(tmp_path: Path) -> None:
    store, before = StateDir(tmp_path), Cell("wrench", 1)

    async def scene() -> None:
        async with running(before):
            await before.grasp()
        (tmp_path / "last_grasp.json").write_bytes(b"\0" * 200)
        force_n = before.truth.force_n
        after = Cell("wrench", 1, world=before.world)
        after.service._control_state = restore_control_state(store)
        save_grip(after, store)
        async with running(after):
            await after.until(after.steady)
            assert after.truth.force_n >= force_n - 0.01
            assert [what for _, what, _ in after.gripper.commands if what in ("release", "activate")] == []
            await after.lift()
            assert after.truth.dropped is None
            assert (await saved_grip(store)).force_n == after.service.state.grip.target_n

    run_virtual(scene())


def test_an_old_file_only_says_that_something_may_be_held(tmp_path: Path) -> None:
    store, now = StateDir(tmp_path), datetime.now(UTC)
    store.save_last_grasp(LastGrasp(saved_at=now - timedelta(hours=2), force_n=90.0, width_mm=18.0))
    assert restore_control_state(store, now) == MAY_HOLD
    store.save_last_grasp(LastGrasp(saved_at=now - timedelta(minutes=2), force_n=90.0, width_mm=18.0))
    assert restore_control_state(store, now) == ControlState(
        GraspState(adoption=Adoption(remembered=RememberedGrip(90.0, 18.0)))
    )


@on_cell("wrench", 1)
async def test_a_stop_for_a_person_is_remembered_until_clear(cell: Cell, tmp_path: Path) -> None:
    """A daemon that starts with a person in the jaws adds no force until a person requests it."""
    store = StateDir(tmp_path)
    save_grip(cell, store)
    await cell.grasp()
    cell.world.faults.fail("arm", "protective_stop")
    await asyncio.sleep(0.3)
    assert restore_control_state(store).grasp.person.now
    cell.world.faults.repair("arm")
    await asyncio.sleep(0.3)
    assert restore_control_state(store).grasp.person.forbids_force
    await cell.submit(ClearRequest())
    await cell.until(lambda: not restore_control_state(store).grasp.person.forbids_force)


@pytest.mark.parametrize("ahead", [timedelta(minutes=1), timedelta(days=400)])
def test_a_file_from_the_future_counts_as_an_old_one(tmp_path: Path, ahead: timedelta) -> None:
    """The clock of a computer with an empty battery, before and after it was set."""
    store, now = StateDir(tmp_path), datetime.now(UTC)
    store.save_last_grasp(LastGrasp(saved_at=now + ahead, force_n=90.0, width_mm=18.0))
    lines: list[str] = []
    assert restore_control_state(store, now, lines.append) == MAY_HOLD
    assert "in the future; check the computer's clock" in lines[0]


@pytest.mark.parametrize("step", sampled([timedelta(hours=-5), timedelta(minutes=-1), timedelta(hours=5)]))
@on_cell("wrench", 1)
async def test_a_clock_that_is_set_does_not_change_the_age_of_a_grip(
    cell: Cell, tmp_path: Path, step: timedelta, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = StateDir(tmp_path)

    class Stepped(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return datetime.now(tz) + step

    save_grip(cell, store)
    await cell.grasp()
    before = await saved_grip(store)
    monkeypatch.setattr(dated_file, "datetime", Stepped)
    assert await saved_grip(store) == before
    await cell.lift()
    await asyncio.sleep(0.5)
    assert cell.phase is Phase.HOLDING
    assert (await saved_grip(store)).force_n == cell.service.state.grip.target_n
    monkeypatch.undo()
    assert (await saved_grip(store)).force_n == cell.service.state.grip.target_n


SILENT = Fault(FaultCode.GRIPPER_SILENT, "no answer for 2.0 s", "check its cable")
BEFORE = Adoption(remembered=RememberedGrip(90.0, 18.0, applied=False, limit_n=95.0))


@pytest.mark.parametrize(
    "grasp",
    [
        GraspState(Phase.FAULT, adoption=BEFORE, person=PersonNear(True), fault=SILENT),
        GraspState(Phase.FAULT, adoption=Adoption(outdated=True), fault=SILENT),
        GraspState(Phase.FAULT, hands_off=HandsOff(True, True), fault=SILENT),
    ],
    ids=["grip of before the restart", "unknown grip", "requested release"],
)
def test_a_fault_is_stored_with_what_is_known_of_the_grip(tmp_path: Path, grasp: GraspState) -> None:
    store, reported = StateDir(tmp_path), list[str]()
    latched = Decision(1.0, Phase.FAULT, Observation(1.0), StepOutput(fault=SILENT), ControlState(grasp))
    before = replace(latched, phase=Phase.IDLE, output=StepOutput())

    async def scene() -> None:
        saver = LastGraspSaver(store, reported.append, reported.append)
        saver.add_decision(before)
        await asyncio.sleep(0.1)
        assert store.load_last_grasp() is None, "nothing is known yet"
        saver.add_decision(latched)
        await asyncio.sleep(0.1)

    asyncio.run(scene())
    assert restore_control_state(store).grasp == grasp
    assert reported == []


@on_cell("wrench", 1)
async def test_a_grip_that_does_not_change_for_hours_does_not_grow_old(cell: Cell, tmp_path: Path) -> None:
    class Counting(StateDir):
        writes = 0

        def save_last_grasp(self, last: LastGrasp) -> None:
            self.writes += 1
            super().save_last_grasp(last)

    store, decisions = Counting(tmp_path), list[Decision]()
    saver = LastGraspSaver(store, cell.messages.append, cell.messages.append)
    cell.service.observers.append(decisions.append)
    await cell.grasp()
    held = decisions[-1]
    for minutes in range(0, 21, 4):
        saver.add_decision(replace(held, now_s=held.now_s + 60.0 * minutes))
        await asyncio.sleep(0.1)
    assert store.writes == 3, "at 0, 8 and 16 minutes"


@pytest.mark.parametrize("saved_at", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00"])
def test_a_grip_of_another_age_and_time_zone_is_not_used(tmp_path: Path, saved_at: str) -> None:
    (tmp_path / "last_grasp.json").write_text(SAVED + f'"{saved_at}", "boot_id": "another"}}')
    assert restore_control_state(StateDir(tmp_path), warning=list[str]().append) == MAY_HOLD


@pytest.mark.parametrize("target", ["missing", "state"])
def test_a_state_folder_behind_a_broken_link_does_not_say_that_nothing_was_held(tmp_path: Path, target: str) -> None:
    state = tmp_path / "state"
    state.symlink_to(tmp_path / target)
    lines: list[str] = []
    assert restore_control_state(StateDir(state), warning=lines.append) == MAY_HOLD
    assert "cannot be read" in lines[0]
    (tmp_path / "real").mkdir()
    state.unlink()
    state.symlink_to(tmp_path / "real")
    assert restore_control_state(StateDir(state), warning=lines.append) == ControlState(), "a first start"


def test_the_daemon_reports_a_damaged_file(tmp_path: Path) -> None:
    (tmp_path / "last_grasp.json").write_text('{"format": 5, "force_')
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
    config = parse_config(raw | {"state": {"directory": str(tmp_path)}}, where="test", sim=True)
    service = build_service(config, world=World(WorldSettings(), seed=0))
    service.close()
    assert service.event_log.lines[0].startswith("it is unknown what was held before the restart: ")
    assert service.state == MAY_HOLD.grasp
