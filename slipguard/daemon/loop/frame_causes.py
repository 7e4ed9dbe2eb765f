"""Why a finger has no fresh frame: a table of causes.

The figures are when frames were stamped, received and processed, how the camera numbers them, and why one was refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from slipguard.control.messages import Condition

STALE_S = 0.15
"""An estimate from an older frame is not used, nor one from a frame this far in the future.

At 30 fps one lost frame gives an age of 122 ms: two frames of 33 ms, 50 ms of latency, 6 ms of processing.
"""
CLOCK_S = 2.0
"""A frame that is older on arrival has a wrong stamp: no camera or kernel queues so many."""
ARRIVALS = 8
"""Newest arrivals that show interval and step."""


class Arrival(NamedTuple):
    """One good frame: when it was received, its stamp, and the camera's number of it."""

    received_at_s: float
    captured_at_s: float
    sequence: int


@dataclass(frozen=True, slots=True)
class FrameFigures:
    """What is known about one finger's frames.

    age_s: since the capture of the newest processed frame; infinite before the first. received_s: since the newest one
    was received. on_arrival_s: reception of that frame less its stamp. interval_s: mean time between receptions; 0 if
    unknown. step: mean increase of the camera's number. refused: why the newest frame was not used; empty if it was.
    hangs_s: for how long a frame's processing has not returned although its thread did not wait for a processor.
    """

    connected: bool = True
    age_s: float = math.inf
    received_s: float = math.inf
    on_arrival_s: float = 0.0
    interval_s: float = 0.0
    step: float = 1.0
    refused: str = ""
    hangs_s: float | None = None

    def with_arrivals(self, arrivals: Sequence[Arrival], now_s: float) -> FrameFigures:
        """Return the figures with those of the newest good frames, oldest first."""
        if not arrivals:
            return self
        first, last, spans = arrivals[0], arrivals[-1], len(arrivals) - 1
        return replace(
            self,
            received_s=now_s - last.received_at_s,
            on_arrival_s=last.received_at_s - last.captured_at_s,
            interval_s=(last.received_at_s - first.received_at_s) / max(spans, 1),
            step=(last.sequence - first.sequence) / spans if spans else 1.0,
        )


class Cause(NamedTuple):
    """One row: when it applies, how the finger counts then, and the cause in words."""

    applies: Callable[[FrameFigures], bool]
    condition: Condition
    why: Callable[[FrameFigures], str]


def _rare(figures: FrameFigures) -> bool:
    """Frames come at an interval that leaves no fresh one now and then, and the present pause is no longer."""
    return figures.interval_s > 0.5 * STALE_S and figures.received_s <= 2.0 * figures.interval_s


CAUSES: tuple[Cause, ...] = (
    Cause(lambda f: not f.connected, Condition.LOST, lambda f: f.refused),
    Cause(lambda f: abs(f.age_s) <= STALE_S, Condition.FRESH, lambda f: f.refused),
    Cause(lambda f: bool(f.refused), Condition.STALE, lambda f: f.refused),
    Cause(
        lambda f: f.received_s <= STALE_S and f.on_arrival_s > CLOCK_S,
        Condition.STALE,
        lambda f: f"its frames are stamped {f.on_arrival_s:.2f} s before they arrive: the camera's clock is wrong",
    ),
    Cause(
        lambda f: f.received_s <= STALE_S and f.on_arrival_s < -STALE_S,
        Condition.STALE,
        lambda f: f"its frames are stamped {-f.on_arrival_s:.2f} s ahead of the clock: the camera's clock is wrong",
    ),
    Cause(
        lambda f: f.received_s <= STALE_S and f.on_arrival_s > STALE_S,
        Condition.STALE,
        lambda f: (
            f"its frames are {f.on_arrival_s:.2f} s old on arrival (limit {STALE_S:g} s): they wait in a queue, or "
            "the camera's clock is wrong"
        ),
    ),
    Cause(
        lambda f: _rare(f) and f.step >= 2.0,
        Condition.STALE,
        lambda f: (
            f"only {100.0 / f.step:.0f} % of its frames arrive, {1.0 / f.interval_s:.0f} per second: check its cable, "
            "and use ports of different USB controllers"
        ),
    ),
    Cause(
        _rare,
        Condition.STALE,
        lambda f: f"it delivers {1.0 / f.interval_s:.0f} frames per second: check its frame rate and exposure",
    ),
    Cause(lambda f: math.isinf(f.received_s), Condition.STALE, lambda f: "no frame yet"),
    Cause(lambda f: f.received_s > STALE_S, Condition.STALE, lambda f: f"no frame for {f.received_s:.2f} s"),
    Cause(
        lambda f: f.hangs_s is not None,
        Condition.STUCK,
        lambda f: f"the processing of a frame has not returned for {f.hangs_s:.2f} s",
    ),
    Cause(
        lambda f: True,
        Condition.LATE,
        lambda f: f"its frames are processed {f.age_s:.2f} s late: this machine is too busy",
    ),
)
"""The first row that applies is the cause."""


def find_cause(figures: FrameFigures) -> tuple[Condition, str]:
    """Return whether a finger's frames are fresh, and why they are not."""
    cause = next(cause for cause in CAUSES if cause.applies(figures))
    return cause.condition, cause.why(figures)
