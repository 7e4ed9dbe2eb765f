"""An open operator's page without a browser: the live stream heard, both fingers' pictures fetched.

`python -m slipguard.lab.soak.page SOCKET` keeps one open until its standard input ends, then tells what it got as JSON.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections import Counter
from pathlib import Path

import httpx
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
            async with unix_connect(str(socket), uri="ws://slipguard/live", max_size=None) as live:
                async for message in live:
                    got[json.loads(message)["type"]] += 1
        except (OSError, ConnectionClosed):
            got["connections lost"] += 1
        await asyncio.sleep(AGAIN_S)


async def _pictures(socket: Path, finger: str, got: Counter[str], every_s: float) -> None:
    async with httpx.AsyncClient(transport=httpx.AsyncHTTPTransport(uds=str(socket))) as client:
        while True:
            try:
                answer = await client.get(f"http://slipguard/picture/{finger}")
                got["pictures" if answer.status_code == httpx.codes.OK else f"answers {answer.status_code}"] += 1
            except httpx.TransportError:
                got["connections lost"] += 1
                await asyncio.sleep(AGAIN_S)
            await asyncio.sleep(every_s)


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
        told, _ = await self._process.communicate()
        return Counter(json.loads(told or b"{}"))


if __name__ == "__main__":
    asyncio.run(_until_told(Path(sys.argv[1])))
