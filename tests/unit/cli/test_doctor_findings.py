"""The doctor's single checks: findings on figures, folders and drivers that no emulator reproduces."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_daemon_api import holding_state
from pydantic import BaseModel

from slipguard import registry
from slipguard.config import Config, sim_config
from slipguard.daemon.api.state import FingerState
from slipguard.daemon.loop.capture import FrameCounts
from slipguard.daemon.loop.device_health import Health
from slipguard.daemon.loop.gel_condition import GelCondition, GelStatus
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import GripperState
from slipguard.diagnosis import CheckResult, CheckStatus, Diagnosable, ok, problem, problem_from_error
from slipguard.doctor import gripper, machine, run_checks, sensor, through_daemon
from slipguard.errors import DeviceLost
from slipguard.perception.background import GelChange
from slipguard_drivers.digit.diagnostics import RULES, check_digit
from slipguard_drivers.digit.stream_setup import DigitSettings


def plug_in(sysfs: Path, number: int, serial: str, port: str, *, release: str = "0212", speed: str = "480") -> None:
    """A DIGIT as the kernel lists it."""
    usb = sysfs / "devices" / port
    (usb / f"{port}:1.0").mkdir(parents=True)
    for name, text in {
        "idVendor": "2833",
        "idProduct": "0209",
        "serial": serial,
        "bcdDevice": release,
        "speed": speed,
    }.items():
        (usb / name).write_text(text + "\n")
    node = sysfs / f"video{number}"
    node.mkdir()
    (node / "index").write_text("0\n")
    (node / "device").symlink_to(usb / f"{port}:1.0")


@pytest.fixture
def dev(tmp_path: Path) -> Path:
    """/dev with two cameras, and /sys."""
    (tmp_path / "sys").mkdir()
    (tmp_path / "dev").mkdir()
    for number in (0, 1):
        (tmp_path / "dev" / f"video{number}").touch()
    return tmp_path / "dev"


def digit(dev: Path, **settings: Any) -> dict[str, CheckResult]:
    asked = DigitSettings.model_validate({"serial": "D20001", **settings})
    found = check_digit("left", asked, dev.parent / "sys", dev, (dev.parent / "rules",))
    return {result.check: result for result in found}


def test_the_force_latency_says_what_it_means_for_slip() -> None:
    observed = gripper.check_latency(0.2).observed
    assert "after about 200 ms" in observed
    assert "turns 2.0 to 7.4 degrees" in observed


def test_a_digit_with_everything_in_order(dev: Path) -> None:
    plug_in(dev.parent / "sys", 0, "D20001", "1-1")
    plug_in(dev.parent / "sys", 1, "D20002", "2-1")
    (dev.parent / "rules").mkdir()
    (dev.parent / "rules" / RULES).touch()
    found = digit(dev)
    assert {result.status for result in found.values()} == {CheckStatus.OK}
    assert "serial D20001, firmware 212, port 1-1, 480 Mbit/s" in found["USB"].observed
    assert "not shared" in found["USB bus"].observed


def test_a_digit_on_a_slow_link_and_another_without_rules(dev: Path) -> None:
    plug_in(dev.parent / "sys", 0, "D20001", "1-1", release="0199", speed="12")
    plug_in(dev.parent / "sys", 1, "D20002", "1-2")
    found = digit(dev, led_rgb=(15, 0, 0))
    assert found["USB"].status is CheckStatus.PROBLEM
    assert "another cable or port" in found["USB"].action
    assert "D20002" in found["USB bus"].observed
    assert "sudo slipguard install" in found["udev rules"].action
    assert "one brightness" in found["LEDs"].observed


def test_a_digit_that_is_another(dev: Path) -> None:
    plug_in(dev.parent / "sys", 0, "D20002", "1-1")
    found = digit(dev)
    assert list(found) == ["USB"]
    assert "D20002" in found["USB"].observed


def test_a_camera_of_another_group(dev: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plug_in(dev.parent / "sys", 0, "D20001", "1-1")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    denied = digit(dev)["access"]
    assert denied.status is CheckStatus.PROBLEM
    assert "usermod -aG" in denied.action


@pytest.mark.parametrize(
    ("rate_hz", "asked_hz", "status"), [(59.2, 60.0, "ok"), (44.0, 60.0, "problem"), (29.9, None, "ok")]
)
def test_rates(rate_hz: float, asked_hz: float | None, status: str) -> None:
    assert sensor.check_rate(rate_hz, asked_hz).status == status


@pytest.mark.parametrize(
    ("came", "lost", "damaged", "interruptions", "status"),
    [(120, 1, 0, 0, "ok"), (117, 3, 0, 0, "note"), (100, 10, 0, 0, "problem"), (120, 0, 0, 1, "problem")],
)
def test_losses(came: int, lost: int, damaged: int, interruptions: int, status: str) -> None:
    assert sensor.check_losses(came, lost, damaged, interruptions).status == status


@pytest.mark.parametrize(("torn", "status"), [(0, "ok"), (2, "note"), (6, "problem")])
def test_torn_frames(torn: int, status: str) -> None:
    assert sensor.check_torn(torn, 120).status == status


def test_the_age_of_a_no_contact_image(tmp_path: Path) -> None:
    store = StateDir(tmp_path)
    now = datetime.now(UTC)
    assert sensor.check_background("D1", store, now).status is CheckStatus.PROBLEM
    store.save_background("D1", BackgroundImage(np.zeros((320, 240, 3), np.uint8), (1.0, 1.0, 1.0), 30))
    assert sensor.check_background("D1", store, now).status is CheckStatus.OK
    old = sensor.check_background("D1", store, now + timedelta(days=60))
    assert (old.status, old.observed) == (CheckStatus.NOTE, "60 days old (limit 30 days)")
    next(tmp_path.glob("sensors/D1/*.png")).write_bytes(b"no image")
    assert sensor.check_background("D1", store, now).status is CheckStatus.PROBLEM


def state(**changes: Any) -> GripperState:
    usual = {"active": True, "moving": False, "holding": False, "closed_on_nothing": False, "width_mm": 85.0}
    return GripperState(**{**usual, "force_n": 0.0, "fault": None, "measured_at_s": 0.0, **changes})


def test_a_gripper_that_is_not_activated_or_at_fault() -> None:
    (idle,) = gripper.check_state(state(active=False))
    assert (idle.status, "slipguard ctl activate" in idle.action) == (CheckStatus.NOTE, True)
    (faulty,) = gripper.check_state(state(fault="overcurrent"))
    assert (faulty.status, faulty.observed) == (CheckStatus.PROBLEM, "fault: overcurrent")


def test_a_slow_line_and_a_lossy_one() -> None:
    assert gripper.check_round_trips([0.005] * 100, 0).status is CheckStatus.OK
    assert gripper.check_round_trips([0.018] * 100, 0).status is CheckStatus.NOTE
    assert gripper.check_round_trips([0.005] * 95, 5).status is CheckStatus.PROBLEM
    assert gripper.check_round_trips([], 10).status is CheckStatus.PROBLEM


def test_a_state_folder_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert machine.check_state_folder(tmp_path / "file" / "state").status is CheckStatus.PROBLEM
    assert machine.check_state_folder(tmp_path / "new" / "state").status is CheckStatus.OK


def test_what_to_do_comes_out_of_our_own_errors() -> None:
    found = problem_from_error("sensor", DeviceLost("left: it is gone; plug it in"), "left", "look")
    assert (found.observed, found.action) == ("it is gone", "plug it in")
    assert problem_from_error("sensor", DeviceLost("left: it is gone"), "left", "look").action == "look"


class Strange:
    """A third party's driver that has a look of its own, and fails in it."""

    class Settings(BaseModel):
        pass

    def __init__(self, settings: BaseModel, context: object) -> None:
        pass

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        yield ok("cable", "there")
        raise ZeroDivisionError("oops")


class Plain:
    """An arm's driver without one; opening it would be a mistake."""

    class Settings(BaseModel):
        pass

    def __init__(self, settings: BaseModel, context: object) -> None:
        pass


async def ask(config: Config, driver: type, monkeypatch: pytest.MonkeyPatch) -> list[CheckResult]:
    monkeypatch.setattr(registry, "load_driver", lambda group, name: driver)
    return await run_checks._check_device("arm", config, None)


async def test_a_driver_that_fails_is_one_more_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    found = await ask(sim_config(), Strange, monkeypatch)
    assert isinstance(Strange(Strange.Settings(), None), Diagnosable)
    assert [result.status for result in found] == [CheckStatus.OK, CheckStatus.PROBLEM]
    assert "ZeroDivisionError: oops" in found[1].observed


async def test_an_invalid_state_of_a_gripper_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    class OtherClock(Plain):
        force_limits_n = (10.0, 100.0)

        async def open(self) -> None:
            return

        async def state(self) -> GripperState:
            return GripperState(True, False, False, False, 85.0, 0.0, None, datetime.now(UTC).timestamp())

        async def close(self) -> None:
            return

    monkeypatch.setattr(registry, "load_driver", lambda group, name: OtherClock)
    *_, found = await run_checks._check_device("gripper", sim_config(), None)
    assert found.status is CheckStatus.PROBLEM
    assert "in the future; use asyncio.get_running_loop().time()" in found.observed


async def test_an_arm_without_checks_of_its_own_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    (found,) = await ask(sim_config(), Plain, monkeypatch)
    assert (found.status, "no checks of its own" in found.observed) == (CheckStatus.NOTE, True)


async def test_a_check_that_does_not_end_is_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    class Endless(Plain):
        async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
            await asyncio.sleep(3600)
            yield problem("never", "seen", "nothing")

    monkeypatch.setattr(run_checks, "DEVICE_S", 0.05)
    (found,) = await ask(sim_config(), Endless, monkeypatch)
    assert (found.check, found.status) == ("check", CheckStatus.PROBLEM)


@pytest.mark.parametrize(("gel", "status"), [(GelStatus.OK, CheckStatus.OK), (GelStatus.WORN, CheckStatus.NOTE)])
def test_a_gel_that_has_changed_is_a_note_with_what_to_do(gel: GelStatus, status: CheckStatus) -> None:
    unchanged = GelChange((0.0, 0.0, 0.0), 0.0, (), 0)
    finger = FingerState(
        serial="D20479",
        estimate=None,
        frames_per_s=60.0,
        age_s=0.02,
        counts=FrameCounts(frames=100),
        remarks=[],
        gel=GelCondition(gel, unchanged, unchanged, 0.4, "2 lasting marks", "clean the gel"),
    )
    now = holding_state(fingers={"left": finger}, devices={"left": Health("left", "ready", "")})
    before = holding_state(fingers={"left": finger.model_copy(update={"counts": FrameCounts()})})
    *_, found = through_daemon.check_finger("left", through_daemon.DaemonSamples(before, now, 2.0), None)
    assert (found.check, found.observed, found.status) == ("gel", "2 lasting marks", status)
