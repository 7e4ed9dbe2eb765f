"""The soak: the daemon as `slipguard run --sim` runs it, with its API and its recordings, for hours on the fakes."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
import tempfile
import threading
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slipguard.config import Config
from slipguard.daemon import run as root
from slipguard.daemon.api import paths
from slipguard.daemon.loop.finger import PerceptionPipeline
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.worker import StatedLatencyWorker
from slipguard.daemon.store.recording import SEGMENT_S, make_recorder
from slipguard.daemon.store.state_dir import StateDir
from slipguard.errors import SlipguardError
from slipguard.perception.pipeline import Pipeline
from slipguard.recording.recorder import Recorder
from slipguard.sim.world import World, WorldSettings
from slipguard.sim_lifts.campaign import CampaignSettings, run_campaign
from tests.campaigns.soak import checks as verdict
from tests.campaigns.soak.fake_perception import WorldTruthPerception
from tests.campaigns.soak.page import PageProcess, look
from tests.campaigns.soak.resources import ResourceSample, feel, return_freed_memory
from tests.campaigns.soak.settings import KEPT_MAX_MB, RING_MAX_MB, RING_S, SoakSettings, soak_config
from tests.campaigns.soak.shift import WorkShift, place_object

STATED_LATENCY_S = 0.006
WORLD_STEP_S = 2e-3
DRAWN_LIFT_FIRST_S, DRAWN_LIFT_EVERY_S = 60.0, 1800.0
VIRTUAL_PICTURE_EVERY_S = 1.0
PULSES = 100
TRACED_SHARE = 0.1
"""How much of the end runs with every allocation traced; that makes it half as fast."""
BACKLOG_MAX = 200
PAGE_THERE_S = 60.0
PACE_S = 0.25
TOP = 8


@dataclass(slots=True)
class Soak:
    """What was found. grown: by line of code, bytes that the last `traced_s` allocated and did not let go of.

    left_out: values that the recorder had no room for.
    """

    settings: SoakSettings
    findings: list[verdict.SoakCheck] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    pulses: list[ResourceSample] = field(default_factory=list)
    grown: dict[str, int] = field(default_factory=dict)
    traced_s: float = 0.0
    left_out: int = 0
    took_s: float = 0.0

    @property
    def good(self) -> bool:
        """Whether every figure is within what is allowed."""
        return bool(self.findings) and all(one.good for one in self.findings)


async def soak(settings: SoakSettings, tell: Callable[[ResourceSample, str], None]) -> Soak:
    """Run it; tell: each look, and what was done so far.

    Raises Stuck where the daemon does not get on any more, SlipguardError where it is ended from outside.
    """
    found = Soak(settings)
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="slipguard-soak-") as folder:
        run = _SoakRun(settings, soak_config(settings, Path(folder)), found, tell)
        before = run.pulse()
        await root.run(run.config, world=run.world, beside=run.day, build=run.build, recorder=run.record)
        if not run.over:
            raise SlipguardError("the soak was ended before its time")
        await asyncio.get_running_loop().shutdown_default_executor()  # idle threads end with the loop, not the daemon
        after = run.pulse()
    limits = verdict.StorageLimits(round(RING_S / SEGMENT_S), RING_MAX_MB, KEPT_MAX_MB)
    beats = round(settings.length_s * 1e3 / run.config.loop.period_ms)
    found.findings = verdict.check_soak(found.pulses, before, after, limits, run.work(), run.missed, beats)
    found.took_s = time.monotonic() - began_s
    return found


class _SoakRun:
    """One soak on its way."""

    def __init__(
        self, settings: SoakSettings, config: Config, found: Soak, tell: Callable[[ResourceSample, str], None]
    ) -> None:
        self.config = config
        self.world = World(WorldSettings(step_s=WORLD_STEP_S), seed=settings.seed)
        self.missed = 0
        self._recording_stops = 0
        self.over = False
        self._settings, self._found, self._tell = settings, found, tell
        self._recorder: Recorder | None = None
        self._began_s = asyncio.get_running_loop().time()
        place_object(
            self.world, "bar", settings.seed, settings.fps, self._began_s
        )  # the cameras' rate, before they run
        self.world.clear(self._began_s)
        self._traced: tracemalloc.Snapshot | None = None
        self._page: Counter[str] = Counter()

    def build(self, config: Config, *, world: object) -> Service:
        """The service as ever; on the virtual clock with stated latency, and the truth where something is touched."""
        if not self._settings.virtual:
            return root.build_service(config, world=world)
        rng = np.random.default_rng(self._settings.seed)
        now = asyncio.get_running_loop().time

        def around(finger: str, pipeline: Pipeline) -> PerceptionPipeline:
            return WorldTruthPerception(pipeline, self.world, 1 if finger == "left" else -1, rng, now)

        return root.build_service(
            config, world=world, make_worker=lambda name: StatedLatencyWorker(STATED_LATENCY_S), around=around
        )

    def record(self, service: Service, folder: Path) -> Recorder:
        """The usual recorder."""
        self._recorder = make_recorder(service, folder)
        return self._recorder

    def pulse(self) -> ResourceSample:
        """Now. On the virtual clock garbage is collected before: on the real one the loop would wait for that."""
        if self._settings.virtual:
            gc.collect()
        at_s = asyncio.get_running_loop().time() - self._began_s
        return feel(at_s, StateDir(self.config.state.directory).path, root.recordings_path(self.config))

    def work(self) -> verdict.WorkDone:
        """What was done."""
        counts, recorded, pages = self._found.counts, self._settings.recording, self._settings.page
        return verdict.WorkDone(
            lifts=counts.get("lifts", 0),
            dropped=counts.get("dropped", 0),
            calibrations=1 + counts.get("calibrations", 0),
            recording_stops=self._recording_stops if recorded else None,
            left_out=self._found.left_out if recorded else None,
            pictures=self._page["pictures"] if pages else None,
            connections_lost=self._page["connections lost"] if pages else None,
        )

    async def day(self, service: Service) -> None:
        """Shift work until the time is over; then the daemon is ended as systemd ends it."""
        loop = asyncio.get_running_loop()
        shift = WorkShift(service, self.world, self._settings.seed, self._settings.fps)
        tasks = [asyncio.create_task(one) for one in self._beside(shift)]
        page = PageProcess() if self._settings.page and not self._settings.virtual else None
        try:
            if page is not None:
                await page.open(paths.socket_path(self.config))
            if self._settings.page and self._settings.virtual:
                await self._page_there()
            await shift.start()
            pulse_at_s = 0.0
            number = 0
            while (at_s := loop.time() - self._began_s) < self._settings.length_s:
                await shift.cycle(number)
                number += 1
                self._trace(at_s)
                if self._settings.virtual and at_s >= pulse_at_s:
                    return_freed_memory()
                    self._look(shift)
                    pulse_at_s = at_s + self._settings.length_s / PULSES
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if page is not None:
                self._page.update(await page.close())
        self._end_trace()
        self._found.counts = dict(shift.counts) | {f"page: {what}": count for what, count in self._page.items()}
        if (recorder := self._recorder) is not None:
            self._found.left_out, self._recording_stops = recorder.left_out, recorder.stops + recorder.dead
        self.missed = service.deadlines_missed
        self.over = True
        os.kill(os.getpid(), signal.SIGTERM)
        await loop.create_future()

    def _look(self, shift: WorkShift) -> None:
        self._found.pulses.append(self.pulse())
        self._tell(self._found.pulses[-1], f"{shift.counts['cycles']} cycles")

    async def _look_again(self, shift: WorkShift) -> None:
        """On the real clock, whatever is held: a cycle takes most of a minute. Freed memory is given back in a thread,
        for the loop does not wait.
        """
        while True:
            await asyncio.to_thread(return_freed_memory)
            self._look(shift)
            await asyncio.sleep(self._settings.length_s / PULSES)

    def _beside(self, shift: WorkShift) -> Iterator[Coroutine[None, None, None]]:
        """What else goes on in this process."""
        if not self._settings.virtual:
            yield self._look_again(shift)
        else:
            yield self._drawn_lifts(shift)
            yield self._keep_pace()
            if self._settings.page:
                yield look(paths.socket_path(self.config), self._page, VIRTUAL_PICTURE_EVERY_S)

    async def _drawn_lifts(self, shift: WorkShift) -> None:
        """Now and then a second daemon in this process: pictures drawn, looked at by the network, one lift, the end."""
        number = 0
        await asyncio.sleep(DRAWN_LIFT_FIRST_S)
        while True:
            settings = CampaignSettings(seed=self._settings.seed + number, lifts=1, realtime=False)
            await run_campaign(settings, lambda live: None)
            shift.counts["drawn lifts by a second daemon"] += 1
            number += 1
            await asyncio.sleep(DRAWN_LIFT_EVERY_S)

    async def _page_there(self) -> None:
        """The web process starts on the real clock: until it has answered, the virtual one goes no faster."""
        nobody_wakes = threading.Event()
        given_up_s = asyncio.get_running_loop().time() + PAGE_THERE_S
        while not self._page["history"] and asyncio.get_running_loop().time() < given_up_s:
            nobody_wakes.wait(PACE_S)
            await asyncio.sleep(PACE_S)

    async def _keep_pace(self) -> None:
        """The recorder's thread lives on the real clock: the virtual one waits for it."""
        nobody_wakes = threading.Event()
        while True:
            while self._recorder is not None and self._recorder.backlog > BACKLOG_MAX:
                nobody_wakes.wait(0.001)
            await asyncio.sleep(PACE_S)

    def _trace(self, at_s: float) -> None:
        """From the last tenth on every allocation is traced; the first moments of that are the measure."""
        if not self._settings.virtual or at_s < (1.0 - TRACED_SHARE) * self._settings.length_s:
            return
        if not tracemalloc.is_tracing():
            tracemalloc.start()
        elif self._traced is None and at_s >= (1.0 - TRACED_SHARE / 2) * self._settings.length_s:
            gc.collect()
            self._traced = tracemalloc.take_snapshot()
            self._found.traced_s = self._settings.length_s - at_s

    def _end_trace(self) -> None:
        if self._traced is not None:
            gc.collect()
            stats = tracemalloc.take_snapshot().compare_to(self._traced, "lineno")
            grown = {f"{one.traceback[0].filename}:{one.traceback[0].lineno}": one.size_diff for one in stats[:TOP]}
            self._found.grown = {_short(where): size for where, size in grown.items() if size > 0}
        if tracemalloc.is_tracing():
            tracemalloc.stop()


def _short(where: str) -> str:
    """Without the folder that packages lie in."""
    for folder in sorted(sys.path, key=len, reverse=True):
        if folder and where.startswith(folder):
            return where[len(folder) :].lstrip("/")
    return where
