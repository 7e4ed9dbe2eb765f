"""The task that owns a gripper or an arm: waits for a missing one, newest command wins, failures are reported."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from slipguard.daemon.loop.actuator import Actuator
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.errors import CommandRefused, DeviceLost, DeviceTimeout


class Motor:
    """A device that counts, and fails on demand."""

    def __init__(self) -> None:
        self.opened = self.closed = self.asked = 0
        self.done: list[str] = []
        self.failure: Exception | None = None

    async def open(self) -> None:
        self.opened += 1
        if isinstance(self.failure, DeviceLost):
            raise self.failure

    async def state(self) -> int:
        self.asked += 1
        if self.failure:
            raise self.failure
        return self.asked

    async def close(self) -> None:
        self.closed += 1

    async def stop(self) -> None:
        self.done.append("stop")
        if self.failure:
            raise self.failure


def drive(scenario: Callable[[Motor, Actuator[int], list[str]], Awaitable[None]]) -> Motor:
    motor, events = Motor(), list[str]()

    async def main() -> None:
        actuator: Actuator[int] = Actuator("motor", motor, 0.02, 0.5, lambda: None, events.append)
        task = asyncio.create_task(actuator.run())
        try:
            await scenario(motor, actuator, events)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    run_virtual(main())
    return motor


def test_it_polls_on_time_and_closes_at_the_end() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        await asyncio.sleep(1.01)
        assert actuator.health.ready

    motor = drive(scenario)
    assert motor.asked == 51
    assert (motor.opened, motor.closed) == (1, 1)


def test_a_newer_command_replaces_one_not_yet_begun() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        await asyncio.sleep(0.1)

        async def slow() -> None:
            motor.done.append("slow")
            await asyncio.sleep(0.05)

        async def old() -> None:
            motor.done.append("old")

        async def new() -> None:
            motor.done.append("new")

        actuator.command(slow)
        await asyncio.sleep(0.01)
        actuator.command(old)
        actuator.command(new)
        await asyncio.sleep(0.2)

    assert drive(scenario).done == ["slow", "new"]


def test_a_stop_does_not_wait_for_a_command_that_is_carried_out() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        await asyncio.sleep(0.1)

        async def slow() -> None:
            await asyncio.sleep(0.5)
            motor.done.append("slow")

        actuator.command(slow)
        await asyncio.sleep(0.01)
        actuator.command(motor.stop)
        await asyncio.sleep(0.01)
        assert motor.done == ["stop"]
        await asyncio.sleep(0.6)

    assert drive(scenario).done == ["stop", "slow", "stop"], "the command may have begun a motion after the stop"


def test_an_urgent_command_is_replaced_by_urgent_ones_only() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        await asyncio.sleep(0.1)

        def does(what: str) -> Callable[[], Awaitable[None]]:
            async def act() -> None:
                motor.done.append(what)
                await asyncio.sleep(0.05)

            return act

        actuator.command(does("hold"))
        await asyncio.sleep(0.01)
        actuator.command(does("tighten"))
        actuator.command(does("release"), urgent=True)
        actuator.command(does("tighten"))
        actuator.command(does("release wider"), urgent=True)
        actuator.command(does("halt"))
        await asyncio.sleep(0.2)
        actuator.command(does("hold again"))
        await asyncio.sleep(0.1)

    assert drive(scenario).done == ["hold", "release wider", "hold again"]


def test_a_lost_device_is_waited_for_and_taken_up_again() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        motor.failure = DeviceLost("motor: unplugged; plug it in")
        await asyncio.sleep(3.0)
        assert actuator.health.state == "disconnected"
        assert actuator.health.reason == "unplugged; plug it in"
        assert actuator.newest is None
        motor.failure = None
        await asyncio.sleep(6.0)
        assert actuator.health.ready

    drive(scenario)


def test_a_time_out_is_trouble_and_a_refusal_is_an_event() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        await asyncio.sleep(0.1)
        motor.failure = DeviceTimeout("motor: no answer for 0.1 s")
        await asyncio.sleep(0.1)
        assert actuator.health.state == "error"
        motor.failure = None
        await asyncio.sleep(0.1)
        assert actuator.health.ready

        async def refused() -> None:
            raise CommandRefused("an object is held; release it first")

        actuator.command(refused)
        await asyncio.sleep(0.1)
        assert events == ["motor: an object is held; release it first"]

    assert drive(scenario).opened == 1


def test_a_command_from_before_the_device_was_lost_is_not_carried_out_after_it() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        async def lift() -> None:
            motor.done.append("lift")

        async def lost_while_asked() -> int:
            actuator.command(lift)
            raise DeviceLost("motor: unplugged; plug it in")

        await asyncio.sleep(0.1)
        motor.state = lost_while_asked  # type: ignore[method-assign]
        await asyncio.sleep(0.1)
        assert actuator.health.state == "disconnected"
        actuator.command(lift)
        del motor.state
        await asyncio.sleep(1.0)
        assert actuator.health.ready

    assert drive(scenario).done == []


def test_a_stop_reaches_a_device_that_does_not_open_and_nothing_else_does() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        async def lift() -> None:
            motor.done.append("lift")

        await asyncio.sleep(0.1)
        motor.failure = DeviceLost("motor: unplugged; plug it in")
        await asyncio.sleep(3.0)
        for _ in range(3):
            actuator.command(lift)
            await asyncio.sleep(0.01)
            actuator.command(motor.stop)
            await asyncio.sleep(0.01)
        assert motor.done == ["stop"] * 3, "at once, in the middle of the wait"
        assert events == ["motor: unplugged; plug it in"], "the same message is logged once"
        motor.failure = None
        await asyncio.sleep(1.0)
        assert actuator.health.ready

    assert drive(scenario).done == ["stop"] * 3


def test_a_stop_given_while_the_device_is_opened_is_kept() -> None:
    async def scenario(motor: Motor, actuator: Actuator[int], events: list[str]) -> None:
        async def slowly() -> None:
            await asyncio.sleep(1.0)
            if motor.failure:
                raise motor.failure

        motor.open = slowly  # type: ignore[method-assign]
        await asyncio.sleep(0.5)
        actuator.command(motor.stop)
        await asyncio.sleep(0.6)
        assert motor.done == ["stop"], "it opens"
        motor.failure = DeviceLost("motor: unplugged; plug it in")
        await asyncio.sleep(0.5)
        actuator.command(motor.stop)
        await asyncio.sleep(0.8)
        assert motor.done == ["stop"] * 2, "it does not"

    drive(scenario)
