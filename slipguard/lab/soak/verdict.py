"""Whether a soak was passed: memory flat, nothing left over, the ring within its limits, the beat kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from slipguard.lab.soak.pulse import Pulse

WARM_UP_SHARE, END_SHARE = 0.15, 0.2
"""Left out at the beginning; compared: the first and the last fifth of what remains."""
GROWTH_MAX = 0.02
MISSED_MAX = 0.001


@dataclass(frozen=True, slots=True)
class Finding:
    """One figure beside what is allowed."""

    what: str
    value: float
    allowed: float

    @property
    def good(self) -> bool:
        """NaN is not."""
        return self.value <= self.allowed


@dataclass(frozen=True, slots=True)
class Limits:
    """Of the recordings, as configured. One file more than `ring_files` is being written."""

    ring_files: int
    ring_mb: float
    kept_mb: float


def growth(values: Sequence[float]) -> float:
    """By how much the last fifth's median is above the first's, as a share; the warm-up is left out."""
    steady = values[round(WARM_UP_SHARE * len(values)) :]
    if not steady:
        return float("nan")
    part = max(1, round(END_SHARE * len(steady)))
    before, after = median(steady[:part]), median(steady[-part:])
    return after / before - 1.0 if before else 0.0


def judge(
    pulses: Sequence[Pulse], before: Pulse, after: Pulse, limits: Limits, missed: int, beats: int
) -> list[Finding]:
    """pulses: while the daemon ran, each with nothing gripped. before, after: without the daemon.

    missed, beats: deadlines of the loop missed, and how many there were.
    """
    steady = pulses[round(WARM_UP_SHARE * len(pulses)) :]
    part = max(1, round(END_SHARE * len(steady)))

    def more(name: str) -> float:
        """The least of the last fifth above the least of the first: what comes and goes does not count."""
        counts = [float(getattr(one, name)) for one in steady]
        return min(counts[-part:]) - min(counts[:part]) if counts else float("nan")

    def most(name: str) -> float:
        return max((float(getattr(one, name)) for one in pulses), default=float("nan"))

    return [
        Finding("memory growth", growth([one.rss_mb for one in pulses]), GROWTH_MAX),
        Finding("growth of what Python has allocated, blocks", growth([one.blocks for one in pulses]), GROWTH_MAX),
        Finding("memory growth of the child processes", growth([one.children_mb for one in pulses]), GROWTH_MAX),
        Finding("tasks more at the end than after the warm-up", more("tasks"), 0),
        Finding("threads more", more("threads"), 0),
        Finding("open files more", more("files"), 0),
        Finding("child processes more", more("children"), 0),
        Finding("tasks left when the daemon has ended", after.tasks - before.tasks, 0),
        Finding("threads left", after.threads - before.threads, 0),
        Finding("open files left", after.files - before.files, 0),
        Finding("child processes left", after.children - before.children, 0),
        Finding("files in the ring", most("ring_files"), limits.ring_files + 1),
        Finding("megabytes in the ring", most("ring_mb"), limits.ring_mb),
        Finding("megabytes kept", most("kept_mb"), limits.kept_mb),
        Finding("deadlines missed, share", missed / max(beats, 1), MISSED_MAX),
    ]
