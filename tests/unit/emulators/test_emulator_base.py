"""Faults on demand, with the same names in all emulators."""

from __future__ import annotations

import json

import pytest

from slipguard.emulator import Event
from slipguard.errors import CommandRefused
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand, FaultPlan

KINDS = {"late": "an answer comes late", "deaf": "requests are ignored"}


class Lamp(ControlledEmulator):
    """A minimal emulator."""

    def __init__(self, reported: list[Event]) -> None:
        super().__init__(KINDS, seed=3, report=reported.append)
        self.changes = 0

    @property
    def address(self) -> str:
        return "lamp"

    async def start(self) -> None:
        """Nothing to start."""

    async def stop(self) -> None:
        """Nothing to stop."""

    def state(self) -> dict[str, object]:
        return {"lit": True, "faults": self.faults.active}

    def commands(self) -> dict[str, EmulatorCommand]:
        return {"blink": (lambda rest: f"blinks {len(rest)}", "blink: blink")}

    def fault_changed(self) -> None:
        self.changes += 1


@pytest.fixture
def lamp() -> Lamp:
    return Lamp([])


def test_a_fault_without_an_amount_lasts_until_cleared() -> None:
    plan = FaultPlan(KINDS)
    assert not plan.occurs("late")
    plan.set("late")
    assert all(plan.occurs("late") for _ in range(10))
    assert plan.lasts("late")
    assert not plan.lasts("deaf")
    plan.clear("late")
    assert not plan.occurs("late")
    assert plan.occurred == {"late": 10, "deaf": 0}


def test_a_count_is_used_up() -> None:
    plan = FaultPlan(KINDS)
    plan.set("late", 3)
    assert [plan.occurs("late") for _ in range(5)] == [True, True, True, False, False]
    assert plan.active == {}
    assert not plan.lasts("late")


def test_a_probability_is_one_and_the_seed_decides() -> None:
    def occurs(seed: int) -> list[bool]:
        plan = FaultPlan(KINDS, seed)
        plan.set("late", 0.2)
        return [plan.occurs("late") for _ in range(2000)]

    assert 300 < sum(occurs(1)) < 500
    assert occurs(1) == occurs(1) != occurs(2)


def test_the_commands(lamp: Lamp) -> None:
    assert lamp.control("fault late 0.01") == "late: 0.01 of the time"
    assert lamp.control("fault deaf 2") == "deaf: 2 times more"
    assert json.loads(lamp.control("state"))["faults"] == {"late": "0.01 of the time", "deaf": "2 times more"}
    assert lamp.control("clear late") == "cleared late"
    assert lamp.control("clear") == "cleared all faults"
    assert lamp.control("fault deaf") == "deaf: until cleared"
    assert lamp.changes == 5
    assert lamp.control("blink a b") == "blinks 2"
    assert "requests are ignored" in lamp.control("fault")
    assert all(word in lamp.control("help") for word in ("fault", "clear", "state", "log", "blink"))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("fault never", "late, deaf"),
        ("fault late 1.5", "0 to 1"),
        ("fault late 0", "at least 1"),
        ("fault late often", "neither a probability"),
        ("fault late nan", "probability"),
        ("fault late -1", "probability"),
        ("clear never", "late, deaf"),
        ("log many", "not a number"),
        ("jump", "blink"),
        ("", "blink"),
    ],
)
def test_unknown_commands_are_refused_with_the_known_ones(lamp: Lamp, line: str, says: str) -> None:
    with pytest.raises(CommandRefused, match=says):
        lamp.control(line)


async def test_events_are_logged_and_reported() -> None:
    reported: list[Event] = []
    lamp = Lamp(reported)
    assert lamp.control("log") == "no events yet"
    lamp.note("lit", watts=40)
    lamp.note("out")
    assert [event["event"] for event in reported] == ["lit", "out"]
    assert [event["watts"] for event in lamp.events("lit")] == [40]
    assert json.loads(lamp.control("log 1"))["event"] == "out"
    assert lamp.control("log").count("\n") == 1
    assert lamp.control("log 99").count("\n") == 1
