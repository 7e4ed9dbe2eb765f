"""The daemon's end of the socket to its web process: questions in, answers and events out."""

from __future__ import annotations

import asyncio
import time
from dataclasses import asdict
from typing import Any

import structlog

from slipguard.daemon.control import Control
from slipguard.daemon.journal import Event
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web.wire import COMMANDS, packed, receive, view_packed

UNDER_WAY_MAX = 100
BEHIND_MAX_BYTES = 16 * 1024 * 1024
"""A web process that takes nothing for so long that this much waits for it hears no events."""
SPOKEN = (*COMMANDS, "trouble")
TEXTS = ("state", "tallies", "no_contacts")
VIEWS = ("frame", "view", "no_contact")
log = structlog.get_logger()


async def answer(control: Control, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer until the other side is gone, or cancelled; what is under way then is finished or cancelled with it."""
    under_way: set[asyncio.Task[None]] = set()
    room = asyncio.Semaphore(UNDER_WAY_MAX)

    def hear(event: Event) -> None:
        if writer.transport.get_write_buffer_size() < BEHIND_MAX_BYTES:
            writer.writelines(packed({"event": asdict(event)}))

    async def one(message: dict[str, Any]) -> None:
        try:
            for piece in await _answered(control, message):
                writer.write(piece)
        finally:
            room.release()

    deafen = control.listen(hear)
    try:
        while (received := await receive(reader)) is not None:
            await room.acquire()
            task = asyncio.create_task(one(received[0]), name="web: answer")
            under_way.add(task)
            task.add_done_callback(under_way.discard)
    finally:
        deafen()
        for task in under_way:
            task.cancel()
        await asyncio.gather(*under_way, return_exceptions=True)


async def _answered(control: Control, message: dict[str, Any]) -> list[bytes | memoryview]:
    number, what, told = message.get("id"), message.get("ask"), message.get("told")
    behind: list[Any] = []
    try:
        if what in COMMANDS and not time.monotonic() < message.get("until_s", 0.0):
            raise CommandRefused(f"{what} came to the daemon too late and is not done; ask again")
        if what in TEXTS:
            answer, behind = None, [await getattr(control, what)()]
        elif what in VIEWS:
            assert isinstance(told, dict)
            answer, behind = view_packed(await getattr(control, what)(**told))
        elif what in SPOKEN:
            assert isinstance(told, dict)
            answer = await getattr(control, what)(**told)
        else:
            raise SlipguardError(f"{what!r} is nothing that can be asked")
        return packed({"id": number, "answer": answer}, *behind)
    except CommandRefused as refused:
        return packed({"id": number, "refused": str(refused)})
    except SlipguardError as trouble:
        return packed({"id": number, "trouble": str(trouble)})
    except Exception as mistake:
        log.exception("a question of the web process failed", asked=what)
        return packed({"id": number, "mistake": type(mistake).__name__})
