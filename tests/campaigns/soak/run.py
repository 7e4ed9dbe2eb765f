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

from slipguard.cli.run import bind_api
from slipguard.config import Config
from slipguard.daemon import run as root
from slipguard.daemon.api import paths
from slipguard.daemon.loop.finger import PerceptionPipeline
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.store.recording import SEGMENT_S, make_recorder
from slipguard.daemon.store.state_dir import StateDir
from slipguard.errors import SlipguardError
from slipguard.recording.recorder import Recorder
from slipguard.sim.world import World, WorldSettings
from slipguard.sim_lifts.campaign import CampaignSettings, run_campaign
from tests.campaigns.soak.checks import SoakCheck, StorageLimits, WorkDone, check_soak
from tests.campaigns.soak.page_client import PageProcess, open_page
from tests.campaigns.soak.resources import ResourceSample, return_freed_memory, take_sample
from tests.campaigns.soak.settings import KEPT_MAX_MB, RING_MAX_MB, RING_S, SoakSettings, soak_config
from tests.campaigns.soak.truth_perception import WorldTruthPerception
from tests.campaigns.soak.work_shift import WorkShift, place_object

STATED_LATENCY_S = 0.006
WORLD_STEP_S = 2e-3
RENDERED_LIFT_FIRST_S, RENDERED_LIFT_EVERY_S = 60.0, 1800.0
VIRTUAL_IMAGE_EVERY_S = 1.0
SAMPLES = 100
TRACED_SHARE = 0.1
"""Share at the end that runs with every allocation traced, at half the speed."""
BACKLOG_MAX = 200
PAGE_TIMEOUT_S = 60.0
REAL_WAIT_S = 0.25
TOP = 8


@dataclass(slots=True)
class SoakResult:
    """The result of a soak.

    Attributes:
        grown: bytes allocated in the last `traced_s` and not freed, by line of code.
        left_out: values that the recorder had no room for.
    """

    settings: SoakSettings
    checks: list[SoakCheck] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    samples: list[ResourceSample] = field(default_factory=list)
    grown: dict[str, int] = field(default_factory=dict)
    traced_s: float = 0.0
    left_out: int = 0
    took_s: float = 0.0

    @property
    def good(self) -> bool:
        """Whether every check passed."""
        return bool(self.checks) and all(one.good for one in self.checks)


async def run_soak(settings: SoakSettings, report: Callable[[ResourceSample, str], None]) -> SoakResult:
    """Run a soak.

    Args:
        report: called with each resource sample and the progress so far.

    Raises:
        WaitTimeout: the daemon does not proceed.
        SlipguardError: it was ended from outside.
    """
    found = SoakResult(settings)
    began_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="slipguard-soak-") as folder:
        run = _SoakRun(settings, soak_config(settings, Path(folder)), found, report)
        before = run.sample()
        await root.run(run.config, bind_api, world=run.world, extra_task=run.work, build=run.build, recorder=run.record)
        if not run.over:
            raise SlipguardError("the soak was ended early")
        await asyncio.get_running_loop().shutdown_default_executor()  # idle threads end with the loop
        after = run.sample()
    limits = StorageLimits(round(RING_S / SEGMENT_S), RING_MAX_MB, KEPT_MAX_MB)
    deadlines = round(settings.length_s * 1e3 / run.config.loop.period_ms)
    found.checks = check_soak(found.samples, before, after, limits, run.work_done(), run.missed, deadlines)
    found.took_s = time.monotonic() - began_s
    return found


class _SoakRun:
    """A running soak."""

    def __init__(
        self, settings: SoakSettings, config: Config, found: SoakResult, report: Callable[[ResourceSample, str], None]
    ) -> None:
        self.config = config
        self.world = World(WorldSettings(step_s=WORLD_STEP_S), seed=settings.seed)
        self.missed = 0
        self._recording_stops = 0
        self.over = False
        self._settings, self._found, self._report = settings, found, report
        self._recorder: Recorder | None = None
        self._began_s = asyncio.get_running_loop().time()
        # Sets the frame rate of the cameras before they start.
        place_object(self.world, "bar", settings.seed, settings.fps, self._began_s)
        self.world.clear(self._began_s)
        self._traced: tracemalloc.Snapshot | None = None
        self._page: Counter[str] = Counter()

    def build(self, config: Config, *, world: object) -> Service:
        """Build the service; on the virtual clock with fixed latency and, in contact, perception from the truth."""
        if not self._settings.virtual:
            return root.build_service(config, world=world)
        rng = np.random.default_rng(self._settings.seed)
        now = asyncio.get_running_loop().time

        def around(finger: str, pipeline: PerceptionPipeline) -> PerceptionPipeline:
            return WorldTruthPerception(pipeline, self.world, 1 if finger == "left" else -1, rng, now)

        return root.build_service(
            config, world=world, make_worker=lambda name: FixedLatencyWorker(STATED_LATENCY_S), wrap_pipeline=around
        )

    def record(self, service: Service, folder: Path) -> Recorder:
        """Make the usual recorder."""
        self._recorder = make_recorder(service, folder)
        return self._recorder

    def sample(self) -> ResourceSample:
        """Return the resources now, on the virtual clock after garbage collection (the real loop would wait)."""
        if self._settings.virtual:
            gc.collect()
        at_s = asyncio.get_running_loop().time() - self._began_s
        return take_sample(at_s, StateDir(self.config.state.directory).path, root.recordings_path(self.config))

    def work_done(self) -> WorkDone:
        """Return the work done."""
        counts, recorded, pages = self._found.counts, self._settings.recording, self._settings.page
        return WorkDone(
            lifts=counts.get("lifts", 0),
            dropped=counts.get("dropped", 0),
            calibrations=1 + counts.get("calibrations", 0),
            recording_stops=self._recording_stops if recorded else None,
            left_out=self._found.left_out if recorded else None,
            images=self._page["images"] if pages else None,
            connections_lost=self._page["connections lost"] if pages else None,
        )

    async def work(self, service: Service) -> None:
        """Work until the time is over, then end the daemon as systemd does."""
        loop = asyncio.get_running_loop()
        shift = WorkShift(service, self.world, self._settings.seed, self._settings.fps)
        tasks = [asyncio.create_task(one) for one in self._background_work(shift)]
        page = PageProcess() if self._settings.page and not self._settings.virtual else None
        try:
            if page is not None:
                await page.open(paths.socket_path(self.config))
            if self._settings.page and self._settings.virtual:
                await self._wait_for_page()
            await shift.start()
            sample_at_s = 0.0
            number = 0
            while (at_s := loop.time() - self._began_s) < self._settings.length_s:
                await shift.cycle(number)
                number += 1
                self._trace(at_s)
                if self._settings.virtual and at_s >= sample_at_s:
                    return_freed_memory()
                    self._take_sample(shift)
                    sample_at_s = at_s + self._settings.length_s / SAMPLES
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

    def _take_sample(self, shift: WorkShift) -> None:
        self._found.samples.append(self.sample())
        self._report(self._found.samples[-1], f"{shift.counts['cycles']} cycles")

    async def _take_samples(self, shift: WorkShift) -> None:
        """Take samples on the real clock, also during a cycle, which takes most of a minute.

        Freed memory is returned in a thread so that the loop does not wait.
        """
        while True:
            await asyncio.to_thread(return_freed_memory)
            self._take_sample(shift)
            await asyncio.sleep(self._settings.length_s / SAMPLES)

    def _background_work(self, shift: WorkShift) -> Iterator[Coroutine[None, None, None]]:
        """Yield the concurrent tasks of this process."""
        if not self._settings.virtual:
            yield self._take_samples(shift)
        else:
            yield self._rendered_lifts(shift)
            yield self._wait_for_recorder()
            if self._settings.page:
                yield open_page(paths.socket_path(self.config), self._page, VIRTUAL_IMAGE_EVERY_S)

    async def _rendered_lifts(self, shift: WorkShift) -> None:
        """Now and then run a second daemon in this process for one lift, with rendered images and the network."""
        number = 0
        await asyncio.sleep(RENDERED_LIFT_FIRST_S)
        while True:
            settings = CampaignSettings(seed=self._settings.seed + number, lifts=1, realtime=False)
            await run_campaign(settings, lambda live: None)
            shift.counts["rendered lifts by a second daemon"] += 1
            number += 1
            await asyncio.sleep(RENDERED_LIFT_EVERY_S)

    async def _wait_for_page(self) -> None:
        """Hold the virtual clock back until the web process, which starts on the real clock, has responded."""
        real_time = threading.Event()
        deadline_s = asyncio.get_running_loop().time() + PAGE_TIMEOUT_S
        while not self._page["history"] and asyncio.get_running_loop().time() < deadline_s:
            real_time.wait(REAL_WAIT_S)
            await asyncio.sleep(REAL_WAIT_S)

    async def _wait_for_recorder(self) -> None:
        """Hold the virtual clock back while the recorder's thread, on the real clock, lags behind."""
        real_time = threading.Event()
        while True:
            while self._recorder is not None and self._recorder.backlog > BACKLOG_MAX:
                real_time.wait(0.001)
            await asyncio.sleep(REAL_WAIT_S)

    def _trace(self, at_s: float) -> None:
        """Trace every allocation in the last tenth; its first half is warm-up, then the baseline is taken."""
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
    """Return a path without the folder that contains its package."""
    for folder in sorted(sys.path, key=len, reverse=True):
        if folder and where.startswith(folder):
            return where[len(folder) :].lstrip("/")
    return where
