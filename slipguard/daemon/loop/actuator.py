"""Talks to the gripper or the arm in one task: sends the newest command, else polls the state."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, Protocol, TypeGuard, TypeVar

from slipguard.cancellation import raise_if_cancelled
from slipguard.daemon.loop.async_tools import Backoff, LatestValue
from slipguard.daemon.loop.device_health import Health
from slipguard.daemon.loop.driver_failure import DRIVER_ERRORS, close_contained, failure_reason
from slipguard.errors import CommandRefused, DeviceError, DeviceLost

S_co = TypeVar("S_co", covariant=True)
S = TypeVar("S")
ROUND_TRIPS = 400
"""Ten seconds of round trips at the default of one every 25 ms."""
Action = Callable[[], Awaitable[object]]


class ActuatorDevice(Protocol[S_co]):
    """What `Gripper` and `Arm` have in common."""

    async def open(self) -> None: ...

    async def state(self) -> S_co: ...

    async def close(self) -> None: ...


class Actuator(Generic[S]):
    """Runs one device until cancelled; a missing device is retried.

    A command is a coroutine function. A newer command replaces one that has not begun (an urgent one only if the newer
    one is urgent too); a command that has begun runs to its end. A failed command is not repeated, and a command given
    while the device is gone is dropped: the controller sees the state and commands again. The exception is the device's
    own `stop`: it does not wait for the command that is carried out, and it is tried even while the device is gone,
    because it may need less than the whole device. Its error is reported once.
    After an unexpected exception of the driver the device is closed and tried again, too.

    Args:
        poll_s: Time between two reads of the state.
        retry_s: Sets the pauses before a missing device is tried again.
        on_change: Called when the device's health changes, and with the state that follows a command.
        on_refusal: Receives the reason why a command was refused, in one line.
        check: Returns a valid state; raises an error of the driver for any other.
        explain: Returns what may explain a device's silence other than the device, to be appended to its reason.
    """

    def __init__(
        self,
        name: str,
        device: ActuatorDevice[S],
        poll_s: float,
        retry_s: float,
        on_change: Callable[[], None],
        on_refusal: Callable[[str], None],
        check: Callable[[S, float], S] = lambda state, now_s: state,
        explain: Callable[[], str] = str,
    ) -> None:
        self.name = name
        self.health = Health(name)
        self.newest: S | None = None
        self.polled = 0
        self.round_trips_s: deque[float] = deque(maxlen=ROUND_TRIPS)
        """How long the newest reads of the state took."""
        self._device = device
        self._poll_s = poll_s
        self._backoff = Backoff(retry_s / 5, longest_s=retry_s / 2)  # a held or moving object waits for this device
        self._commands: LatestValue[Action] = LatestValue()
        self._urgent = False
        """Only an urgent command may replace the waiting one."""
        self._executing = False
        self._stopping: set[asyncio.Task[None]] = set()
        self._wake = asyncio.Event()
        self._reported: str | None = None
        self._on_change = on_change
        self._on_refusal = on_refusal
        self._check = check
        self._explain = explain

    def command(self, action: Action, *, urgent: bool = False) -> None:
        """Carry out `action` as soon as the device is free. urgent: only an urgent command may replace it."""
        if self._urgent and not urgent:
            return
        self._urgent = urgent
        self._commands.put(action)
        self._wake.set()
        if self._executing and self._is_stop(action):  # and once more after that command
            stopping = asyncio.create_task(self._try_stop(action), name=f"{self.name}: stop")
            self._stopping.add(stopping)
            stopping.add_done_callback(self._stopping.discard)

    @property
    def commanding(self) -> bool:
        """Whether a command waits or is carried out."""
        return self._executing or self._commands.waiting

    def _take_command(self) -> Action | None:
        self._urgent = False
        return self._commands.take()

    async def run(self) -> None:
        """Command and poll until cancelled; the device is left as it is."""
        try:
            while True:
                raise_if_cancelled()
                try:
                    await self._device.open()
                    raise_if_cancelled()
                    self._reported = None
                    pending = self._take_command()
                    if self._is_stop(pending):
                        self._commands.put(pending)
                    await self._serve()
                except DRIVER_ERRORS as error:
                    raise_if_cancelled()
                    reason = failure_reason(self._device, error, self.health)
                    explanation = self._explain() if isinstance(error, DeviceError) else ""
                    self.health.set_disconnected(f"{reason}{explanation}")
                    self.newest = None
                    self._on_change()
                    await close_contained(self._device, self.health)
                    await self._wait_to_retry()
        finally:
            for stopping in self._stopping:
                stopping.cancel()
            await asyncio.gather(*self._stopping, return_exceptions=True)
            await close_contained(self._device, self.health)

    def _is_stop(self, action: Action | None) -> TypeGuard[Action]:
        return action is not None and action == getattr(self._device, "stop", None)

    async def _wait_to_retry(self) -> None:
        """Wait until the device is to be tried again. Pass a stop on at once, drop other commands."""
        pause = asyncio.create_task(self._backoff.wait(), name=f"{self.name}: retry pause")
        pause.add_done_callback(lambda _: self._wake.set())
        try:
            while not pause.done():
                raise_if_cancelled()
                self._wake.clear()
                action = self._take_command()
                if self._is_stop(action):
                    await self._try_stop(action)
                elif not pause.done():
                    await self._wake.wait()
        finally:
            pause.cancel()
            await asyncio.wait([pause])

    async def _try_stop(self, stop: Action) -> None:
        try:
            await stop()
        except DRIVER_ERRORS as error:
            raise_if_cancelled()
            reason = failure_reason(self._device, error, self.health)
            if reason != self._reported:
                self._reported = reason
                self._on_refusal(self._reported)

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()
        next_poll_s = loop.time()
        while True:
            self._wake.clear()
            action = self._take_command()
            self._executing = action is not None
            try:
                if action is not None:
                    await action()
                if action is not None or loop.time() >= next_poll_s:
                    asked_at_s = loop.time()
                    self.newest = self._check(await self._device.state(), loop.time())
                    self.round_trips_s.append(loop.time() - asked_at_s)
                    self.polled += 1
                    if action is not None or not self.health.ready:
                        self._on_change()
                    self.health.set_ready(loop.time())
                    self._backoff.reset()
                    next_poll_s = loop.time() + self._poll_s
            except CommandRefused as error:
                self._on_refusal(f"{self.name}: {str(error).removeprefix(f'{self.name}: ')}")
            except DeviceLost:
                raise
            except DeviceError as error:
                self.health.set_error(f"{error}{self._explain()}")
                self._on_change()
                next_poll_s = loop.time() + self._poll_s
            finally:
                self._executing = False
            raise_if_cancelled()
            timer = loop.call_at(next_poll_s, self._wake.set)
            try:
                await self._wake.wait()
            finally:
                timer.cancel()
