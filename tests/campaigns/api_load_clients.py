"""Many clients of a daemon's API in a process of their own: half read the live stream, half poll.

`python -m tests.campaigns.api_load_clients HOST PORT CLIENTS` reads lines from standard input: `connect` starts the
clients, `disconnect` ends them and prints what they received as one line of JSON. The process runs at idle priority,
since clients usually run on other machines.
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
"""Period of a polling client, which requests the paths in turn."""
PATHS = (
    *("/state", "/image/left", "/state", "/image/right", "/healthz"),
    *("/state", "/image/left", "/background", "/image/right", "/background/left"),
)


async def stream(host: str, port: int, received: Counter[str]) -> None:
    """Read the live stream."""
    async with connect(f"ws://{host}:{port}/live", max_size=None, compression=None) as live:
        async for _ in live:
            received["live messages"] += 1


async def poll(host: str, port: int, number: int, received: Counter[str]) -> None:
    """Request one path after another on one connection."""
    loop = asyncio.get_running_loop()
    reader, writer = await asyncio.open_connection(host, port)
    try:
        for request in range(number, sys.maxsize):
            requested_at_s = loop.time()
            path = PATHS[request % len(PATHS)]
            writer.write(f"GET {path} HTTP/1.1\r\nhost: {host}:{port}\r\n\r\n".encode())
            head = await reader.readuntil(b"\r\n\r\n")
            await reader.readexactly(_content_length(head))
            received[f"responses {head[9:12].decode()}"] += 1
            await asyncio.sleep(max(0.0, requested_at_s + POLL_S - loop.time()))
    finally:
        writer.close()


def _content_length(head: bytes) -> int:
    for line in head.lower().split(b"\r\n"):
        if line.startswith(b"content-length:"):
            return int(line.partition(b":")[2])
    return 0


async def run_clients(host: str, port: int, clients: int, received: Counter[str]) -> None:
    """Run all clients until cancelled; one whose connection ends connects again."""

    async def one(number: int) -> None:
        while True:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError, WebSocketException):
                await (stream(host, port, received) if number % 2 else poll(host, port, number, received))
            received["connections lost"] += 1
            await asyncio.sleep(1.0)

    async with asyncio.TaskGroup() as group:
        for number in range(clients):
            group.create_task(one(number), name=f"client {number}")


async def _main(host: str, port: int, clients: int) -> None:
    received: Counter[str] = Counter()
    running: asyncio.Task[None] | None = None
    while line := await asyncio.to_thread(sys.stdin.readline):
        if line.strip() == "connect" and running is None:
            received.clear()
            running = asyncio.create_task(run_clients(host, port, clients, received), name="clients")
        elif line.strip() == "disconnect" and running is not None:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            running = None
            print(json.dumps(received), flush=True)
    if running is not None:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


if __name__ == "__main__":
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    asyncio.run(_main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
