"""The one task that talks to a gripper or an arm: newest command first, else asks for its state."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, Protocol, TypeGuard, TypeVar

from slipguard.cancellation import raise_if_cancelled
from slipguard.daemon.loop.async_tools import Backoff, LatestValue
from slipguard.daemon.loop.device_health import Health
from slipguard.errors import CommandRefused, DeviceError, DeviceLost

S_co = TypeVar("S_co", covariant=True)
S = TypeVar("S")
ROUND_TRIPS = 400
"""Ten seconds of them at the usual 25 ms."""
Action = Callable[[], Awaitable[object]]


class Device(Protocol[S_co]):
    """What `Gripper` and `Arm` have in common."""

    async def open(self) -> None: ...

    async def state(self) -> S_co: ...

    async def close(self) -> None: ...


class Actuator(Generic[S]):
    """Runs one device for as long as the daemon lives; a missing one is waited for.

    A command is any coroutine function; a newer one replaces one not yet begun (a firm one only if it is firm too), one
    begun is let finish. A command that could not be carried out is not tried again, nor is one given while the device
    was gone: the law sees the state and commands anew. Only the device's own `stop` is tried even then, for it may need
    less than all of the device; what it says is told once. `on_news` is called when the device's health changes, and
    with the state that follows a command.
    """

    def __init__(
        self,
        name: str,
        device: Device[S],
        poll_s: float,
        retry_s: float,
        on_news: Callable[[], None],
        on_event: Callable[[str], None],
    ) -> None:
        self.name = name
        self.health = Health(name)
        self.newest: S | None = None
        self.polled = 0
        self.round_trips_s: deque[float] = deque(maxlen=ROUND_TRIPS)
        """How long the newest answers to a question for the state took."""
        self._device = device
        self._poll_s = poll_s
        self._backoff = Backoff(retry_s / 5, longest_s=retry_s / 2)  # what is held or moved waits for it
        self._commands: LatestValue[Action] = LatestValue()
        self._firm = False
        """Only a firm command may replace what was commanded last."""
        self._wake = asyncio.Event()
        self._told: str | None = None
        self._on_news = on_news
        self._on_event = on_event

    def command(self, action: Action, *, firm: bool = False) -> None:
        """Carry out `action` as soon as the device is free. firm: no command that is not may take its place."""
        if self._firm and not firm:
            return
        self._firm = firm
        self._commands.put(action)
        self._wake.set()

    def _next(self) -> Action | None:
        self._firm = False
        return self._commands.take()

    async def run(self) -> None:
        """Command and poll until cancelled; the device is left as it is."""
        try:
            while True:
                raise_if_cancelled()
                try:
                    await self._device.open()
                    raise_if_cancelled()
                    self._told = None
                    pending = self._next()
                    if self._is_stop(pending):
                        self._commands.put(pending)
                    await self._serve()
                except DeviceError as error:
                    self.health.set_disconnected(str(error))
                    self.newest = None
                    self._on_news()
                    await self._device.close()
                    await self._wait()
        finally:
            await self._device.close()

    def _is_stop(self, action: Action | None) -> TypeGuard[Action]:
        return action is not None and action == getattr(self._device, "stop", None)

    async def _wait(self) -> None:
        """Until the device is to be tried again. A stop is passed on at once, all else is dropped."""
        waiting = asyncio.create_task(self._backoff.wait(), name=f"{self.name}: waits")
        waiting.add_done_callback(lambda _: self._wake.set())
        try:
            while not waiting.done():
                raise_if_cancelled()
                self._wake.clear()
                action = self._next()
                if self._is_stop(action):
                    await self._try(action)
                elif not waiting.done():
                    await self._wake.wait()
        finally:
            waiting.cancel()
            await asyncio.wait([waiting])

    async def _try(self, stop: Action) -> None:
        try:
            await stop()
        except (CommandRefused, DeviceError) as error:
            if str(error) != self._told:
                self._told = str(error)
                self._on_event(self._told)

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()
        next_poll_s = loop.time()
        while True:
            self._wake.clear()
            action = self._next()
            try:
                if action is not None:
                    await action()
                if action is not None or loop.time() >= next_poll_s:
                    asked_at_s = loop.time()
                    self.newest = await self._device.state()
                    self.round_trips_s.append(loop.time() - asked_at_s)
                    self.polled += 1
                    if action is not None or not self.health.ready:
                        self._on_news()
                    self.health.set_ready(loop.time())
                    self._backoff.reset()
                    next_poll_s = loop.time() + self._poll_s
            except CommandRefused as error:
                self._on_event(f"{self.name}: {error}")
            except DeviceLost:
                raise
            except DeviceError as error:
                self.health.set_error(str(error))
                self._on_news()
                next_poll_s = loop.time() + self._poll_s
            raise_if_cancelled()
            timer = loop.call_at(next_poll_s, self._wake.set)
            try:
                await self._wake.wait()
            finally:
                timer.cancel()
