"""A minute of holding through pipelines: mean time a frame, processor time, turn error."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

from slipguard.bench.minute import HoldingScene
from slipguard.bench.pipelines import BenchPipeline

EVERY_UNSKIPPED = 10
"""Without skipping all frames cost alike: of a pipeline that skips nothing only so many-th frames are run."""
WARM_UP = 40


@dataclass(slots=True)
class HoldingResult:
    """One pipeline over the minute. frames: how many were run. skipped: how many of them were left out, by reason.

    measured_s: spent on those that were not.
    """

    frames: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    errors_deg: list[float] = field(default_factory=list)
    skipped: dict[str, int] = field(default_factory=dict)
    measured_s: float = 0.0

    @property
    def measured_ms(self) -> float:
        """Mean time of a frame that was not left out."""
        return 1e3 * self.measured_s / max(self.frames - sum(self.skipped.values()), 1)

    @property
    def mean_ms(self) -> float:
        """Of a frame."""
        return 1e3 * self.wall_s / max(self.frames, 1)

    @property
    def cpu_s_per_minute(self) -> float:
        """Seconds of one core that a minute of frames takes."""
        return 60.0 * 60.0 * self.cpu_s / max(self.frames, 1)


def hold(
    subjects: list[BenchPipeline], minute: HoldingScene, every: dict[str, int] | None = None
) -> dict[str, HoldingResult]:
    """Run pipelines over the same minute, by name. every: of some, only so many-th frames."""
    scene = minute.scene()
    opened: list[tuple[BenchPipeline, Any, int]] = [
        (one, one.open(scene), (every or {}).get(one.name, 1 if one.skips.unchanged else EVERY_UNSKIPPED))
        for one in subjects
    ]
    held = {one.name: HoldingResult() for one in subjects}
    for index, shot in enumerate(minute.shots()):
        for subject, processor, step in opened:
            # The reference needs every frame of the beginning.
            if step > 1 and index > WARM_UP + 60 and index % step:
                continue
            own = held[subject.name]
            cpu_s, wall_s = time.process_time(), time.perf_counter()
            seen = processor.process(shot.frame)
            wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
            if step == 1 or index % step == 0:
                own.frames += 1
                own.wall_s += wall_s
                own.cpu_s += cpu_s
                own.measured_s += wall_s if seen.skipped is None else 0.0
            if seen.skipped is not None:
                own.skipped[seen.skipped] = own.skipped.get(seen.skipped, 0) + 1
            if shot.compared and seen.angle_deg is not None:
                own.errors_deg.append(abs(seen.angle_deg - shot.rotation_deg))
    return held
