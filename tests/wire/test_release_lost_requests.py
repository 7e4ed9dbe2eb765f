"""A held object is released in every state of the gripper's power, and each request, and each pair, may be lost.

The jaws never close, and "released" is never reported while an object is held.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from itertools import combinations

import pytest
from release_rig import CYCLE_S, ReleaseRig, check_never_narrower, check_reports

from slipguard.control.messages import RequestKind
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard_drivers.robotiq import serial_port

Story = Callable[[ReleaseRig], Awaitable[None]]
KINDS = ("deaf", "silence", "power")
SINGLE, PAIRED = 12, 6
"""How many of the first requests are lost one at a time, and in pairs; a release needs four, the others are polls."""
LOSSES = [
    {},
    *({number: kind} for number in range(SINGLE) for kind in KINDS),
    *({one: kind, other: kind} for one, other in combinations(range(PAIRED), 2) for kind in KINDS),
]


@pytest.fixture(autouse=True)
def _no_other_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_port, "other_holders", lambda port: set())
    monkeypatch.setattr(serial_port, "slow_adapter", lambda port: None)


async def active(rig: ReleaseRig) -> None:
    """Held by an active gripper."""


async def power_lost(rig: ReleaseRig) -> None:
    """rACT is 1 and gFLT 5 after the power came back."""
    rig.lose_power()
    await rig.until(lambda: rig.phase is Phase.FAULT)


async def power_lost_and_reset(rig: ReleaseRig) -> None:
    """rACT is 0 after the power came back."""
    rig.emulator.registers.action_after_power_loss = 0
    await power_lost(rig)


async def overcurrent(rig: ReleaseRig) -> None:
    rig.emulator.registers.fault = 0x0E
    await rig.until(lambda: rig.phase is Phase.FAULT)


async def too_little_voltage(rig: ReleaseRig) -> None:
    """Nothing can move."""
    rig.emulator.registers.fault = 0x0A
    await rig.until(lambda: rig.phase is Phase.FAULT)


async def off(rig: ReleaseRig) -> None:
    """Powered at the wrist, in an emergency stop."""
    rig.emergency = True
    rig.emulator.set_fault("power")
    await rig.until(lambda: rig.phase is Phase.FAULT)
    await rig.until(lambda: rig.actuator.newest is None)


STATES: dict[str, tuple[Story, bool]] = {
    "active": (active, True),
    "power lost": (power_lost, True),
    "power lost, in reset": (power_lost_and_reset, False),
    "overcurrent": (overcurrent, True),
    "too little voltage": (too_little_voltage, False),
    "off": (off, False),
}
"""Each with whether the first release, if nothing is lost, can succeed."""


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("model", ["2F-85", "2F-140", "Hand-E"])
def test_the_jaws_never_close_and_released_is_true(model: str, state: str) -> None:
    prepare, succeeds = STATES[state]

    async def story(rig: ReleaseRig) -> None:
        await prepare(rig)
        await rig.release()
        if rig.phase is not Phase.IDLE:
            assert rig.fault is not None
            assert rig.fault.code is FaultCode.NOT_RELEASED
            assert "support the object" in rig.fault.what_to_do
            await rig.release(again=True)

    for lost in LOSSES:
        rig = ReleaseRig(model, lost)
        run_virtual(rig.run(story))
        check_never_narrower(rig)
        check_reports(rig)
        if succeeds:
            assert rig.phase is Phase.IDLE, (lost, rig.fault)
            assert [one.name for one in rig.reports].count("released") == 1, lost
        elif not lost:
            assert rig.phase is Phase.FAULT


@pytest.mark.parametrize("cycles", range(2, 13))
def test_released_is_true_while_the_jaws_close_too(cycles: int) -> None:
    """They may not have moved yet, or have met the object a moment ago."""

    async def story(rig: ReleaseRig) -> None:
        rig.ask(RequestKind.GRASP)
        await asyncio.sleep(cycles * CYCLE_S)
        assert rig.phase is not Phase.IDLE
        await rig.release()

    for lost in LOSSES:
        rig = ReleaseRig("2F-85", lost)
        run_virtual(rig.run(story, gripped=False))
        check_reports(rig)
        assert rig.emulator.registers.activations == 0
        assert rig.phase in (Phase.IDLE, Phase.FAULT)
        assert not rig.jaws.state_at(math.inf).holds, "whatever was reported"


@pytest.mark.parametrize("model", ["2F-85", "Hand-E"])
def test_after_the_advice_was_followed_the_object_is_out_and_the_gripper_can_be_activated(model: str) -> None:
    """Reset, or without power: switching the gripper off and on sets rACT, and then it opens."""

    async def story(rig: ReleaseRig) -> None:
        await power_lost_and_reset(rig)
        await rig.release()
        assert rig.fault is not None
        assert "switch the gripper off and on" in rig.fault.what_to_do
        assert all("24 V off and on" in reason for reason in rig.refusals)
        assert 0 < len(rig.refusals) < 12
        rig.emulator.registers.action_after_power_loss = 1
        rig.lose_power()
        await rig.release(again=True)
        check_never_narrower(rig)
        assert rig.phase is Phase.IDLE
        assert "must be activated" in rig.reports[-1].text
        rig.jaws.object_mm = None
        rig.ask(RequestKind.ACTIVATE)
        await rig.until(lambda: rig.actuator.newest is not None and rig.actuator.newest.active)

    rig = ReleaseRig(model)
    run_virtual(rig.run(story))
    check_reports(rig)
    assert rig.emulator.registers.activations == 1


def test_without_power_it_is_said_and_with_power_the_release_works() -> None:
    async def story(rig: ReleaseRig) -> None:
        await off(rig)
        await rig.release()
        assert rig.fault is not None
        assert "does not respond" in rig.fault.observed
        assert "give the gripper power, then release again" in rig.fault.what_to_do
        rig.emulator.clear_fault("power")
        rig.emergency = False
        await rig.until(lambda: rig.actuator.newest is not None)
        await rig.release(again=True)
        assert rig.phase is Phase.IDLE

    rig = ReleaseRig("2F-85")
    run_virtual(rig.run(story))
    check_never_narrower(rig)
    check_reports(rig)


def test_an_object_that_stays_in_the_open_jaws_is_not_released() -> None:
    """It sticks to a gel, or was pushed back: the gripper says that it is open and holds nothing."""

    async def story(rig: ReleaseRig) -> None:
        seen = rig._seen
        rig._seen = lambda now_s: seen(now_s) and seen_contact(now_s)  # type: ignore[method-assign]
        await rig.release()
        assert rig.fault is not None
        assert "the left and the right finger still see contact" in rig.fault.observed
        assert rig.fault.what_to_do == "support the object and take it out of the jaws, then clear"
        rig._seen = seen  # type: ignore[method-assign]
        rig.ask(RequestKind.CLEAR)
        await rig.until(lambda: rig.phase is Phase.IDLE)

    def seen_contact(now_s: float) -> object:
        from slipguard.control.finger_fusion import FusedEstimate

        return FusedEstimate(True, True, now_s, now_s, declined="no reference")

    rig = ReleaseRig("2F-85")
    run_virtual(rig.run(story))
    assert [one.name for one in rig.reports].count("released") == 0
