"""The daemon's end of the socket to its web process: receives calls, sends responses and events."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import structlog
from pydantic import ValidationError

from slipguard.config_errors import describe_validation_error
from slipguard.daemon.api.daemon_api import DaemonApi
from slipguard.daemon.api.requests import REQUESTS
from slipguard.daemon.loop.event_log import Event
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web.protocol import encode_finger_frame, encode_message, read_message

CONCURRENT_CALLS_MAX = 256
"""More than a web process makes: it has 64 clients on each of its two sockets, so a stop waits for no other call."""
SILENCE_MAX_S = 10.0
"""A web process requests the state ten times per second, so one that is silent for longer is stuck."""
START_MAX_S = 60.0
"""The same until its first message."""
TICK_S = 0.5
SEND_BUFFER_MAX_BYTES = 16 * 1024 * 1024
"""Events are dropped while more than this waits for the web process."""
ESTIMATES_BUFFER_MAX_BYTES = 256 * 1024
"""The same for estimates: these are 200, more than a second of both cameras."""
JSON_METHODS = ("state", "counters", "backgrounds")
FRAME_METHODS = ("frame", "processed_frame", "background")
log = structlog.get_logger()


async def serve_web_process(daemon: DaemonApi, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Respond until the web process closes the connection, or until cancelled; calls in progress are cancelled then.

    Raises SlipguardError if the web process is stuck, or sends an invalid message.
    """
    in_progress: set[asyncio.Task[None]] = set()
    free_calls = asyncio.Semaphore(CONCURRENT_CALLS_MAX)

    def send_event(event: Event) -> None:
        if writer.is_closing() or writer.transport.get_write_buffer_size() >= SEND_BUFFER_MAX_BYTES:
            return
        try:
            writer.write(b"".join(encode_message({"event": asdict(event)})))
        except Exception as bug:  # the event's sender may be the control loop: it must not fail here
            log.warning("an event was not sent to the web process", why=repr(bug))

    async def respond(message: dict[str, Any]) -> None:
        try:
            for piece in await _response(daemon, message):
                writer.write(piece)
        finally:
            free_calls.release()

    def send_estimates(estimates: bytes) -> None:
        if not writer.is_closing() and writer.transport.get_write_buffer_size() < ESTIMATES_BUFFER_MAX_BYTES:
            for piece in encode_message({"estimates": True}, estimates):
                writer.write(piece)

    async def receive_all() -> None:
        while (received := await read_message(reader)) is not None:
            silence.reset()
            if "estimates" in received[0]:
                subscriptions.pop_all().close()
                if received[0]["estimates"]:
                    subscriptions.callback(daemon.subscribe_estimates(send_estimates))
                continue
            await free_calls.acquire()
            task = asyncio.create_task(respond(received[0]), name="web: respond")
            in_progress.add(task)
            task.add_done_callback(in_progress.discard)

    silence = _SilenceTimer()
    unsubscribe, subscriptions = daemon.subscribe(send_event), contextlib.ExitStack()
    receiving = asyncio.create_task(receive_all(), name="web: receive")
    stuck = asyncio.create_task(silence.wait(free_calls.locked), name="web: silence")
    try:
        await asyncio.wait((receiving, stuck), return_when=asyncio.FIRST_COMPLETED)
        if not receiving.done():
            raise SlipguardError("it does not respond")
        receiving.result()
    finally:
        unsubscribe()
        subscriptions.close()
        for task in (*in_progress, receiving, stuck):
            task.cancel()
        await asyncio.gather(*in_progress, receiving, stuck, return_exceptions=True)


class _SilenceTimer:
    """Counts ticks without a message. Ticks, so that a pause of the daemon itself does not count."""

    def __init__(self) -> None:
        self._ticks_left = START_MAX_S / TICK_S

    def reset(self) -> None:
        """Restart after a message."""
        self._ticks_left = SILENCE_MAX_S / TICK_S

    async def wait(self, busy: Callable[[], bool]) -> None:
        """Return after too long a silence; ticks while `busy` do not count."""
        while self._ticks_left > 0:
            await asyncio.sleep(TICK_S)
            if not busy():
                self._ticks_left -= 1


async def _response(daemon: DaemonApi, message: dict[str, Any]) -> list[bytes | memoryview]:
    number, method, arguments = message.get("id"), message.get("call"), message.get("arguments") or {}
    data: list[Any] = []
    result: object = None
    try:
        if method == "submit":
            result = await _submit(daemon, arguments)
        elif method == "health_problem":
            result = await daemon.health_problem()
        elif method in JSON_METHODS:
            data = [await getattr(daemon, method)()]
        elif method in FRAME_METHODS:
            result, data = encode_finger_frame(await getattr(daemon, method)(**arguments))
        else:
            raise SlipguardError(f"the daemon has no method {method!r}")
        return encode_message({"id": number, "result": result}, *data)
    except CommandRefused as refused:
        return encode_message({"id": number, "refused": str(refused)})
    except SlipguardError as failed:
        return encode_message({"id": number, "failed": str(failed)})
    except Exception as bug:
        log.exception("a call of the web process failed", method=method)
        return encode_message({"id": number, "bug": type(bug).__name__})


async def _submit(daemon: DaemonApi, arguments: dict[str, Any]) -> dict[str, object]:
    kind, model = arguments.get("kind"), REQUESTS.get(arguments.get("kind", ""))
    if model is None:
        raise SlipguardError(f"unknown request {kind!r}; known: {', '.join(REQUESTS)}")
    deadline_s = arguments.get("deadline_s", 0.0)
    if not time.monotonic() < deadline_s:
        raise CommandRefused(f"{kind}: reached the daemon too late and was not executed; send it again")
    try:
        request = model.model_validate(arguments.get("fields"))
    except ValidationError as invalid:
        raise SlipguardError(f"{kind}: {describe_validation_error(invalid, model)}") from None
    return dict(await daemon.submit(request, deadline_s))
