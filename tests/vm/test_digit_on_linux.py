"""The DIGIT driver on a real kernel: rates on the kernel's test camera, behaviour on emulated DIGITs over USB/IP."""

from __future__ import annotations

import pytest
from machine import Machine

pytestmark = pytest.mark.vm

ATTEMPTS = 4
"""The kernel and the driver are measured, not what else this host is doing: the best of several attempts counts."""
ROTATED_GREY_LEVELS = 4.0
"""Colors survive YUYV within a gray level or two; an image rotated or mirrored is off by tens."""


def test_sixty_frames_a_second_of_which_none_is_lost(machine: Machine) -> None:
    for attempt in range(ATTEMPTS):
        with machine.undisturbed():
            seen = machine.play("scenes:rates", seconds=5.0)
        print(f"attempt {attempt}: {seen}")
        if seen["lost"] <= 0.005 * seen["handed_out"] and seen["fps"] == pytest.approx(60.0, abs=0.6):
            break
    else:
        pytest.fail(f"vivid at 60 frames per second: {seen}")
    assert seen["mode"] == "320x240 YUYV at 60 frames per second"
    assert seen["remarks"] == ["the LEDs cannot be set (Invalid argument); led_rgb has no effect"], "vivid has none"


def test_two_sensors_are_found_by_serial_with_leds_access_and_their_own_images(machine: Machine) -> None:
    seen = machine.play("scenes:two_sensors")
    assert seen["serials"] == ["D20001", "D20002"]
    assert seen["firmware"] == [212, 212]
    assert (seen["groups"], seen["modes"]) == (["video"] * 2, ["0o660"] * 2), "what systemd/60-slipguard.rules says"
    for serial in seen["serials"]:
        assert f"usb-Facebook_DIGIT_{serial}-video-index0" in seen["by_id"]
    assert seen["zoom"] == [0xF73, 0x124]
    assert seen["modes_given"] == ["320x240 YUYV at 30 frames per second"] * 2
    assert seen["in_order"]
    assert max(seen["own"]) < ROTATED_GREY_LEVELS < min(seen["other"])


def test_every_fault_has_a_text(machine: Machine) -> None:
    names = {"stall": "DeviceTimeout", "freeze": "FrameFrozen", "corrupt": "FrameCorrupt", "short": "FrameCorrupt"}
    for attempt in range(ATTEMPTS):
        with machine.undisturbed():
            seen = machine.play("scenes:faults", pixels="YUYV")
        print(f"attempt {attempt}: {seen}")
        assert {fault: seen[fault]["as"] for fault in names} == names
        if seen["stall"]["after_s"] <= 0.5:
            break
    else:
        pytest.fail(f"a stall, and reported only after {seen['stall']['after_s']:.2f} s")
    assert machine.play("scenes:faults", pixels="MJPG")["short"]["as"] == "FrameCorrupt"


def test_a_kernel_that_drops_damaged_frames_causes_a_stalled_stream(machine: Machine) -> None:
    seen = machine.play("scenes:faults", pixels="YUYV", nodrop=0)
    assert {seen["corrupt"]["as"], seen["short"]["as"]} == {"DeviceTimeout"}


def test_an_unplugged_sensor_is_reported_at_once(machine: Machine) -> None:
    for attempt in range(ATTEMPTS):
        with machine.undisturbed():
            seen = machine.play("scenes:unplug")
        print(f"attempt {attempt}: {seen}")
        assert seen["as"] == "DeviceLost"
        if seen["after_s"] <= 0.05:
            return
    pytest.fail(f"unplugged, and reported only after {seen['after_s']:.3f} s")


@pytest.mark.parametrize("unplugged_s", [0.5, 2.5])
def test_a_sensor_that_is_plugged_in_again_continues(machine: Machine, unplugged_s: float) -> None:
    for attempt in range(ATTEMPTS):
        with machine.undisturbed():
            seen = machine.play("scenes:replug", unplugged_s=unplugged_s)
        print(f"attempt {attempt}: {seen}")
        assert seen["gone"]
        if seen["again_s"] <= 2.0:
            return
    pytest.fail(f"plugged in again, and frames only after {seen['again_s']:.1f} s")


def test_the_sensor_contract_holds_on_a_real_kernel(machine: Machine) -> None:
    seen = machine.play("scenes:contract", limit_s=300.0)
    assert seen["failed"] == 0, seen["says"]
    assert seen["passed"] >= 5
