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
        self.events: list[str] = []
        self.actuator: Actuator[int]
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

    def does(self, what: str, for_s: float = 0.0) -> Callable[[], Awaitable[None]]:
        """Return a command that notes what it did, after some time."""

        async def act() -> None:
            await asyncio.sleep(for_s)
            self.done.append(what)

        return act

    async def close(self) -> None:
        self.closed += 1

    async def stop(self) -> None:
        self.done.append("stop")
        if self.failure:
            raise self.failure


def on_motor(scenario: Callable[[Motor], Awaitable[None]]) -> Callable[[], None]:
    """Make a scenario with a running actuator a test."""

    async def main() -> None:
        motor = Motor()
        motor.actuator = Actuator("motor", motor, 0.02, 0.5, lambda: None, motor.events.append)
        task = asyncio.create_task(motor.actuator.run())
        try:
            await asyncio.sleep(0.1)
            await scenario(motor)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            assert motor.closed

    return lambda: run_virtual(main())


UNPLUGGED = DeviceLost("motor: unplugged; plug it in")


@on_motor
async def test_it_polls_on_time(motor: Motor) -> None:
    await asyncio.sleep(0.91)
    assert motor.actuator.health.ready
    assert (motor.asked, motor.opened) == (51, 1)


@on_motor
async def test_the_newest_command_is_carried_out_next_and_urgent_ones_come_before_others(motor: Motor) -> None:
    command = motor.actuator.command
    command(motor.does("slow", 0.05))
    await asyncio.sleep(0.01)
    command(motor.does("old"))
    command(motor.does("new"))
    await asyncio.sleep(0.2)
    assert motor.done == ["slow", "new"]
    command(motor.does("hold", 0.05))
    await asyncio.sleep(0.01)
    command(motor.does("tighten"))
    command(motor.does("release"), urgent=True)
    command(motor.does("tighten"))
    command(motor.does("release wider"), urgent=True)
    command(motor.does("halt"))
    await asyncio.sleep(0.2)
    assert motor.done[2:] == ["hold", "release wider"]


@on_motor
async def test_a_stop_does_not_wait_for_a_command_that_is_carried_out(motor: Motor) -> None:
    motor.actuator.command(motor.does("slow", 0.5))
    await asyncio.sleep(0.01)
    motor.actuator.command(motor.stop)
    await asyncio.sleep(0.01)
    assert motor.done == ["stop"]
    await asyncio.sleep(0.6)
    assert motor.done == ["stop", "slow", "stop"], "the command may have begun a motion after the stop"


@on_motor
async def test_a_time_out_is_trouble_and_a_refusal_is_an_event(motor: Motor) -> None:
    motor.failure = DeviceTimeout("motor: no answer for 0.1 s")
    await asyncio.sleep(0.1)
    assert motor.actuator.health.state == "error"
    motor.failure = None
    await asyncio.sleep(0.1)
    assert motor.actuator.health.ready

    async def refused() -> None:
        raise CommandRefused("an object is held; release it first")

    motor.actuator.command(refused)
    await asyncio.sleep(0.1)
    assert motor.events == ["motor: an object is held; release it first"]
    assert motor.opened == 1


@on_motor
async def test_a_command_from_before_the_device_was_lost_is_not_carried_out_after_it(motor: Motor) -> None:
    async def lost_while_asked() -> int:
        motor.actuator.command(motor.does("lift"))
        raise UNPLUGGED

    motor.state = lost_while_asked  # type: ignore[method-assign]
    await asyncio.sleep(0.1)
    assert motor.actuator.health.state == "disconnected"
    motor.actuator.command(motor.does("lift"))
    del motor.state
    await asyncio.sleep(1.0)
    assert motor.actuator.health.ready
    assert motor.done == []


@on_motor
async def test_only_a_stop_reaches_a_lost_device_which_is_taken_up_again(motor: Motor) -> None:
    motor.failure = UNPLUGGED
    await asyncio.sleep(3.0)
    assert (motor.actuator.health.state, motor.actuator.health.reason) == ("disconnected", "unplugged; plug it in")
    assert motor.actuator.newest is None
    for _ in range(3):
        motor.actuator.command(motor.does("lift"))
        await asyncio.sleep(0.01)
        motor.actuator.command(motor.stop)
        await asyncio.sleep(0.01)
    assert motor.done == ["stop"] * 3, "at once, in the middle of the wait"
    assert motor.events == ["motor: unplugged; plug it in"], "the same message is logged once"
    motor.failure = None
    await asyncio.sleep(6.0)
    assert motor.actuator.health.ready
    assert motor.done == ["stop"] * 3


@on_motor
async def test_a_stop_given_while_the_device_is_opened_is_kept(motor: Motor) -> None:
    async def slowly() -> None:
        await asyncio.sleep(1.0)
        if motor.failure:
            raise motor.failure

    motor.open = slowly  # type: ignore[method-assign]
    motor.failure = UNPLUGGED
    await asyncio.sleep(1.0)
    motor.actuator.command(motor.stop)
    await asyncio.sleep(1.5)
    assert motor.done == ["stop"], "it does not open"
    motor.failure = None
    motor.actuator.command(motor.stop)
    await asyncio.sleep(3.0)
    assert motor.done == ["stop"] * 2, "it opens"
