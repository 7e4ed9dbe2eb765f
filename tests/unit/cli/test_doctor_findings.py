"""The doctor's single looks: what is said about figures, folders and drivers that no emulator shows."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from slipguard.config import Config, sim_config
from slipguard.daemon.store.calibration import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import GripperState
from slipguard.diagnosis import Diagnosable, Finding, Verdict, fine, from_error, wrong
from slipguard.doctor import examine, gripper, machine, sensor, through_daemon
from slipguard.errors import DeviceLost
from slipguard_drivers.digit.diagnostics import RULES, check_digit
from slipguard_drivers.digit.settings import DigitSettings
from slipguard_drivers.robotiq.diagnostics import adapter


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
    """/dev with two cameras, and /sys beside it."""
    (tmp_path / "sys").mkdir()
    (tmp_path / "dev").mkdir()
    for number in (0, 1):
        (tmp_path / "dev" / f"video{number}").touch()
    return tmp_path / "dev"


def digit(dev: Path, **settings: Any) -> dict[str, Finding]:
    asked = DigitSettings.model_validate({"serial": "D20001", **settings})
    found = check_digit("left", asked, dev.parent / "sys", dev, (dev.parent / "rules",))
    return {finding.what: finding for finding in found}


def test_a_digit_with_everything_in_order(dev: Path) -> None:
    plug_in(dev.parent / "sys", 0, "D20001", "1-1")
    plug_in(dev.parent / "sys", 1, "D20002", "2-1")
    (dev.parent / "rules").mkdir()
    (dev.parent / "rules" / RULES).touch()
    found = digit(dev)
    assert {finding.verdict for finding in found.values()} == {Verdict.FINE}
    assert "serial D20001, firmware 212, port 1-1, 480 Mbit/s" in found["USB"].seen
    assert "not shared" in found["USB bus"].seen


def test_a_digit_on_a_slow_link_beside_another_without_rules(dev: Path) -> None:
    plug_in(dev.parent / "sys", 0, "D20001", "1-1", release="0199", speed="12")
    plug_in(dev.parent / "sys", 1, "D20002", "1-2")
    found = digit(dev, led_rgb=(15, 0, 0))
    assert found["USB"].verdict is Verdict.WRONG
    assert "another cable or port" in found["USB"].do
    assert "D20002" in found["USB bus"].seen
    assert "sudo slipguard install" in found["udev rules"].do
    assert "one brightness" in found["LEDs"].seen


def test_a_digit_that_is_another(dev: Path) -> None:
    plug_in(dev.parent / "sys", 0, "D20002", "1-1")
    found = digit(dev)
    assert list(found) == ["USB"]
    assert "D20002" in found["USB"].seen


def test_a_camera_of_another_group(dev: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plug_in(dev.parent / "sys", 0, "D20001", "1-1")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    denied = digit(dev)["access"]
    assert denied.verdict is Verdict.WRONG
    assert "usermod -aG" in denied.do


def test_the_adapters_latency_timer() -> None:
    assert adapter(None).verdict is adapter(1).verdict is Verdict.FINE
    assert adapter(16).verdict is Verdict.NOTE
    assert "60-slipguard.rules" in adapter(16).do


@pytest.mark.parametrize(
    ("rate_hz", "asked_hz", "verdict"), [(59.2, 60.0, "fine"), (44.0, 60.0, "wrong"), (29.9, None, "fine")]
)
def test_rates(rate_hz: float, asked_hz: float | None, verdict: str) -> None:
    assert sensor.rate(rate_hz, asked_hz).verdict == verdict


@pytest.mark.parametrize(
    ("came", "lost", "damaged", "interruptions", "verdict"),
    [(120, 1, 0, 0, "fine"), (117, 3, 0, 0, "note"), (100, 10, 0, 0, "wrong"), (120, 0, 0, 1, "wrong")],
)
def test_losses(came: int, lost: int, damaged: int, interruptions: int, verdict: str) -> None:
    assert sensor.losses(came, lost, damaged, interruptions).verdict == verdict


def test_the_age_of_a_no_contact_image(tmp_path: Path) -> None:
    store = StateDir(tmp_path)
    now = datetime.now(UTC)
    assert sensor.no_contact("D1", store, now).verdict is Verdict.WRONG
    store.save_background("D1", BackgroundImage(np.zeros((320, 240, 3), np.uint8), (1.0, 1.0, 1.0), 30))
    assert sensor.no_contact("D1", store, now).verdict is Verdict.FINE
    old = sensor.no_contact("D1", store, now + timedelta(days=60))
    assert (old.verdict, old.seen) == (Verdict.NOTE, "60 days old")
    next(tmp_path.glob("sensors/D1/*.png")).write_bytes(b"no picture")
    assert sensor.no_contact("D1", store, now).verdict is Verdict.WRONG


def state(**changes: Any) -> GripperState:
    usual = {"active": True, "moving": False, "holding": False, "closed_on_nothing": False, "width_mm": 85.0}
    return GripperState(**{**usual, "force_n": 0.0, "fault": None, "measured_at_s": 0.0, **changes})


def test_a_gripper_that_is_not_activated_or_at_fault() -> None:
    (idle,) = gripper.condition(state(active=False))
    assert (idle.verdict, "open and close fully" in idle.do) == (Verdict.NOTE, True)
    (faulty,) = gripper.condition(state(fault="overcurrent"))
    assert (faulty.verdict, faulty.seen) == (Verdict.WRONG, "fault: overcurrent")


def test_a_slow_line_and_a_lossy_one() -> None:
    assert gripper.round_trip([0.005] * 100, 0).verdict is Verdict.FINE
    assert gripper.round_trip([0.018] * 100, 0).verdict is Verdict.NOTE
    assert gripper.round_trip([0.005] * 95, 5).verdict is Verdict.WRONG
    assert gripper.round_trip([], 10).verdict is Verdict.WRONG


def test_a_state_folder_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert machine.state_folder(tmp_path / "file" / "state").verdict is Verdict.WRONG
    assert machine.state_folder(tmp_path / "new" / "state").verdict is Verdict.FINE


def test_one_core_is_noted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: {0})
    assert machine.processor().verdict is Verdict.NOTE


def test_what_to_do_comes_out_of_our_own_errors() -> None:
    found = from_error("sensor", DeviceLost("left: it is gone; plug it in"), "left", "look")
    assert (found.seen, found.do) == ("it is gone", "plug it in")
    assert from_error("sensor", DeviceLost("left: it is gone"), "left", "look").do == "look"


class Strange:
    """A third party's driver that has a look of its own, and fails in it."""

    class Settings(BaseModel):
        pass

    def __init__(self, settings: BaseModel, context: object) -> None:
        pass

    async def diagnose(self, *, owned: bool) -> AsyncIterator[Finding]:
        yield fine("cable", "there")
        raise ZeroDivisionError("oops")


class Plain:
    """An arm's driver without one; opening it would be a mistake."""

    class Settings(BaseModel):
        pass

    def __init__(self, settings: BaseModel, context: object) -> None:
        pass


async def ask(config: Config, driver: type, monkeypatch: pytest.MonkeyPatch) -> list[Finding]:
    monkeypatch.setattr(examine, "load_driver", lambda group, name: driver)
    return await examine._device("arm", config, None)


async def test_a_driver_that_fails_is_one_more_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    found = await ask(sim_config(), Strange, monkeypatch)
    assert isinstance(Strange(Strange.Settings(), None), Diagnosable)
    assert [finding.verdict for finding in found] == [Verdict.FINE, Verdict.WRONG]
    assert "ZeroDivisionError: oops" in found[1].seen


async def test_an_arm_without_a_look_of_its_own_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    (found,) = await ask(sim_config(), Plain, monkeypatch)
    assert (found.verdict, "no look of its own" in found.seen) == (Verdict.NOTE, True)


async def test_a_look_that_does_not_end_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    class Endless(Plain):
        async def diagnose(self, *, owned: bool) -> AsyncIterator[Finding]:
            await asyncio.sleep(3600)
            yield wrong("never", "seen", "nothing")

    monkeypatch.setattr(examine, "DEVICE_S", 0.05)
    (found,) = await ask(sim_config(), Endless, monkeypatch)
    assert (found.what, found.verdict) == ("look", Verdict.WRONG)


@pytest.mark.parametrize("known", ["fine", "drifted", "marked", "worn"])
def test_a_gel_that_has_changed_is_a_note_with_what_to_do(known: str) -> None:
    told = {"verdict": known, "seen": "2 lasting marks", "do": "" if known == "fine" else "clean the gel"}
    found = through_daemon.gel(told)
    assert (found.what, found.seen, found.do) == ("gel", told["seen"], told["do"])
    assert found.verdict is (Verdict.FINE if known == "fine" else Verdict.NOTE)
