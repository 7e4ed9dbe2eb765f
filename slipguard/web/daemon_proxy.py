"""The daemon as its web process sees it: every question goes over the socket, every event comes over it."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable, Mapping
from typing import Any

from slipguard.daemon.api.daemon_api import DaemonApi, FingerFrame
from slipguard.daemon.loop.event_log import Event
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web.protocol import COMMANDS, decode_finger_frame, encode_message, read_message

ANSWER_S = 5.0
CALIBRATE_S = 30.0
COMMAND_S = 2.0
"""A command that has not reached the daemon by then is not begun: with the loop's own 2 s, nothing is done that was
reported as failed."""
ApiResponse = tuple[dict[str, Any], bytes]


class DaemonInternalError(Exception):
    """The daemon made one; its log says which."""


class DaemonProxy(DaemonApi):
    """Call `run`. Every question raises CommandRefused, or SlipguardError where the daemon does not answer in time."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._numbers = itertools.count()
        self._waiting: dict[int, asyncio.Future[ApiResponse]] = {}
        self._events: list[Event] = []
        self._ears: list[Callable[[Event], None]] = []
        self.stop = asyncio.Event()
        """Set when the daemon asks to stop."""

    async def run(self) -> None:
        """Take what comes, until the daemon is gone."""
        while (received := await read_message(self._reader)) is not None:
            message, behind = received
            if message.get("stop"):
                self.stop.set()
            elif "event" in message:
                self._heard(Event(**message["event"]))
            elif (waiting := self._waiting.get(message["id"])) is not None and not waiting.done():
                waiting.set_result((message, behind))

    def _heard(self, event: Event) -> None:
        self._events = [*self._events[-49:], event]
        for hear in self._ears:
            hear(event)

    def listen(self, hear: Callable[[Event], None]) -> Callable[[], None]:
        """Tell the newest events, and from then on each as it comes."""
        for event in self._events:
            hear(event)
        self._ears.append(hear)
        return lambda: self._ears.remove(hear)

    async def _ask(
        self, what: str, told: Mapping[str, object] | None = None, within_s: float = ANSWER_S
    ) -> ApiResponse:
        number = next(self._numbers)
        answer: asyncio.Future[ApiResponse] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        try:
            asked: dict[str, object] = {"id": number, "ask": what, "told": told or {}}
            if what in COMMANDS:
                asked["until_s"] = time.monotonic() + COMMAND_S  # one clock for all processes of a machine
            self._writer.write(b"".join(encode_message(asked)))
            async with asyncio.timeout(within_s):
                message, behind = await answer
        except (TimeoutError, ConnectionError):
            raise SlipguardError(f"the daemon did not answer within {within_s:g} s") from None
        finally:
            del self._waiting[number]
        if "refused" in message:
            raise CommandRefused(message["refused"])
        if "trouble" in message:
            raise SlipguardError(message["trouble"])
        if "mistake" in message:
            raise DaemonInternalError(message["mistake"])
        return message, behind

    async def _said(self, what: str, **told: object) -> str:
        return str((await self._ask(what, told))[0]["answer"])

    async def state(self) -> bytes:
        return (await self._ask("state"))[1]

    async def trouble(self) -> str | None:
        why = (await self._ask("trouble"))[0]["answer"]
        return None if why is None else str(why)

    async def tallies(self) -> bytes:
        return (await self._ask("tallies"))[1]

    async def frame(self, finger: str) -> FingerFrame:
        message, pixels = await self._ask("frame", {"finger": finger})
        return decode_finger_frame(message["answer"], pixels)

    async def view(self, finger: str) -> FingerFrame:
        message, pixels = await self._ask("view", {"finger": finger})
        return decode_finger_frame(message["answer"], pixels)

    async def grasp(self, force_n: float | None = None) -> str:
        return await self._said("grasp", force_n=force_n)

    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._said("lift", height_mm=height_mm, speed_mm_s=speed_mm_s)

    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str:
        return await self._said("lower", height_mm=height_mm, speed_mm_s=speed_mm_s)

    async def guard(self, on: bool) -> str:
        return await self._said("guard", on=on)

    async def gripper(self, width_mm: float | None = None, force_n: float | None = None) -> str:
        return await self._said("gripper", width_mm=width_mm, force_n=force_n)

    async def release(self, width_mm: float | None = None) -> str:
        return await self._said("release", width_mm=width_mm)

    async def clear(self) -> str:
        return await self._said("clear")

    async def calibrate(self, force: bool = False, new_gel: bool = False) -> Mapping[str, object]:
        message, _ = await self._ask("calibrate", {"force": force, "new_gel": new_gel}, CALIBRATE_S)
        answer: dict[str, object] = message["answer"]
        return answer

    async def go_back(self, finger: str, number: int) -> str:
        message, _ = await self._ask("go_back", {"finger": finger, "number": number}, CALIBRATE_S)
        return str(message["answer"])

    async def no_contacts(self) -> bytes:
        return (await self._ask("no_contacts"))[1]

    async def no_contact(self, finger: str, number: int | None = None) -> FingerFrame:
        message, pixels = await self._ask("no_contact", {"finger": finger, "number": number})
        return decode_finger_frame(message["answer"], pixels)
