"""Many clients of a daemon's API at once, in a process of their own: half hear the live stream, half poll.

`python -m tests.campaigns.api_load_clients HOST PORT CLIENTS`: one line of
 standard input, `come`, brings them, `go` sends
them away, and what they got meanwhile is told as one line of JSON. Clients are other machines' work: here they only get
what the daemon leaves.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections import Counter

from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException

POLL_S = 0.25
"""Each polling client asks this often, in turn for everything that may be seen without the token."""
PATHS = (
    *("/state", "/picture/left", "/state", "/picture/right", "/healthz"),
    *("/state", "/picture/left", "/no-contact", "/picture/right", "/no-contact/left"),
)


async def hear(host: str, port: int, got: Counter[str]) -> None:
    """One client of the live stream."""
    async with connect(f"ws://{host}:{port}/live", max_size=None, compression=None) as live:
        async for _ in live:
            got["live messages"] += 1


async def poll(host: str, port: int, number: int, got: Counter[str]) -> None:
    """One client that asks again and again on one connection."""
    loop = asyncio.get_running_loop()
    reader, writer = await asyncio.open_connection(host, port)
    try:
        for rotation in range(number, sys.maxsize):
            asked_at_s = loop.time()
            path = PATHS[rotation % len(PATHS)]
            writer.write(f"GET {path} HTTP/1.1\r\nhost: {host}:{port}\r\n\r\n".encode())
            head = await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(_length(head))
            got[f"answers {head[9:12].decode()}"] += 1
            await asyncio.sleep(max(0.0, asked_at_s + POLL_S - loop.time()))
    finally:
        writer.close()


def _length(head: bytes) -> int:
    for line in head.lower().split(b"\r\n"):
        if line.startswith(b"content-length:"):
            return int(line.partition(b":")[2])
    return 0


async def crowd(host: str, port: int, clients: int, got: Counter[str]) -> None:
    """All of them until cancelled; one whose connection ends comes again."""

    async def one(number: int) -> None:
        while True:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError, WebSocketException):
                await (hear(host, port, got) if number % 2 else poll(host, port, number, got))
            got["connections lost"] += 1
            await asyncio.sleep(1.0)

    async with asyncio.TaskGroup() as group:
        for number in range(clients):
            group.create_task(one(number), name=f"client {number}")


async def _obey(host: str, port: int, clients: int) -> None:
    got: Counter[str] = Counter()
    here: asyncio.Task[None] | None = None
    while line := await asyncio.to_thread(sys.stdin.readline):
        if line.strip() == "come" and here is None:
            got.clear()
            here = asyncio.create_task(crowd(host, port, clients, got), name="crowd")
        elif line.strip() == "go" and here is not None:
            here.cancel()
            await asyncio.gather(here, return_exceptions=True)
            here = None
            print(json.dumps(got), flush=True)
    if here is not None:
        here.cancel()
        await asyncio.gather(here, return_exceptions=True)


if __name__ == "__main__":
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    asyncio.run(_obey(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
