"""The effect of many API clients on the control loop: its latency without and with clients, in alternating blocks.

The daemon with its API runs in this process, the emulated cell and the clients in processes of their own. The blocks
alternate, so that other load on the machine affects both alike.
"""

from __future__ import annotations

import asyncio
import json as jsonlib
import logging
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from slipguard.bench.wire_latency import HOST, StageLatency, config_without_skipping, grip
from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.terminal import progress_bar
from slipguard.daemon import log_setup as log
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.run import build_service
from slipguard.errors import SlipguardError
from slipguard.thread_priority import set_realtime_priority
from slipguard.tools.cell_process import CellProcess
from slipguard.web.host import EXIT_TIMEOUT_S, run_api, wait_or_kill
from slipguard.web.sockets import bind, bind_tcp

SETTLE_S = 1.5
"""Waiting time after clients connected or disconnected, before a block starts."""
SHARE_MAX, RISE_MAX_MS = 0.10, 1.0
RESPONSES_PER_FAILURE = 20
"""The clients need at least this many good responses for each refusal or lost connection."""


@dataclass(frozen=True, slots=True)
class ApiLoadOptions:
    """clients: half read the live stream, half poll. pairs: blocks without and with them. block_s: length of one."""

    clients: int = 50
    pairs: int = 6
    block_s: float = 8.0
    fps: int = 60
    object_name: str = "wrench"


@dataclass(frozen=True, slots=True)
class ApiLoadResult:
    """Latencies of the loop, from a frame's arrival to the decision.

    Attributes:
        without, with_clients: medians over the blocks of p50 and p99, so that single disturbances drop out, and the
            largest of all.
        missed: missed deadlines of the loop without and with clients.
        received: what the clients received.
    """

    options: ApiLoadOptions
    decisions: int
    without: StageLatency
    with_clients: StageLatency
    missed: tuple[int, int]
    received: dict[str, int] = field(default_factory=dict)

    @property
    def rise_ms(self) -> float:
        """Rise of p99."""
        return self.with_clients.p99_ms - self.without.p99_ms

    @property
    def allowed_ms(self) -> float:
        """A tenth of p99, at least one millisecond."""
        return max(SHARE_MAX * self.without.p99_ms, RISE_MAX_MS)

    @property
    def invalid(self) -> str | None:
        """Why the measurement is invalid: each client must be served in each block, few may be refused."""
        polling = -(-self.options.clients // 2)
        expected = {"responses 200": polling, "live messages": self.options.clients - polling}
        failures = sum(count for what, count in self.received.items() if what not in expected)
        few = any(self.received.get(what, 0) < self.options.pairs * count for what, count in expected.items())
        if not few and failures * RESPONSES_PER_FAILURE <= self.received["responses 200"]:
            return None
        received = ", ".join(f"{count} {what}" for what, count in self.received.items()) or "nothing"
        return f"invalid measurement: the {self.options.clients} clients were not served, they received {received}"


def api_load(
    clients: Annotated[int, typer.Option(min=1, max=60, help="Number of clients; half stream, half poll.")] = 50,
    pairs: Annotated[int, typer.Option(min=1, max=100, help="How often to alternate without and with clients.")] = 6,
    block_s: Annotated[float, typer.Option(min=0.5, max=600.0, help="Seconds of each block.")] = 8.0,
    fps: Annotated[Literal["60", "30"], typer.Option(help="Frame rate of the emulated cameras.")] = "60",
    as_service: Annotated[
        bool, typer.Option("--as-service", help="With the real-time priority of the service; needs root.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare the loop's latency without and with clients; exit 1 if it rises too much or they were not served.

    Example: `python -m tests.campaigns api-load --clients 50`
    """
    options = ApiLoadOptions(clients, pairs, block_s, int(fps))
    log.configure(level=logging.CRITICAL)
    if as_service:
        set_realtime_priority()
    with progress_bar("API load") as show, default_interrupts():
        found = asyncio.run(measure_api_load(options, show))
    change = f"p99 changes by {found.rise_ms:+.2f} ms, limit {found.allowed_ms:.2f} ms"
    if json:
        print(jsonlib.dumps(asdict(found) | {"rise_ms": found.rise_ms, "allowed_ms": found.allowed_ms}))
    else:
        _print(found, change)
    risen = f"with {options.clients} clients {change}" if found.rise_ms > found.allowed_ms else None
    if failure := found.invalid or risen:
        typer.echo(failure, err=True)
        raise typer.Exit(1)


def _print(found: ApiLoadResult, change: str) -> None:
    options, (missed, missed_with) = found.options, found.missed
    title = f"{options.pairs} x {options.block_s:g} s each, {options.fps} fps, every frame processed in full"
    table = Table("frame arrival to decision, ms", title=title, title_justify="left")
    for name in ("p50", "p99", "largest", "missed deadlines"):
        table.add_column(name, justify="right")
    rows = (("no clients", found.without, missed), (f"{options.clients} clients", found.with_clients, missed_with))
    for name, one, count in rows:
        table.add_row(name, f"{one.p50_ms:.2f}", f"{one.p99_ms:.2f}", f"{one.largest_ms:.1f}", str(count))
    console = Console(highlight=False)
    console.print(table)
    received = ", ".join(f"{count} {what}" for what, count in found.received.items())
    console.print(f"{change}; the clients received {received}")


async def measure_api_load(options: ApiLoadOptions, report: Callable[[str, float], None]) -> ApiLoadResult:
    """Hold an object while clients connect and disconnect.

    Args:
        report: called with the present step and the share done.

    Raises:
        SlipguardError: the cell did not start, or nothing was decided.
    """
    with tempfile.TemporaryDirectory(prefix="slipguard-api-load-") as name:
        folder = Path(name)
        words = (
            "--activated",
            "--robot-on",
            "--host",
            HOST,
            "--object",
            options.object_name,
            "--fps",
            str(options.fps),
        )
        cell = CellProcess(folder, *words)
        try:
            report("starting the emulated cell", 0.0)
            await cell.start()
            service = build_service(config_without_skipping(cell.config))
            with closing(bind_tcp(HOST, 0)) as probe:
                port = int(probe.getsockname()[1])
            api = run_api(
                RequestHandlers(service), bind(folder / "s"), (HOST, port), folder / "token", service.event_log.warning
            )
            tasks = [asyncio.create_task(service.run(), name="service"), asyncio.create_task(api, name="api")]
            try:
                report("gripping", 0.0)
                await grip(service, tasks[0])
                latencies = _Latencies()
                service.observers.append(latencies.add)
                return await _alternate(options, port, latencies, lambda: service.deadlines_missed, report)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            await cell.stop()


class _Latencies:
    """Collects latencies into the present block; none while `block` is None."""

    def __init__(self) -> None:
        self.block: list[float] | None = None

    def add(self, decision: Decision) -> None:
        if self.block is not None:
            self.block.extend(decision.latencies_s)


async def _alternate(
    options: ApiLoadOptions,
    port: int,
    latencies: _Latencies,
    deadlines_missed: Callable[[], int],
    report: Callable[[str, float], None],
) -> ApiLoadResult:
    blocks: tuple[list[list[float]], list[list[float]]] = ([], [])
    missed = [0, 0]
    received: Counter[str] = Counter()
    clients = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.campaigns.api_load_clients", HOST, str(port), str(options.clients)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        process_group=0,
    )
    assert clients.stdin is not None
    assert clients.stdout is not None
    try:
        for number in range(2 * options.pairs):
            loaded = number % 2
            report("with clients" if loaded else "without clients", number / (2 * options.pairs))
            if loaded:
                clients.stdin.write(b"connect\n")
            await asyncio.sleep(SETTLE_S)
            blocks[loaded].append([])
            latencies.block, before = blocks[loaded][-1], deadlines_missed()
            await asyncio.sleep(options.block_s)
            latencies.block = None
            missed[loaded] += deadlines_missed() - before
            if loaded:
                clients.stdin.write(b"disconnect\n")
                received.update(jsonlib.loads(await clients.stdout.readline()))
    finally:
        clients.stdin.close()
        await wait_or_kill(clients, EXIT_TIMEOUT_S)
    without, with_clients = (block_latency(one) for one in blocks)
    decisions = sum(len(block) for one in blocks for block in one)
    return ApiLoadResult(options, decisions, without, with_clients, (missed[0], missed[1]), dict(received))


def block_latency(blocks_s: list[list[float]]) -> StageLatency:
    """Return the medians over blocks of p50 and p99, and the largest; raise SlipguardError for an empty block."""
    if not all(blocks_s):
        raise SlipguardError("nothing was decided in one of the blocks; is the machine busy?")
    p50, p99 = np.median([np.percentile(block_s, (50, 99)) for block_s in blocks_s], axis=0) * 1e3
    return StageLatency(float(p50), float(p99), 1e3 * max(max(block_s) for block_s in blocks_s))
