"""Hostile clients on the TCP port: `release` and `clear` over the Unix socket must be answered in time throughout."""

from __future__ import annotations

import asyncio
import json as jsonlib
import sys
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.terminal import progress_bar
from slipguard.web.host import wait_or_kill
from slipguard.web.sockets import bind_tcp

HOST = "127.0.0.1"
LIMIT_MS = 200.0
PERIOD_S = 0.05
"""Pause between two requests over the Unix socket."""
START_S, EXIT_S, LOST_S = 60.0, 15.0, 10.0
REQUESTS = {"/release": b'{"confirm": true}', "/clear": b"{}"}


@dataclass(frozen=True, slots=True)
class HostileResult:
    """times_ms: of each request over the Unix socket. statuses: of its responses; 0 if none came within 10 s.

    attacks: completed ones by kind. web_process_kept: whether the web process was never replaced.
    """

    seconds: float
    connections: int
    times_ms: list[float]
    statuses: dict[str, int]
    attacks: dict[str, int]
    web_process_kept: bool

    @property
    def failure(self) -> str | None:
        """Why the limit is not met; None if it is."""
        late = [time_ms for time_ms in self.times_ms if time_ms > LIMIT_MS]
        if late:
            total = len(self.times_ms)
            return f"{len(late)} of {total} responses took over {LIMIT_MS:g} ms; the longest {max(late):.0f} ms"
        wrong = {status: count for status, count in self.statuses.items() if status not in ("200", "409")}
        if wrong or not self.web_process_kept:
            return f"statuses {self.statuses}, web process {'kept' if self.web_process_kept else 'replaced'}"
        return None


def hostile_clients(
    seconds: Annotated[float, typer.Option(min=1.0, max=3600.0, help="Length of the attack.")] = 60.0,
    connections: Annotated[int, typer.Option(min=1, max=2000, help="Connections to the TCP port.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Attack the page's port; exit 1 if `release` or `clear` over the Unix socket takes over 200 ms.

    Example: `python -m tests.campaigns hostile-clients --seconds 60`
    """
    with progress_bar("hostile clients") as show, default_interrupts():
        found = asyncio.run(run_attack(seconds, connections, seed, show))
    p50, p99 = np.percentile(found.times_ms, (50, 99))
    figures = {"requests": len(found.times_ms), "p50_ms": p50, "p99_ms": p99, "longest_ms": max(found.times_ms)}
    if json:
        print(jsonlib.dumps(asdict(found) | figures))
    else:
        console = Console(highlight=False)
        for kind, count in sorted(found.attacks.items()):
            console.print(f"{count:8}  {kind}")
        console.print(
            f"{len(found.times_ms)} release and clear: p50 {p50:.1f} ms, p99 {p99:.1f} ms, longest "
            f"{max(found.times_ms):.1f} ms (limit {LIMIT_MS:g} ms); statuses {found.statuses}"
        )
    if found.failure:
        typer.echo(found.failure, err=True)
        raise typer.Exit(1)


async def run_attack(
    seconds: float, connections: int, seed: int, report: Callable[[str, float], None]
) -> HostileResult:
    """Run a simulated daemon, attack its TCP port, and send requests to its Unix socket meanwhile."""
    with tempfile.TemporaryDirectory(prefix="slipguard-hostile-") as name, closing(bind_tcp(HOST, 0)) as probe:
        folder, port = Path(name), int(probe.getsockname()[1])
        probe.close()
        report("starting the daemon", 0.0)
        async with _daemon(folder, port) as pid, _attackers(port, connections, seed) as attackers:
            web_process, times_ms, statuses = _children(pid), list[float](), dict[str, int]()
            loop = asyncio.get_running_loop()
            began_s = loop.time()
            while loop.time() < began_s + seconds:
                path = list(REQUESTS)[len(times_ms) % 2]
                report("under attack", (loop.time() - began_s) / seconds)
                sent_at_s = loop.time()
                status = await _ask(folder / "s", path)
                times_ms.append(1e3 * (loop.time() - sent_at_s))
                statuses[str(status)] = statuses.get(str(status), 0) + 1
                await asyncio.sleep(PERIOD_S)
            kept = _children(pid) == web_process
            assert attackers.stdin is not None
            assert attackers.stdout is not None
            attackers.stdin.close()
            attacks = jsonlib.loads(await attackers.stdout.readline())
    return HostileResult(seconds, connections, times_ms, statuses, attacks, kept)


async def _ask(path: Path, request: str) -> int:
    """Return the status of the response; 0 if none comes."""
    content = REQUESTS[request]
    try:
        async with asyncio.timeout(LOST_S):
            reader, writer = await asyncio.open_unix_connection(path)
            head = f"POST {request} HTTP/1.1\r\nhost: s\r\nconnection: close\r\ncontent-length: {len(content)}\r\n\r\n"
            writer.write(head.encode() + content)
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
            while await _ask(folder / "s", "/clear") == 0:  # noqa: ASYNC110 - another process
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
