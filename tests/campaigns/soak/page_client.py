"""An operator page without a browser: it reads the live stream and fetches both fingers' images.

`python -m tests.campaigns.soak.page_client SOCKET` keeps one open until its standard input ends, then prints what it
received as JSON.
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
IMAGE_EVERY_S = 0.1
AGAIN_S = 1.0


async def open_page(socket: Path, received: Counter[str], image_every_s: float = IMAGE_EVERY_S) -> None:
    """Keep a page open until cancelled; count messages by type, images, refusals and lost connections in `received`."""
    async with asyncio.TaskGroup() as group:
        group.create_task(_listen(socket, received), name="page: live")
        for finger in FINGERS:
            group.create_task(_images(socket, finger, received, image_every_s), name=f"page: {finger}")


async def _listen(socket: Path, received: Counter[str]) -> None:
    while True:
        try:
            # No timeouts: on a virtual clock they would expire before another process runs.
            connection = unix_connect(
                str(socket), uri="ws://slipguard/live", max_size=None, open_timeout=None, ping_interval=None
            )
            async with connection as live:
                async for message in live:
                    received[json.loads(message)["type"]] += 1
        except (OSError, ConnectionClosed):
            received["connections lost"] += 1
        await asyncio.sleep(AGAIN_S)


async def _images(socket: Path, finger: str, received: Counter[str], every_s: float) -> None:
    while True:
        try:
            reader, writer = await asyncio.open_unix_connection(socket)
            with contextlib.closing(writer):
                while True:
                    status = await _get(reader, writer, f"/image/{finger}")
                    received["images" if status == HTTPStatus.OK else f"responses {status}"] += 1
                    await asyncio.sleep(every_s)
        except (OSError, EOFError):
            received["connections lost"] += 1
            await asyncio.sleep(AGAIN_S)


async def _get(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, path: str) -> int:
    """Send one request on a persistent connection, read the whole response, return its status."""
    writer.write(f"GET {path} HTTP/1.1\r\nHost: slipguard\r\n\r\n".encode())
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
    length = next(line for line in head.splitlines() if line.startswith("content-length:"))
    await reader.readexactly(int(length.partition(":")[2]))
    return int(head.split()[1])


async def _main(socket: Path) -> None:
    received: Counter[str] = Counter()
    page = asyncio.create_task(open_page(socket, received))
    await asyncio.to_thread(sys.stdin.read)
    page.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await page
    print(json.dumps(received))


class PageProcess:
    """A page in a process of its own, like a browser."""

    async def open(self, socket: Path) -> None:
        """Start the process."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", __name__, str(socket), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE
        )

    async def close(self) -> Counter[str]:
        """End the process and return what it received."""
        output, _ = await self._process.communicate(b"")  # without input, Python 3.11 leaves the pipe open
        return Counter(json.loads(output or b"{}"))


if __name__ == "__main__":
    asyncio.run(_main(Path(sys.argv[1])))
