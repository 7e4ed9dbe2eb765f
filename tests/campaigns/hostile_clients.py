"""Hostile clients on the TCP port: an operator's `release` and `clear` must be answered in time throughout.

The operator sends them in turn over the Unix socket and, with the token, over TCP.
"""

from __future__ import annotations

import asyncio
import json as jsonlib
import sys
import tempfile
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.terminal import progress_bar
from slipguard.web.host import wait_or_kill
from slipguard.web.sockets import bind_tcp
from tests.campaigns.figures import Figure, report

HOST = "127.0.0.1"
LIMIT_MS = 200.0
PERIOD_S = 0.05
"""Pause between two requests of the operator."""
START_S, EXIT_S, LOST_S = 60.0, 15.0, 10.0
REQUESTS = {"/release": b'{"confirm": true}', "/clear": b"{}"}


@dataclass(frozen=True, slots=True)
class HostileResult:
    """times_ms: of each request, by way: "unix" or "tcp". statuses: of the responses; 0 if none came within 10 s.

    attacks: completed ones by kind. web_process_kept: whether the web process was never replaced.
    """

    times_ms: dict[str, list[float]]
    statuses: Counter[int]
    attacks: dict[str, int]
    web_process_kept: bool

    @property
    def figures(self) -> list[Figure]:
        """The figures with their limits."""
        found = [Figure("attacks", sum(self.attacks.values()), 1, at_least=True)]
        for way, times_ms in self.times_ms.items():
            p50_ms, p99_ms = map(float, np.percentile(times_ms, (50, 99)))
            found += [
                Figure(f"{way}: requests", len(times_ms), None),
                Figure(f"{way}: p50_ms", p50_ms, None),
                Figure(f"{way}: p99_ms", p99_ms, LIMIT_MS),
                Figure(f"{way}: longest_ms", max(times_ms), None),
            ]
        wrong = sum(count for status, count in self.statuses.items() if status not in (200, 409))
        return [*found, Figure("wrong responses", wrong), Figure("web process replaced", not self.web_process_kept)]


def hostile_clients(
    seconds: Annotated[float, typer.Option(min=1.0, max=3600.0, help="Length of the attack.")] = 60.0,
    connections: Annotated[int, typer.Option(min=1, max=2000, help="Connections to the TCP port.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Attack the page's port; exit 1 if an operator's request stays unanswered, or their p99 is over 200 ms.

    Example: `python -m tests.campaigns hostile-clients --seconds 60`
    """
    with progress_bar("hostile clients") as show, default_interrupts():
        found = asyncio.run(run_attack(seconds, connections, seed, show))
    report(found.figures, {"statuses": dict(found.statuses), "attacks": found.attacks}, json)


async def run_attack(seconds: float, connections: int, seed: int, show: Callable[[str, float], None]) -> HostileResult:
    """Run a simulated daemon, attack its TCP port, and send an operator's requests meanwhile."""
    with tempfile.TemporaryDirectory(prefix="slipguard-hostile-") as name, closing(bind_tcp(HOST, 0)) as probe:
        folder, port = Path(name), int(probe.getsockname()[1])
        probe.close()
        show("starting the daemon", 0.0)
        async with _daemon(folder, port) as pid, _attackers(port, connections, seed) as attackers:
            web_process, statuses = _children(pid), Counter[int]()
            times_ms: dict[str, list[float]] = {"unix": [], "tcp": []}
            token = (folder / "state" / "token").read_text().strip()
            loop = asyncio.get_running_loop()
            began_s = loop.time()
            while loop.time() < began_s + seconds:
                number = sum(map(len, times_ms.values()))
                way, request = list(times_ms)[number % 2], list(REQUESTS)[number // 2 % 2]
                show("under attack", (loop.time() - began_s) / seconds)
                sent_at_s = loop.time()
                if way == "unix":
                    status = await _ask(request, folder / "s")
                else:
                    status = await _ask(request, port, token)
                times_ms[way].append(1e3 * (loop.time() - sent_at_s))
                statuses[status] += 1
                await asyncio.sleep(PERIOD_S)
            kept = _children(pid) == web_process
            assert attackers.stdin is not None
            assert attackers.stdout is not None
            attackers.stdin.close()
            attacks = jsonlib.loads(await attackers.stdout.readline())
    return HostileResult(times_ms, statuses, attacks, kept)


async def _ask(request: str, to: Path | int, token: str = "") -> int:
    """Send a request to a Unix socket or a port; return the status of the response, 0 if none comes."""
    content = REQUESTS[request]
    try:
        async with asyncio.timeout(LOST_S):
            opening = asyncio.open_unix_connection(to) if isinstance(to, Path) else asyncio.open_connection(HOST, to)
            reader, writer = await opening
            lines = (f"POST {request} HTTP/1.1", f"host: {HOST}:{to}", f"authorization: Bearer {token}")
            writer.write(
                "\r\n".join((*lines, "connection: close", f"content-length: {len(content)}", "", "")).encode() + content
            )
            response = await reader.read()
            writer.close()
            return int(response.split(b" ", 2)[1])
    except (OSError, TimeoutError, IndexError):
        return 0


@asynccontextmanager
async def _daemon(folder: Path, port: int) -> AsyncIterator[int]:
    """Run `slipguard run --sim`; provides its process id when it responds."""
    config = folder / "config.toml"
    config.write_text(
        f'[api]\nsocket = "{folder / "s"}"\nlisten = "{HOST}:{port}"\n[state]\ndirectory = "{folder / "state"}"\n'
        "[recording]\nenabled = false\n"
    )
    words = (sys.executable, "-m", "slipguard", "run", "--sim", "--config", str(config))
    with (folder / "log.txt").open("w") as log:
        process = await asyncio.create_subprocess_exec(*words, stdout=log, stderr=log, process_group=0)
    try:
        async with asyncio.timeout(START_S):
            while await _ask("/clear", folder / "s") == 0:  # noqa: ASYNC110 - another process
                await asyncio.sleep(0.2)
        yield process.pid
    finally:
        process.terminate()
        await wait_or_kill(process, EXIT_S)


@asynccontextmanager
async def _attackers(port: int, connections: int, seed: int) -> AsyncIterator[asyncio.subprocess.Process]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.campaigns.hostile_requests", HOST, str(port), str(connections), str(seed)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        process_group=0,
    )
    try:
        yield process
    finally:
        await wait_or_kill(process, EXIT_S)


def _children(pid: int) -> set[int]:
    """Return the web processes of a daemon."""
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return {int(one) for one in found if b"slipguard.web" in Path(f"/proc/{one}/cmdline").read_bytes()}
