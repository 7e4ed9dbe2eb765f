"""Hostile clients of a daemon's TCP port, in a process of their own: `python -m ... HOST PORT CONNECTIONS SEED`.

Each connection repeats one kind of attack until this process's standard input is closed; then the numbers of attacks
are printed as one line of JSON. The process runs at a lower priority, since such clients usually run on other machines.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import random
import sys
from collections import Counter
from collections.abc import Callable

PATHS = ("/state", "/metrics", "/openapi.json", "/image/left", "/frame/right", "/page/page.js", "/", "/nowhere")
COMMANDS = ("/release", "/clear", "/grasp", "/lift", "/page-link", "/calibrate")
WAIT_S = 2.0
"""A connection waits this long for a response before it attacks again."""


def head(host: str, method: str, path: str, *headers: str) -> bytes:
    """Return a request line with its headers."""
    return "\r\n".join((f"{method} {path} HTTP/1.1", f"host: {host}", *headers, "", "")).encode("latin-1")


def silent(draw: random.Random, host: str) -> bytes:
    """Nothing: the connection is only open."""
    return b""


def noise(draw: random.Random, host: str) -> bytes:
    """Bytes that are no request."""
    return draw.randbytes(draw.randint(1, 100_000))


def broken_head(draw: random.Random, host: str) -> bytes:
    """A request with random bytes changed."""
    request = bytearray(head(host, "GET", draw.choice(PATHS), "accept: */*", "connection: keep-alive"))
    for _ in range(draw.randint(1, 8)):
        request[draw.randrange(len(request))] = draw.randrange(256)
    return bytes(request)


def many_headers(draw: random.Random, host: str) -> bytes:
    """Short headers without end, below and above the limit."""
    return head(host, "GET", "/access", *(f"x{number}: y" for number in range(draw.choice((500, 1500, 20_000)))))


def long_header(draw: random.Random, host: str) -> bytes:
    """One long header, or a long path."""
    size = draw.choice((8_000, 15_000, 200_000))
    return draw.choice((head(host, "GET", "/access", f"x: {'y' * size}"), head(host, "GET", "/" + "y" * size)))


def cookie(draw: random.Random, host: str) -> bytes:
    """A cookie that a quadratic parser needs seconds for."""
    size = draw.choice((8_000, 15_000, 60_000, 120_000))
    value = draw.choice(('slipguard="' + "\\" * size + '"', 'x="' + '\\"' * (size // 2) + '"', "a=b;" * (size // 4)))
    return head(draw.choice((host, "evil.example")), "GET", "/state", f"cookie: {value}")


def body(draw: random.Random, host: str) -> bytes:
    """A command with an oversized, deep, endless or wrong body and a wrong token."""
    sent = draw.choice((b"[" * 100_000, b'{"force_n": 1e999}', draw.randbytes(5_000), b'{"a":' * 3_000))
    length = draw.choice((f"content-length: {len(sent)}", "content-length: 999999999", "transfer-encoding: chunked"))
    chunked = b"%x\r\n%s\r\n" % (len(sent), sent) if length.startswith("transfer") else sent
    return head(host, "POST", draw.choice(COMMANDS), "authorization: Bearer " + "0" * 64, length) + chunked


def pipelined(draw: random.Random, host: str) -> bytes:
    """Many valid requests at once."""
    return b"".join(head(host, "GET", draw.choice(PATHS)) for _ in range(50))


def stream(draw: random.Random, host: str) -> bytes:
    """Open the live stream, then send what is no frame."""
    upgrade = ("connection: upgrade", "upgrade: websocket", "sec-websocket-version: 13")
    return head(host, "GET", "/live", *upgrade, "sec-websocket-key: AAAAAAAAAAAAAAAAAAAAAA==") + draw.randbytes(500)


ATTACKS: tuple[Callable[[random.Random, str], bytes], ...] = (
    *(silent, noise, broken_head, many_headers, long_header, cookie, body, pipelined, stream),
)


async def attack(number: int, host: str, port: int, seed: int, done: Counter[str]) -> None:
    """Repeat one kind of attack: with reading, without reading, or byte by byte."""
    draw = random.Random(f"{seed}-{number}")
    make, reading = ATTACKS[number % len(ATTACKS)], ("reads", "never reads", "byte by byte")[number // len(ATTACKS) % 3]
    while True:
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            reader, writer = await asyncio.open_connection(host, port, limit=4096)
            try:
                async with asyncio.timeout(WAIT_S):
                    request = make(draw, f"{host}:{port}")
                    if reading == "byte by byte":
                        for start in range(min(len(request), 20)):
                            writer.write(request[start : start + 1])
                            await asyncio.sleep(0.1)
                    else:
                        writer.write(request)
                        await writer.drain()
                        if reading == "reads":
                            await reader.read(65_536)
                        else:
                            await asyncio.sleep(WAIT_S)
            finally:
                done[f"{make.__name__}, {reading}"] += 1
                writer.transport.abort()
        await asyncio.sleep(draw.uniform(0.0, 0.05))


async def _main(host: str, port: int, connections: int, seed: int) -> None:
    done: Counter[str] = Counter()
    tasks = [asyncio.create_task(attack(number, host, port, seed, done)) for number in range(connections)]
    await asyncio.to_thread(sys.stdin.read)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    print(json.dumps(done), flush=True)


if __name__ == "__main__":
    logging.disable()  # asyncio reports each connection that the server has closed
    os.nice(10)
    asyncio.run(_main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])))
