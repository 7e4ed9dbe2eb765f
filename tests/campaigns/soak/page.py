"""An open operator's page without a browser: the live stream heard, both fingers' pictures fetched.

`python -m tests.campaigns.soak.page SOCKET` keeps one open until its
standard input ends, then prints what it got as JSON.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections import Counter
from http import HTTPStatus
from pathlib import Path

from websockets.asyncio.client import unix_connect
from websockets.exceptions import ConnectionClosed

FINGERS = ("left", "right")
PICTURE_EVERY_S = 0.1
AGAIN_S = 1.0


async def look(socket: Path, got: Counter[str], picture_every_s: float = PICTURE_EVERY_S) -> None:
    """Look until cancelled; got: messages by type, pictures, refusals and lost connections."""
    async with asyncio.TaskGroup() as group:
        group.create_task(_listen(socket, got), name="page: live")
        for finger in FINGERS:
            group.create_task(_pictures(socket, finger, got, picture_every_s), name=f"page: {finger}")


async def _listen(socket: Path, got: Counter[str]) -> None:
    while True:
        try:
            # No time-outs: on a virtual clock they are over before another process has had its turn.
            patient = unix_connect(
                str(socket), uri="ws://slipguard/live", max_size=None, open_timeout=None, ping_interval=None
            )
            async with patient as live:
                async for message in live:
                    got[json.loads(message)["type"]] += 1
        except (OSError, ConnectionClosed):
            got["connections lost"] += 1
        await asyncio.sleep(AGAIN_S)


async def _pictures(socket: Path, finger: str, got: Counter[str], every_s: float) -> None:
    while True:
        try:
            reader, writer = await asyncio.open_unix_connection(socket)
            with contextlib.closing(writer):
                while True:
                    status = await _get(reader, writer, f"/picture/{finger}")
                    got["pictures" if status == HTTPStatus.OK else f"answers {status}"] += 1
                    await asyncio.sleep(every_s)
        except (OSError, EOFError):
            got["connections lost"] += 1
            await asyncio.sleep(AGAIN_S)


async def _get(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, path: str) -> int:
    """Ask once over a connection that stays open, read the whole answer; its status."""
    writer.write(f"GET {path} HTTP/1.1\r\nHost: slipguard\r\n\r\n".encode())
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
    length = next(line for line in head.splitlines() if line.startswith("content-length:"))
    await reader.readexactly(int(length.partition(":")[2]))
    return int(head.split()[1])


async def _until_told(socket: Path) -> None:
    got: Counter[str] = Counter()
    page = asyncio.create_task(look(socket, got))
    await asyncio.to_thread(sys.stdin.read)
    page.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await page
    print(json.dumps(got))


class PageProcess:
    """A page in a process of its own, as a browser would be."""

    async def open(self, socket: Path) -> None:
        """Begin to look."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", __name__, str(socket), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
        )

    async def close(self) -> Counter[str]:
        """End it; what it got."""
        told, _ = await self._process.communicate(b"")  # without any input Python 3.11 leaves its pipe open
        return Counter(json.loads(told or b"{}"))


if __name__ == "__main__":
    asyncio.run(_until_told(Path(sys.argv[1])))
