"""Hours of work on a virtual clock: the daemon as `slipguard run --sim` runs it, with API and recordings, on the fakes.

Objects are lifted, devices fail and recover. Memory, tasks, threads and files must not grow, and nothing may be left.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import logging
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Annotated

import numpy as np
import typer

from slipguard.cli.run import bind_api
from slipguard.cli.terminal import progress_bar
from slipguard.config import Config, parse_config
from slipguard.daemon import log_setup as log
from slipguard.daemon import run as root
from slipguard.daemon.loop.finger import PerceptionPipeline
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.store.recording import SEGMENT_S, make_recorder
from slipguard.daemon.store.state_dir import KEPT, StateDir
from slipguard.devices import FINGERS, Frame
from slipguard.errors import InputError, SlipguardError
from slipguard.perception.estimate import Estimate
from slipguard.perception.patch import Patch
from slipguard.recording.recorder import Recorder
from slipguard.sim.world import World, WorldSettings
from tests.campaigns.figures import Figure, report
from tests.campaigns.work_shift import WorkShift, place_object

SHORTEST_S = 10.0
FPS = 15.0
"""A quarter of the cameras' rate: processing a frame takes the same real time as without a virtual clock."""
SAMPLES = 100
WARM_UP_SHARE, END_SHARE = 0.15, 0.2
"""Share left out at the beginning; the first and the last fifth of the remaining samples are compared."""
GROWTH_SAMPLES_MIN = 10
"""With fewer samples, start-up (the network is loaded after a minute) looks like growth: it is not judged."""
GROWTH_MAX, MISSED_MAX = 0.02, 0.001
OTHER_STATE_FILES = 1 + 2 * len(FINGERS) + 1
"""The last grasp, each finger's reference image and its metadata, and one that is just being written."""
RING_S, RING_MAX_MB, KEPT_MAX_MB = 600.0, 100, 50
"""The default duration of the ring, and sizes so small that both folders reach their limits within hours."""
BACKLOG_MAX = 200
SIGMA_DEG, NOISE_MM, STABLE_FRAMES = 0.4, 0.03, 5
MB = 2**20
Sample = dict[str, float]
"""Resources at one moment: memory, tasks, threads, open files, children, and what is stored."""


def soak(
    hours: Annotated[float, typer.Option(min=0.0, help="Duration on the daemon's clock; an hour takes about 1 min.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of objects, faults and pauses.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run the daemon on the fakes for hours of a virtual clock; exit 1 if anything grows or is left over.

    The cameras deliver 15 images per second of the untouched gel, the loop period is 50 ms, and in contact the rotation
    comes from the simulated world. Growth is judged in soaks of about ten minutes and more.

    Example: `python -m tests.campaigns soak --hours 8`
    """
    log.configure(level=logging.CRITICAL)
    if 3600.0 * hours < SHORTEST_S:
        raise InputError(f"{3600.0 * hours:g} s is too short for one lift; give --hours 8")
    with progress_bar("soak") as show, tempfile.TemporaryDirectory(prefix="slipguard-soak-") as folder:
        found = run_virtual(run_soak(3600.0 * hours, seed, Path(folder), show))
    report(soak_figures(found), {"counts": dict(sorted(found.counts.items()))}, json)


@dataclass(slots=True)
class Soak:
    """What a soak has shown. samples: while the daemon ran; before, after: without it; missed: share of deadlines."""

    samples: list[Sample] = field(default_factory=list)
    before: Sample = field(default_factory=dict)
    after: Sample = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    missed: float = 0.0
    recording_stops: int = 0
    left_out: int = 0


def soak_figures(found: Soak) -> list[Figure]:
    """Return all figures of a soak with their limits: work done, no growth, nothing left, storage within its limits."""
    samples, counts = found.samples, found.counts
    steady = samples[round(WARM_UP_SHARE * len(samples)) :]
    part = max(1, round(END_SHARE * len(steady)))

    def ends(name: str) -> tuple[float, float]:
        """Return the medians of the first and the last fifth; a short change does not count."""
        values = [one[name] for one in steady]
        return (median(values[:part]), median(values[-part:])) if values else (float("nan"), float("nan"))

    def most(name: str) -> float:
        return max((one[name] for one in samples), default=float("nan"))

    state_files = 2 * len(FINGERS) * min(1 + counts.get("calibrations", 0), KEPT + 1) + OTHER_STATE_FILES
    figures = [
        Figure("lifts", counts.get("lifts", 0), 1, at_least=True),
        Figure("dropped", counts.get("dropped", 0)),
        Figure("megabytes recorded", most("ring_mb") + most("kept_mb"), 0.1, at_least=True),
        Figure("times the recording stopped", found.recording_stops),
        Figure("values left out of the recordings", found.left_out),
        Figure("share of missed deadlines", found.missed, MISSED_MAX),
        Figure("files in the state directory", most("state_files"), state_files),
        Figure("files in the ring", most("ring_files"), round(RING_S / SEGMENT_S) + 1),
        Figure("megabytes in the ring", most("ring_mb"), RING_MAX_MB),
        Figure("megabytes kept", most("kept_mb"), KEPT_MAX_MB),
    ]
    if not samples or len(samples) >= GROWTH_SAMPLES_MIN:
        for name in ("rss_mb", "blocks"):
            first, last = ends(name)
            figures.append(Figure(f"growth of {name}", last / first - 1.0, GROWTH_MAX))
    for name in ("tasks", "threads", "files", "children"):
        first, last = ends(name)
        figures.append(Figure(f"rise of {name}", last - first))
        figures.append(Figure(f"{name} left after shutdown", found.after[name] - found.before[name]))
    return figures


async def run_soak(length_s: float, seed: int, folder: Path, show: Callable[[str, float], None]) -> Soak:
    """Run a soak. Raises WaitTimeout if the daemon does not proceed, SlipguardError if it was ended from outside."""
    found, over, recorders = Soak(), asyncio.Event(), list[Recorder]()
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    config = soak_config(folder)
    world = World(WorldSettings(step_s=2e-3), seed=seed)
    place_object(world, "bar", seed, FPS, began_s)  # sets the frame rate of the cameras before they start
    world.clear(began_s)

    def build(config: Config, *, world: World) -> Service:
        rng = np.random.default_rng(seed)

        def around(finger: str, pipeline: PerceptionPipeline) -> PerceptionPipeline:
            return WorldTruthPerception(pipeline, world, 1 if finger == "left" else -1, rng)

        return root.build_service(
            config, world=world, make_worker=lambda name: FixedLatencyWorker(0.006), wrap_pipeline=around
        )

    def record(service: Service, to: Path) -> Recorder:
        recorders.append(make_recorder(service, to))
        return recorders[-1]

    async def work(service: Service) -> None:
        """Work until the time is over, then end the daemon as systemd does."""
        shift = WorkShift(service, world, seed, FPS)
        waiting = asyncio.create_task(_wait_for_recorder(recorders))
        try:
            await shift.start()
            number, sample_at_s = 0, 0.0
            while (at_s := loop.time() - began_s) < length_s:
                await shift.cycle(number)
                number += 1
                if at_s >= sample_at_s:
                    found.samples.append(take_sample(config))
                    show(f"{number} cycles", at_s / length_s)
                    sample_at_s = at_s + length_s / SAMPLES
        finally:
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)
        found.counts = dict(shift.counts)
        found.left_out = sum(one.left_out for one in recorders)
        found.recording_stops = sum(one.stops + one.dead for one in recorders)
        found.missed = service.deadlines_missed * config.loop.period_ms / (1e3 * length_s)
        over.set()
        os.kill(os.getpid(), signal.SIGTERM)
        await loop.create_future()

    found.before = take_sample(config)
    await root.run(config, bind_api, world=world, extra_task=work, build=build, recorder=record)
    if not over.is_set():
        raise SlipguardError("the soak was ended early")
    await loop.shutdown_default_executor()  # idle threads end with the loop
    found.after = take_sample(config)
    return found


def soak_config(folder: Path) -> Config:
    """Return a configuration with the fakes, defaults, and recording limits small enough to be reached."""
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "background"}} for name in FINGERS}
    raw["guard"] = {"lift_height_mm": 100.0, "lift_speed_mm_s": 80.0, "tuning": {"lower_speed_mm_s": 150.0}}
    raw["loop"] = {"period_ms": 50.0, "poll_ms": 200.0}  # longer than usual: what a cycle allocates is the same
    raw["state"] = {"directory": str(folder)}
    raw["api"] = {"listen": ""}
    raw["recording"] = {"ring_s": RING_S, "ring_max_mb": RING_MAX_MB, "kept_max_mb": KEPT_MAX_MB}
    return parse_config(raw, where="soak", sim=True)


def take_sample(config: Config) -> Sample:
    """Return the resources of this process after garbage collection. Linux only."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # without glibc
        _LIBC.malloc_trim(0)
    recordings = root.recordings_path(config)
    ring, kept = ([_size(path) for path in (recordings / name).glob("*")] for name in ("ring", "kept"))
    state = StateDir(config.state.directory).path
    children = [one for path in Path("/proc/self/task").glob("*/children") for one in path.read_text().split()]
    return {
        "rss_mb": int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MB,
        "blocks": sys.getallocatedblocks(),
        "tasks": len(asyncio.all_tasks()),
        "threads": threading.active_count(),
        "files": len(os.listdir("/proc/self/fd")),
        "children": len(children),
        "state_files": sum(path.is_file() and recordings not in path.parents for path in state.rglob("*")),
        "ring_files": len(ring),
        "ring_mb": sum(ring) / MB,
        "kept_mb": sum(kept) / MB,
    }


_LIBC = ctypes.CDLL(None)
"""Loaded once: each load leaves a class of a hundred blocks to the garbage collector."""


def _size(path: Path) -> int:
    with contextlib.suppress(FileNotFoundError):  # the ring deletes files meanwhile
        return path.stat().st_size
    return 0


async def _wait_for_recorder(recorders: Sequence[Recorder]) -> None:
    """Hold the virtual clock back while the recorder's thread, on the real clock, lags behind."""
    real_time = threading.Event()
    while True:
        while recorders and recorders[-1].backlog > BACKLOG_MAX:
            real_time.wait(0.001)
        await asyncio.sleep(0.25)


class WorldTruthPerception:
    """Runs `pipeline` on frames without contact; in contact it estimates from the world's truth, within `SIGMA_DEG`.

    Args:
        sign: +1 for the left finger, -1 for the right one, which sees every rotation mirrored.
    """

    def __init__(self, pipeline: PerceptionPipeline, world: World, sign: int, rng: np.random.Generator) -> None:
        self._pipeline, self._world, self._sign, self._rng = pipeline, world, sign, rng
        self._stable, self._reference = 0, (0.0, 0.0)

    @property
    def last_patch(self) -> Patch | None:
        """None in contact: there is no segmentation."""
        return self._pipeline.last_patch

    def keep_estimate(self, captured_at_s: float) -> None:
        """Record a frame that is skipped because the other finger shows no rotation."""
        self._pipeline.keep_estimate(captured_at_s)

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact."""
        self._pipeline.reset_reference()
        self._stable = 0

    def process(self, frame: Frame) -> Estimate:
        """Return the estimate of one frame. Raises FrameCorrupt as the pipeline does."""
        truth = self._world.truth(asyncio.get_running_loop().time())
        if not truth.in_contact:
            self._stable = 0
            return self._pipeline.process(frame)
        plain = Estimate(frame.sequence, frame.captured_at_s, frame.captured_at_s, True, 4000, "truth")
        rotation_deg = self._sign * truth.rotation_deg + self._rng.normal(0.0, SIGMA_DEG)
        slip_mm = truth.slip_mm + self._rng.normal(0.0, NOISE_MM)
        self._stable += 1
        if self._stable < STABLE_FRAMES:
            return replace(plain, declined="no reference yet")
        if self._stable == STABLE_FRAMES:
            self._reference = rotation_deg, slip_mm
        return replace(
            plain,
            rotation_deg=rotation_deg - self._reference[0],
            sigma_deg=SIGMA_DEG,
            orientation_deg=0.0,
            rate_deg_s=self._sign * truth.rate_deg_s,
            shift_mm=(0.0, self._reference[1] - slip_mm),
        )
