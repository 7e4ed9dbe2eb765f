"""The cost of recordings for the control loop: the same lifts with and without them, alternating, on the real clock."""

from __future__ import annotations

import asyncio
import json as jsonlib
import logging
import resource
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.terminal import progress_bar
from slipguard.daemon import log_setup as log
from slipguard.daemon import run as daemon
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.recording import RecordingObserver, RecordingSink, make_recorder, record
from slipguard.sim.world import World
from slipguard.thread_priority import set_realtime_priority
from tests.campaigns.soak.settings import SoakSettings, soak_config
from tests.campaigns.soak.work_shift import WorkShift

LOOP_SHARE_MAX = 0.05


@dataclass(slots=True)
class LiftCost:
    """Measurements of one lift. loop_s, process_s: processor time of the loop's thread and of the whole process."""

    recorded: bool
    wall_s: float = 0.0
    loop_s: float = 0.0
    process_s: float = 0.0
    missed: int = 0
    handed_over: int = 0
    left_out: int = 0
    hand_over_s: float = 0.0
    longest_hand_over_s: float = 0.0
    latencies_s: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class LiftCostSummary:
    """All lifts with, or all lifts without recordings. Times in ms, shares of one core."""

    lifts: int
    latencies: int
    latency_p50_ms: float
    latency_p99_ms: float
    loop_share: float
    process_share: float
    missed_share: float


@dataclass(frozen=True, slots=True)
class RecordingCost:
    """The comparison.

    Attributes:
        hand_over_share: share of the loop thread's processor time spent on handing values to the recorder.
        longest_hand_over_ms: including preemption.
        left_out: values that the recorder had no room for.
    """

    without: LiftCostSummary
    recorded: LiftCostSummary
    hand_over_share: float
    handed_over: int
    longest_hand_over_ms: float
    left_out: int

    @property
    def good(self) -> bool:
        """Whether the cost is within its limit and no value was lost."""
        return self.hand_over_share <= LOOP_SHARE_MAX and self.left_out == 0


def recording_cost(
    lifts: Annotated[int, typer.Option(min=1, help="Objects to lift, each with and without recordings.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the objects.")] = 0,
    as_service: Annotated[
        bool, typer.Option("--as-service", help="With the real-time priority of the service; needs root.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare the loop's processor time and latency with and without recordings; exit 1 if they cost over 5 %.

    Example: `python -m tests.campaigns recording-cost --lifts 10`
    """
    log.configure(level=logging.CRITICAL)
    if as_service:
        set_realtime_priority()
    with progress_bar("recording cost") as show, default_interrupts():
        cost = asyncio.run(measure_recording_cost(lifts, seed, show))
    if json:
        print(jsonlib.dumps(asdict(cost) | {"good": cost.good}))
    else:
        _print(cost)
    if not cost.good:
        raise typer.Exit(1)


def _print(cost: RecordingCost) -> None:
    table = Table("lifts", "latencies", "p50", "p99", "loop thread", "process", "missed deadlines")
    for one in (cost.without, cost.recorded):
        table.add_row(
            f"{one.lifts} {'recorded' if one is cost.recorded else 'not recorded'}",
            str(one.latencies),
            f"{one.latency_p50_ms:.1f} ms",
            f"{one.latency_p99_ms:.1f} ms",
            f"{one.loop_share:.1%} of a core",
            f"{one.process_share:.1%}",
            f"{one.missed_share:.2%}",
        )
    console = Console(highlight=False)
    console.print(table)
    console.print(
        f"handing over {cost.handed_over} values took {cost.hand_over_share:.1%} of the loop thread's time "
        f"(limit {LOOP_SHARE_MAX:.0%}), at most {cost.longest_hand_over_ms:.2f} ms; {cost.left_out} left out"
    )


async def measure_recording_cost(pairs: int, seed: int, report: Callable[[str, float], None]) -> RecordingCost:
    """Lift `pairs` objects, each once with and once without recordings; the order changes from pair to pair."""
    lifts: list[LiftCost] = []
    with tempfile.TemporaryDirectory(prefix="slipguard-recording-") as folder:
        settings = SoakSettings(0.0, virtual=False, seed=seed)
        config = soak_config(settings, Path(folder))
        world = World(seed=seed)
        service = daemon.build_service(config, world=world)
        running = asyncio.create_task(service.run(), name="service")
        try:
            shift = WorkShift(service, world, seed, settings.fps, undisturbed=True)
            await shift.start()
            await shift.cycle(0)  # what happens once only: imports, first pages
            for number in range(2 * pairs):
                pair, second = divmod(number, 2)
                lift = LiftCost(recorded=bool(second) != bool(pair % 2))
                report(f"lift {number + 1} of {2 * pairs}", number / (2 * pairs))
                async with _recorded(service, Path(folder) / "recordings", lift):
                    with _measured(service, lift):
                        await shift.cycle(pair)
                lifts.append(lift)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
    recorded = [one for one in lifts if one.recorded]
    return RecordingCost(
        without=_summary([one for one in lifts if not one.recorded], config.loop.period_ms / 1e3),
        recorded=_summary(recorded, config.loop.period_ms / 1e3),
        hand_over_share=sum(one.hand_over_s for one in recorded) / sum(one.loop_s for one in recorded),
        handed_over=sum(one.handed_over for one in recorded),
        longest_hand_over_ms=1e3 * max(one.longest_hand_over_s for one in recorded),
        left_out=sum(one.left_out for one in recorded),
    )


class _TimedObserver(RecordingObserver):
    """The usual observer, which measures the time it takes from the loop's thread."""

    def __init__(self, recorder: RecordingSink, lift: LiftCost) -> None:
        super().__init__(recorder)
        self._lift = lift

    def add_frame(self, finger: str, processed: ProcessedFrame) -> None:
        with self._timed():
            super().add_frame(finger, processed)

    def add_decision(self, decision: Decision) -> None:
        with self._timed():
            super().add_decision(decision)

    @contextmanager
    def _timed(self) -> Iterator[None]:
        began_s, cpu_s = time.perf_counter(), time.thread_time()
        yield
        self._lift.hand_over_s += time.thread_time() - cpu_s
        self._lift.longest_hand_over_s = max(self._lift.longest_hand_over_s, time.perf_counter() - began_s)
        self._lift.handed_over += 1


@asynccontextmanager
async def _recorded(service: Service, folder: Path, lift: LiftCost) -> AsyncIterator[None]:
    """Record while entered, if the lift is to be recorded."""
    if not lift.recorded:
        yield
        return
    recorder = make_recorder(service, folder)
    task = asyncio.create_task(record(service, recorder, lambda sink: _TimedObserver(sink, lift)))
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        lift.left_out = recorder.left_out


@contextmanager
def _measured(service: Service, lift: LiftCost) -> Iterator[None]:
    """Measure times, latencies and deadlines while entered."""

    def decided(decision: Decision) -> None:
        lift.latencies_s.extend(decision.latencies_s)

    missed, process_s = service.deadlines_missed, _process_s()
    wall_s, loop_s = time.perf_counter(), time.thread_time()
    try:
        with service.observers.attached(decided), service.hold_observers.attached(lift.latencies_s.append):
            yield
    finally:
        lift.wall_s, lift.loop_s = time.perf_counter() - wall_s, time.thread_time() - loop_s
        lift.process_s = _process_s() - process_s
        lift.missed = service.deadlines_missed - missed


def _process_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _summary(lifts: Sequence[LiftCost], period_s: float) -> LiftCostSummary:
    latencies_ms = 1e3 * np.array([one for lift in lifts for one in lift.latencies_s])
    p50_ms, p99_ms = np.percentile(latencies_ms, (50, 99)).tolist()
    wall_s = sum(lift.wall_s for lift in lifts)
    return LiftCostSummary(
        lifts=len(lifts),
        latencies=len(latencies_ms),
        latency_p50_ms=p50_ms,
        latency_p99_ms=p99_ms,
        loop_share=sum(lift.loop_s for lift in lifts) / wall_s,
        process_share=sum(lift.process_s for lift in lifts) / wall_s,
        missed_share=sum(lift.missed for lift in lifts) * period_s / wall_s,
    )
