"""What a crowd at the page costs the guard: the loop's latency with nobody and with many looking, turn and turn about.

The daemon with its API runs here, the emulated cell and the clients in processes of their own. Blocks without and with
the clients alternate, so that whatever else the machine does falls on both.
"""

from __future__ import annotations

import asyncio
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slipguard.bench.wire_latency import HOST, StageLatency, every_frame_in_full, grip
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.run import build_service
from slipguard.errors import SlipguardError
from slipguard.tools.cell_process import CellProcess
from slipguard.web.host import EXIT_TIMEOUT_S, run_api, wait_or_kill
from slipguard.web.sockets import bind, bind_tcp

SETTLE_S = 1.5
"""After clients came or went, before it counts."""
SHARE_MAX, RISE_MAX_MS = 0.10, 1.0
ROTATED_AWAY_PER = 20
"""So many good answers at least for each client that was turned away or cut off."""


@dataclass(frozen=True, slots=True)
class ApiLoadOptions:
    """clients: half hear the live stream, half poll. pairs: blocks without and with them. block_s: length of one."""

    clients: int = 50
    pairs: int = 6
    block_s: float = 8.0
    fps: int = 60
    object_name: str = "wrench"


@dataclass(frozen=True, slots=True)
class ApiLoadResult:
    """alone, crowded: latencies of the loop, frame handed over to decision: the median of the blocks' p50 and p99, so
    that what the machine does once falls out, and the largest of all. got: what the clients received.

    missed: beats of the loop missed meanwhile, alone and crowded. allowed_ms: how much p99 may rise.
    """

    options: ApiLoadOptions
    decisions: int
    alone: StageLatency
    crowded: StageLatency
    missed: tuple[int, int]
    got: dict[str, int] = field(default_factory=dict)

    @property
    def rise_ms(self) -> float:
        """Of p99."""
        return self.crowded.p99_ms - self.alone.p99_ms

    @property
    def allowed_ms(self) -> float:
        """A tenth of it, or one millisecond where that is more."""
        return max(SHARE_MAX * self.alone.p99_ms, RISE_MAX_MS)

    @property
    def unserved(self) -> str | None:
        """Why it tells nothing of clients: each should have got something in each block, few been turned away."""
        polling = -(-self.options.clients // 2)
        wanted = {"answers 200": polling, "live messages": self.options.clients - polling}
        rotated_away = {what: count for what, count in self.got.items() if what not in wanted and count}
        few = any(self.got.get(what, 0) < self.options.pairs * each for what, each in wanted.items())
        if not few and sum(rotated_away.values()) * ROTATED_AWAY_PER <= self.got["answers 200"]:
            return None
        told = ", ".join(f"{count} {what}" for what, count in self.got.items()) or "nothing"
        return (
            f"the {self.options.clients} clients were not served, they got {told}; this says nothing of what they cost"
        )


async def measure_api_load(options: ApiLoadOptions, tell: Callable[[str, float], None]) -> ApiLoadResult:
    """Hold an object while clients come and go. tell(what, share done). Raises SlipguardError where it cannot."""
    with tempfile.TemporaryDirectory(prefix="slipguard-crowd-") as name:
        folder = Path(name)
        cell = CellProcess(folder, *("--host", HOST, "--object", options.object_name, "--fps", str(options.fps)))
        try:
            tell("starting the emulated cell", 0.0)
            await cell.start()
            service = build_service(every_frame_in_full(cell.config))
            with closing(bind_tcp(HOST, 0)) as probe:
                port = int(probe.getsockname()[1])
            api = run_api(
                RequestHandlers(service), bind(folder / "s"), (HOST, port), folder / "token", service.event_log.warning
            )
            tasks = [asyncio.create_task(service.run(), name="service"), asyncio.create_task(api, name="api")]
            try:
                tell("gripping", 0.0)
                await grip(service, tasks[0])
                times = _Times()
                service.observers.append(times.decided)
                return await _blocks(options, port, times, lambda: service.deadlines_missed, tell)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            await cell.stop()


class _Times:
    """Collects latencies for whoever is there now; nothing while `into` is None."""

    def __init__(self) -> None:
        self.into: list[float] | None = None

    def decided(self, decision: Decision) -> None:
        if self.into is not None:
            self.into.extend(decision.latencies_s)


async def _blocks(
    options: ApiLoadOptions, port: int, times: _Times, missed: Callable[[], int], tell: Callable[[str, float], None]
) -> ApiLoadResult:
    found: tuple[list[list[float]], list[list[float]]] = ([], [])
    lost = [0, 0]
    got: Counter[str] = Counter()
    clients = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "tests.campaigns.api_load_clients", HOST, str(port), str(options.clients)),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        process_group=0,
    )
    assert clients.stdin is not None
    assert clients.stdout is not None
    try:
        for block in range(2 * options.pairs):
            here = block % 2
            tell("with a crowd" if here else "alone", block / (2 * options.pairs))
            if here:
                clients.stdin.write(b"come\n")
            await asyncio.sleep(SETTLE_S)
            found[here].append([])
            times.into, before = found[here][-1], missed()
            await asyncio.sleep(options.block_s)
            times.into = None
            lost[here] += missed() - before
            if here:
                clients.stdin.write(b"go\n")
                got.update(json.loads(await clients.stdout.readline()))
    finally:
        clients.stdin.close()
        await wait_or_kill(clients, EXIT_TIMEOUT_S)
    alone, crowded = (spread_of_blocks(one) for one in found)
    decisions = sum(len(block) for one in found for block in one)
    return ApiLoadResult(options, decisions, alone, crowded, (lost[0], lost[1]), dict(got))


def spread_of_blocks(blocks_s: list[list[float]]) -> StageLatency:
    """Medians of the blocks' p50 and p99, and the largest of all. Raises SlipguardError for a block without any."""
    if not all(blocks_s):
        raise SlipguardError("nothing was decided in one of the blocks; is the machine busy?")
    p50, p99 = np.median([np.percentile(block_s, (50, 99)) for block_s in blocks_s], axis=0) * 1e3
    return StageLatency(float(p50), float(p99), 1e3 * max(max(block_s) for block_s in blocks_s))
