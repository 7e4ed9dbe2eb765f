"""The daemon's end of the socket to its web process: questions in, answers and events out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import structlog

from slipguard.daemon.api.daemon_api import DaemonApi
from slipguard.daemon.loop.event_log import Event
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web.protocol import COMMANDS, encode_finger_frame, encode_message, read_message

UNDER_WAY_MAX = 100
SILENT_S = 10.0
"""A web process asks for the state ten times a second, so one that says nothing for so long hangs."""
START_S = 60.0
"""... from its first word on; so long may that one take."""
TICK_S = 0.5
BEHIND_MAX_BYTES = 16 * 1024 * 1024
"""A web process that takes nothing for so long that this much waits for it hears no events."""
SPOKEN = (*COMMANDS, "trouble")
TEXTS = ("state", "tallies", "no_contacts")
VIEWS = ("frame", "view", "no_contact")
log = structlog.get_logger()


async def answer(control: DaemonApi, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer until the other side is gone, or cancelled; what is under way then is finished or cancelled with it.

    Raises SlipguardError where the other side hangs, or says what is no message.
    """
    under_way: set[asyncio.Task[None]] = set()
    room = asyncio.Semaphore(UNDER_WAY_MAX)

    def hear(event: Event) -> None:
        if writer.is_closing() or writer.transport.get_write_buffer_size() >= BEHIND_MAX_BYTES:
            return
        try:
            writer.write(b"".join(encode_message({"event": asdict(event)})))
        except Exception as mistake:  # whoever told it, maybe in the middle of the loop's turn, has no part in this
            log.warning("an event did not reach the web process", why=repr(mistake))

    async def one(message: dict[str, Any]) -> None:
        try:
            for piece in await _answered(control, message):
                writer.write(piece)
        finally:
            room.release()

    async def take_all() -> None:
        while (received := await read_message(reader)) is not None:
            pulse.beat()
            await room.acquire()
            task = asyncio.create_task(one(received[0]), name="web: answer")
            under_way.add(task)
            task.add_done_callback(under_way.discard)

    pulse = _Pulse()
    deafen = control.listen(hear)
    taking = asyncio.create_task(take_all(), name="web: questions")
    hanging = asyncio.create_task(pulse.stop(room.locked), name="web: pulse")
    try:
        await asyncio.wait((taking, hanging), return_when=asyncio.FIRST_COMPLETED)
        if not taking.done():
            raise SlipguardError("it hangs")
        taking.result()
    finally:
        deafen()
        for task in (*under_way, taking, hanging):
            task.cancel()
        await asyncio.gather(*under_way, taking, hanging, return_exceptions=True)


class _Pulse:
    """How long nothing was heard, in ticks of our own: where the daemon itself stood still, nobody is blamed for it."""

    def __init__(self) -> None:
        self._left = START_S / TICK_S

    def beat(self) -> None:
        """Something was heard."""
        self._left = SILENT_S / TICK_S

    async def stop(self, busy: Callable[[], bool]) -> None:
        """Until nothing was heard for too long, while we were not too `busy` to listen."""
        while self._left > 0:
            await asyncio.sleep(TICK_S)
            if not busy():
                self._left -= 1


async def _answered(control: DaemonApi, message: dict[str, Any]) -> list[bytes | memoryview]:
    number, what, told = message.get("id"), message.get("ask"), message.get("told")
    behind: list[Any] = []
    try:
        if what in COMMANDS and not time.monotonic() < message.get("until_s", 0.0):
            raise CommandRefused(f"{what} came to the daemon too late and is not done; ask again")
        if what in TEXTS:
            answer, behind = None, [await getattr(control, what)()]
        elif what in VIEWS:
            assert isinstance(told, dict)
            answer, behind = encode_finger_frame(await getattr(control, what)(**told))
        elif what in SPOKEN:
            assert isinstance(told, dict)
            answer = await getattr(control, what)(**told)
        else:
            raise SlipguardError(f"{what!r} is nothing that can be asked")
        return encode_message({"id": number, "answer": answer}, *behind)
    except CommandRefused as refused:
        return encode_message({"id": number, "refused": str(refused)})
    except SlipguardError as trouble:
        return encode_message({"id": number, "trouble": str(trouble)})
    except Exception as mistake:
        log.exception("a question of the web process failed", asked=what)
        return encode_message({"id": number, "mistake": type(mistake).__name__})
