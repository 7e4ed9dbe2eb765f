"""The pass criteria of a soak: work done, nothing dropped, no growth, nothing left over, storage within its limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from slipguard.daemon.store.state_dir import KEPT
from slipguard.devices import FINGERS
from tests.campaigns.soak.resources import ResourceSample

WARM_UP_SHARE, END_SHARE = 0.15, 0.2
"""Share left out at the beginning; the first and the last fifth of the remaining samples are compared."""
GROWTH_MAX = 0.02
GROWTH_SAMPLES_MIN = 10
"""With fewer samples, start-up (the network is loaded after a minute) looks like growth: it is not judged."""
MISSED_MAX = 0.001
OTHER_STATE_FILES = 1 + 2 * len(FINGERS) + 1
"""The last grasp, each finger's reference image and its metadata, and one that is just being written."""


@dataclass(frozen=True, slots=True)
class SoakCheck:
    """One value and its limit: an upper limit, or with `at_least` a lower limit."""

    what: str
    value: float
    limit: float
    at_least: bool = False

    @property
    def good(self) -> bool:
        """Whether the value is within its limit; False for NaN."""
        return self.value >= self.limit if self.at_least else self.value <= self.limit


@dataclass(frozen=True, slots=True)
class StorageLimits:
    """Configured limits of the recordings. One file more than `ring_files` is being written."""

    ring_files: int
    ring_mb: float
    kept_mb: float


@dataclass(frozen=True, slots=True)
class WorkDone:
    """The work done during a soak.

    Attributes:
        calibrations: including the first.
        recording_stops, left_out: how often the recorder stopped, and values it had no room for; None without
            recordings.
        images, connections_lost: of the page; None without one.
    """

    lifts: int
    dropped: int
    calibrations: int
    recording_stops: int | None = None
    left_out: int | None = None
    images: int | None = None
    connections_lost: int | None = None

    @property
    def state_files(self) -> int:
        """Limit: per sensor the kept background images with their metadata and the first one, and the other files."""
        return 2 * len(FINGERS) * min(self.calibrations, KEPT + 1) + OTHER_STATE_FILES


def growth(values: Sequence[float]) -> float:
    """Return the relative rise of the median from the first to the last fifth, without the warm-up."""
    steady = values[round(WARM_UP_SHARE * len(values)) :]
    if not steady:
        return float("nan")
    part = max(1, round(END_SHARE * len(steady)))
    before, after = median(steady[:part]), median(steady[-part:])
    return after / before - 1.0 if before else 0.0


def growth_judged(samples: Sequence[ResourceSample]) -> bool:
    """Return whether growth can be judged; a soak without any sample has failed and is judged."""
    return not samples or len(samples) >= GROWTH_SAMPLES_MIN


def check_soak(
    samples: Sequence[ResourceSample],
    before: ResourceSample,
    after: ResourceSample,
    limits: StorageLimits,
    work: WorkDone,
    missed: int,
    deadlines: int,
) -> list[SoakCheck]:
    """Return all checks of a soak.

    Args:
        samples: taken while the daemon ran.
        before, after: without the daemon.
        missed, deadlines: missed and total deadlines of the loop.
    """
    steady = samples[round(WARM_UP_SHARE * len(samples)) :]
    part = max(1, round(END_SHARE * len(steady)))

    def rise(name: str) -> float:
        """Return the rise of the median count; a short change does not count."""
        counts = [float(getattr(one, name)) for one in steady]
        return median(counts[-part:]) - median(counts[:part]) if counts else float("nan")

    def most(name: str) -> float:
        return max((float(getattr(one, name)) for one in samples), default=float("nan"))

    done = [SoakCheck("lifts", work.lifts, 1, at_least=True), SoakCheck("dropped", work.dropped, 0)]
    if work.recording_stops is not None and work.left_out is not None:
        done += [
            SoakCheck("megabytes recorded", most("ring_mb") + most("kept_mb"), 0.1, at_least=True),
            SoakCheck("times the recording stopped", work.recording_stops, 0),
            SoakCheck("values left out of the recordings", work.left_out, 0),
        ]
    if work.images is not None and work.connections_lost is not None:
        done += [
            SoakCheck("images on the page", work.images, 1, at_least=True),
            SoakCheck("connections the page lost", work.connections_lost, 0),
        ]
    if growth_judged(samples):
        done += [
            SoakCheck("memory growth", growth([one.rss_mb for one in samples]), GROWTH_MAX),
            SoakCheck("growth of allocated Python memory blocks", growth([one.blocks for one in samples]), GROWTH_MAX),
            SoakCheck("memory growth of the child processes", growth([one.children_mb for one in samples]), GROWTH_MAX),
        ]
    return [
        *done,
        SoakCheck("rise of tasks from warm-up to end", rise("tasks"), 0),
        SoakCheck("rise of threads", rise("threads"), 0),
        SoakCheck("rise of open files", rise("files"), 0),
        SoakCheck("rise of child processes", rise("children"), 0),
        SoakCheck("tasks left after shutdown", after.tasks - before.tasks, 0),
        SoakCheck("threads left after shutdown", after.threads - before.threads, 0),
        SoakCheck("open files left after shutdown", after.files - before.files, 0),
        SoakCheck("child processes left after shutdown", after.children - before.children, 0),
        SoakCheck("files in the state directory", most("state_files"), work.state_files),
        SoakCheck("files in the ring", most("ring_files"), limits.ring_files + 1),
        SoakCheck("megabytes in the ring", most("ring_mb"), limits.ring_mb),
        SoakCheck("megabytes kept", most("kept_mb"), limits.kept_mb),
        SoakCheck("share of missed deadlines", missed / max(deadlines, 1), MISSED_MAX),
    ]
