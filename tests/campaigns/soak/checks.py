"""Whether a soak was passed: work done, nothing dropped, memory flat, nothing left over, the ring within its limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from slipguard.daemon.loop.service import FINGERS
from slipguard.daemon.store.state_dir import KEPT
from tests.campaigns.soak.resources import ResourceSample

WARM_UP_SHARE, END_SHARE = 0.15, 0.2
"""Left out at the beginning; compared: the first and the last fifth of what remains."""
GROWTH_MAX = 0.02
MISSED_MAX = 0.001
OTHER_STATE_FILES = 1 + 2 * len(FINGERS) + 1
"""The last grasp, of each finger the reference's picture and facts, and one that is just being written."""


@dataclass(frozen=True, slots=True)
class SoakCheck:
    """One figure beside what is allowed: the most, or with at_least the least."""

    what: str
    value: float
    allowed: float
    at_least: bool = False

    @property
    def good(self) -> bool:
        """NaN is not."""
        return self.value >= self.allowed if self.at_least else self.value <= self.allowed


@dataclass(frozen=True, slots=True)
class StorageLimits:
    """Of the recordings, as configured. One file more than `ring_files` is being written."""

    ring_files: int
    ring_mb: float
    kept_mb: float


@dataclass(frozen=True, slots=True)
class WorkDone:
    """What was done while it ran. calibrations: the first one, too.

    recording_stops, left_out: how often the recorder stopped, for good included, and values it had no room for; None
    without recordings. pictures, connections_lost: of the page; None without one.
    """

    lifts: int
    dropped: int
    calibrations: int
    recording_stops: int | None = None
    left_out: int | None = None
    pictures: int | None = None
    connections_lost: int | None = None

    @property
    def state_files(self) -> int:
        """How many there may be: of each sensor so many images, each a picture and its facts, and a gel's first."""
        return 2 * len(FINGERS) * min(self.calibrations, KEPT + 1) + OTHER_STATE_FILES


def growth(values: Sequence[float]) -> float:
    """By how much the last fifth's median is above the first's, as a share; the warm-up is left out."""
    steady = values[round(WARM_UP_SHARE * len(values)) :]
    if not steady:
        return float("nan")
    part = max(1, round(END_SHARE * len(steady)))
    before, after = median(steady[:part]), median(steady[-part:])
    return after / before - 1.0 if before else 0.0


def check_soak(
    pulses: Sequence[ResourceSample],
    before: ResourceSample,
    after: ResourceSample,
    limits: StorageLimits,
    work: WorkDone,
    missed: int,
    beats: int,
) -> list[SoakCheck]:
    """pulses: while the daemon ran. before, after: without the daemon.

    missed, beats: deadlines of the loop missed, and how many there were.
    """
    steady = pulses[round(WARM_UP_SHARE * len(pulses)) :]
    part = max(1, round(END_SHARE * len(steady)))

    def more(name: str) -> float:
        """The last fifth's median above the first's: what comes and goes, or is once not there, does not count."""
        counts = [float(getattr(one, name)) for one in steady]
        return median(counts[-part:]) - median(counts[:part]) if counts else float("nan")

    def most(name: str) -> float:
        return max((float(getattr(one, name)) for one in pulses), default=float("nan"))

    done = [SoakCheck("lifts", work.lifts, 1, at_least=True), SoakCheck("dropped", work.dropped, 0)]
    if work.recording_stops is not None and work.left_out is not None:
        done += [
            SoakCheck("megabytes recorded", most("ring_mb") + most("kept_mb"), 0.1, at_least=True),
            SoakCheck("times the recording stopped", work.recording_stops, 0),
            SoakCheck("values left out of the recordings", work.left_out, 0),
        ]
    if work.pictures is not None and work.connections_lost is not None:
        done += [
            SoakCheck("pictures on the page", work.pictures, 1, at_least=True),
            SoakCheck("connections the page lost", work.connections_lost, 0),
        ]
    return [
        *done,
        SoakCheck("memory growth", growth([one.rss_mb for one in pulses]), GROWTH_MAX),
        SoakCheck("growth of what Python has allocated, blocks", growth([one.blocks for one in pulses]), GROWTH_MAX),
        SoakCheck("memory growth of the child processes", growth([one.children_mb for one in pulses]), GROWTH_MAX),
        SoakCheck("tasks more at the end than after the warm-up", more("tasks"), 0),
        SoakCheck("threads more", more("threads"), 0),
        SoakCheck("open files more", more("files"), 0),
        SoakCheck("child processes more", more("children"), 0),
        SoakCheck("tasks left when the daemon has ended", after.tasks - before.tasks, 0),
        SoakCheck("threads left", after.threads - before.threads, 0),
        SoakCheck("open files left", after.files - before.files, 0),
        SoakCheck("child processes left", after.children - before.children, 0),
        SoakCheck("files in the state directory", most("state_files"), work.state_files),
        SoakCheck("files in the ring", most("ring_files"), limits.ring_files + 1),
        SoakCheck("megabytes in the ring", most("ring_mb"), limits.ring_mb),
        SoakCheck("megabytes kept", most("kept_mb"), limits.kept_mb),
        SoakCheck("deadlines missed, share", missed / max(beats, 1), MISSED_MAX),
    ]
