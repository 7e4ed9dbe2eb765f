"""What the recordings cost the loop: the same lifts with and without them, in turn, on the real clock."""

from __future__ import annotations

import asyncio
import resource
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slipguard.daemon import run as root
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.recording import RecordingObserver, RecordingSink, make_recorder, record
from slipguard.sim.world import World
from tests.campaigns.soak.settings import SoakSettings, soak_config
from tests.campaigns.soak.shift import WorkShift

LOOP_SHARE_MAX = 0.05


@dataclass(slots=True)
class LiftCost:
    """One lift. loop_s, process_s: processor time of the loop's thread and of the whole process."""

    recorded: bool
    wall_s: float = 0.0
    loop_s: float = 0.0
    process_s: float = 0.0
    missed: int = 0
    handed: int = 0
    left_out: int = 0
    handing_s: float = 0.0
    longest_hand_s: float = 0.0
    latencies_s: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class LiftCostSummary:
    """All lifts with, or all without. Times in ms, shares of one core."""

    lifts: int
    latencies: int
    latency_p50_ms: float
    latency_p99_ms: float
    loop_share: float
    process_share: float
    missed_share: float


@dataclass(frozen=True, slots=True)
class RecordingCost:
    """handing_share: of the loop thread's processor time that goes into handing values to the recorder.

    longest_hand_ms: the longest single hand-over, preemption included. left_out: values it had no room for.
    """

    without: LiftCostSummary
    recorded: LiftCostSummary
    handing_share: float
    handed: int
    longest_hand_ms: float
    left_out: int

    @property
    def good(self) -> bool:
        """Whether the loop gives no more than is allowed, and nothing was lost."""
        return self.handing_share <= LOOP_SHARE_MAX and self.left_out == 0


async def measure(pairs: int, seed: int, tell: Callable[[str, float], None]) -> RecordingCost:
    """Lift `pairs` objects, each once with and once without recordings; the order changes from pair to pair."""
    blocks: list[LiftCost] = []
    with tempfile.TemporaryDirectory(prefix="slipguard-recording-") as folder:
        settings = SoakSettings(0.0, virtual=False, seed=seed)
        config = soak_config(settings, Path(folder))
        world = World(seed=seed)
        service = root.build_service(config, world=world)
        running = asyncio.create_task(service.run(), name="service")
        try:
            shift = WorkShift(service, world, seed, settings.fps, calm=True)
            await shift.start()
            await shift.cycle(0)  # what happens once only: imports, first pages
            for number in range(2 * pairs):
                pair, second = divmod(number, 2)
                block = LiftCost(recorded=bool(second) != bool(pair % 2))
                tell(f"lift {number + 1} of {2 * pairs}", number / (2 * pairs))
                async with _recorded(service, Path(folder) / "recordings", block):
                    with _measured(service, block):
                        await shift.cycle(pair)
                blocks.append(block)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
    recorded = [one for one in blocks if one.recorded]
    return RecordingCost(
        without=_side([one for one in blocks if not one.recorded], config.loop.period_ms / 1e3),
        recorded=_side(recorded, config.loop.period_ms / 1e3),
        handing_share=sum(one.handing_s for one in recorded) / sum(one.loop_s for one in recorded),
        handed=sum(one.handed for one in recorded),
        longest_hand_ms=1e3 * max(one.longest_hand_s for one in recorded),
        left_out=sum(one.left_out for one in recorded),
    )


class _TimedWatcher(RecordingObserver):
    """The usual one, with the time it takes from the loop's thread."""

    def __init__(self, recorder: RecordingSink, block: LiftCost) -> None:
        super().__init__(recorder)
        self._block = block

    def judged(self, finger: str, processed: ProcessedFrame) -> None:
        began_s, cpu_s = time.perf_counter(), time.thread_time()
        super().judged(finger, processed)
        self._took(began_s, cpu_s)

    def decided(self, decision: Decision) -> None:
        began_s, cpu_s = time.perf_counter(), time.thread_time()
        super().decided(decision)
        self._took(began_s, cpu_s)

    def _took(self, began_s: float, cpu_s: float) -> None:
        self._block.handing_s += time.thread_time() - cpu_s
        self._block.longest_hand_s = max(self._block.longest_hand_s, time.perf_counter() - began_s)
        self._block.handed += 1


@asynccontextmanager
async def _recorded(service: Service, folder: Path, block: LiftCost) -> AsyncIterator[None]:
    """Recordings run meanwhile, if this lift is one of those."""
    if not block.recorded:
        yield
        return
    recorder = make_recorder(service, folder)
    task = asyncio.create_task(record(service, recorder, lambda taker: _TimedWatcher(taker, block)))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        block.left_out = recorder.left_out


@contextmanager
def _measured(service: Service, block: LiftCost) -> Iterator[None]:
    """Times, latencies and deadlines of what happens meanwhile."""

    def decided(decision: Decision) -> None:
        block.latencies_s.extend(decision.latencies_s)

    service.observers.append(decided)
    service.hold_observers.append(block.latencies_s.append)
    missed, process_s = service.deadlines_missed, _process_s()
    wall_s, loop_s = time.perf_counter(), time.thread_time()
    try:
        yield
    finally:
        service.observers.remove(decided)
        service.hold_observers.remove(block.latencies_s.append)
        block.wall_s, block.loop_s = time.perf_counter() - wall_s, time.thread_time() - loop_s
        block.process_s = _process_s() - process_s
        block.missed = service.deadlines_missed - missed


def _process_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _side(blocks: Sequence[LiftCost], period_s: float) -> LiftCostSummary:
    latencies_ms = 1e3 * np.array([one for block in blocks for one in block.latencies_s])
    p50_ms, p99_ms = np.percentile(latencies_ms, (50, 99)).tolist()
    wall_s = sum(block.wall_s for block in blocks)
    return LiftCostSummary(
        lifts=len(blocks),
        latencies=len(latencies_ms),
        latency_p50_ms=p50_ms,
        latency_p99_ms=p99_ms,
        loop_share=sum(block.loop_s for block in blocks) / wall_s,
        process_share=sum(block.process_s for block in blocks) / wall_s,
        missed_share=sum(block.missed for block in blocks) * period_s / wall_s,
    )
