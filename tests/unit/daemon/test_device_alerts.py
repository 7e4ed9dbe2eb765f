"""A device fault is reported once, in every phase, and so is its end."""

from __future__ import annotations

from dataclasses import replace

import pytest
from observations import arm, gripper, observation

from slipguard.control.messages import Condition, FingerHealth, Observation
from slipguard.control.state import Phase
from slipguard.daemon.loop.device_health import DeviceAlerts, Health, find_problems

TICK_S = 0.01


class Listener:
    def __init__(self) -> None:
        self.reported: list[tuple[float, str]] = []
        self.now_s = 100.0
        self.warned: list[str] = []
        self.alerts = DeviceAlerts(self._say, self._warn)

    def _say(self, line: str) -> None:
        self.reported.append((round(self.now_s, 2), line))

    def _warn(self, line: str) -> None:
        self.warned.append(line)
        self._say(line)

    def report(self, why: str | None, seconds: float, phase: Phase = Phase.HOLDING) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.now_s += TICK_S
            self.alerts.update(self.now_s, {"left": why}, phase, 0.5)

    @property
    def lines(self) -> list[str]:
        return [line for _, line in self.reported]


def well() -> Listener:
    listener = Listener()
    listener.report(None, 1.0)
    return listener


def test_a_lasting_problem_and_its_end_are_logged_once() -> None:
    listener = well()
    listener.report("left: no frame for 250 ms", 0.14)
    assert listener.lines == []
    listener.report("left: no frame for 260 ms", 3.0)
    assert listener.lines == ["left: no frame for 260 ms"]
    listener.report(None, 0.4)
    assert len(listener.reported) == 1
    listener.report(None, 0.2)
    assert listener.lines[1:] == ["left: works again"]
    assert listener.warned == ["left: no frame for 260 ms"]
    listener.report(None, 3.0)
    assert len(listener.reported) == 2


def test_one_glitch_is_not_logged_but_three_in_a_second_are() -> None:
    listener = well()
    for _ in range(2):
        listener.report("glitch", 0.02)
        listener.report(None, 0.2)
    assert listener.lines == []
    listener.report("glitch", 0.02)
    assert listener.lines == ["left: glitch"]
    listener = well()
    for _ in range(6):
        listener.report("glitch", 0.02)
        listener.report(None, 0.6)
    assert listener.lines == []


def test_a_second_problem_is_logged_too_but_with_a_limited_rate() -> None:
    listener = well()
    listener.report("one", 1.0)
    listener.report("other", 1.0)
    assert listener.lines == ["left: one", "left: other"]
    for _ in range(100):
        listener.report("one", 0.01)
        listener.report("other", 0.01)
    assert len(listener.reported) <= 2 + 7


@pytest.mark.parametrize(("wait_s", "lines"), [(1.9, 0), (2.1, 1)])
def test_a_device_not_tried_yet_is_logged_after_the_start_time(wait_s: float, lines: int) -> None:
    listener = Listener()
    listener.report("not tried yet", wait_s)
    assert len(listener.reported) == lines


def test_a_device_missing_at_the_start_is_logged_soon() -> None:
    listener = Listener()
    listener.report("left: no DIGIT with serial D1; plug it in", 0.3)
    assert listener.lines == ["left: no DIGIT with serial D1; plug it in"]


@pytest.mark.parametrize("phase", Phase)
def test_a_late_loop_is_logged_in_phases_without_a_fault(phase: Phase) -> None:
    listener = well()
    for late_s, lines in ((0.45, 0), (0.55, phase in (Phase.IDLE, Phase.RELEASED))):
        listener.now_s += late_s
        listener.report(None, TICK_S, phase)
        assert len(listener.reported) == lines


def found(view: Observation, **not_ready: str) -> dict[str, str | None]:
    devices = {name: Health(name, "ready", "") for name in ("left", "right", "gripper", "arm")}
    for name, why in not_ready.items():
        devices[name].set_disconnected(why)
    holders = {name: type("One", (), {"health": health})() for name, health in devices.items()}
    return {name: why for name, why in find_problems(view, holders).items() if why is not None}


def test_problems_are_described_by_device() -> None:
    fine = observation(10.0)
    assert found(fine) == {}
    assert found(fine, arm="gone") == {"arm": "gone"}
    for condition in (Condition.STALE, Condition.LATE, Condition.BLIND):
        assert found(replace(fine, left=FingerHealth(condition, 5.0, "why"))) == {"left": "why"}
    assert found(replace(fine, left=FingerHealth(Condition.STALE, float("inf")))) == {}
    assert found(replace(fine, gripper=gripper(fault="overcurrent", at_s=10.0))) == {"gripper": "reports: overcurrent"}
    assert found(replace(fine, gripper=gripper(at_s=9.8), arm=arm(at_s=9.86))) == {
        "gripper": "its newest response is 0.20 s old"
    }
    assert found(replace(fine, arm=arm(at_s=9.8))) == {"arm": "its newest response is 0.20 s old"}
    assert found(replace(fine, arm=arm(at_s=10.0, protective=True))) == {"arm": "in protective stop"}
    assert found(replace(fine, arm=arm(at_s=10.0, protective=True, emergency=True))) == {"arm": "in emergency stop"}
    assert found(replace(fine, gripper=None, arm=None)) == {}


@pytest.mark.parametrize("reason", ["left: no frame for 250 ms", "no frame for 250 ms"])
def test_a_reason_does_not_repeat_the_name_of_its_device(reason: str) -> None:
    health = Health("left")
    for note in (health.set_error, health.set_disconnected):
        note(reason)
        assert health.reason == "no frame for 250 ms"
        assert health.message == "left: no frame for 250 ms"
