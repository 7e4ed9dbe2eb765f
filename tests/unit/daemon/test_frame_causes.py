"""The causes of a finger without fresh frames: each from the figures of its kind."""

from __future__ import annotations

import math
import re

import pytest

from slipguard.control.messages import Condition
from slipguard.daemon.loop.frame_causes import ARRIVALS, STALE_S, Arrival, FrameFigures, find_cause

NOW_S = 5000.0
LATENCY_S = 0.045


def arrivals(every_s: float, *, stamp_error_s: float = 0.0, step: int = 1, newest_s: float = 0.0) -> list[Arrival]:
    """Frames at an interval, the last one received `newest_s` ago."""
    times_s = [NOW_S - newest_s - every_s * k for k in reversed(range(ARRIVALS))]
    return [Arrival(at_s, at_s - LATENCY_S + stamp_error_s, 100 + step * k) for k, at_s in enumerate(times_s)]


def stamped_0() -> list[Arrival]:
    return [one._replace(captured_at_s=0.0) for one in arrivals(1 / 60)]


CASES: list[tuple[str, list[Arrival], dict[str, object], Condition, str]] = [
    ("all well", arrivals(1 / 60), {"age_s": 0.06}, Condition.FRESH, ""),
    ("unplugged", [], {"connected": False, "refused": "unplugged"}, Condition.LOST, "unplugged"),
    (
        "stamps of an hour ago",
        arrivals(1 / 60, stamp_error_s=-3600.0),
        {},
        Condition.STALE,
        "3600.0. s before .* clock",
    ),
    ("stamps of 0", stamped_0(), {}, Condition.STALE, "stamped 5000.00 s before they arrive: the camera's clock"),
    ("stamps ahead", arrivals(1 / 60, stamp_error_s=5.0), {}, Condition.STALE, "4.9. s ahead of the clock: the camera"),
    ("images in a queue", arrivals(1 / 60, stamp_error_s=-0.5), {}, Condition.STALE, "0.5. s old on arrival .* queue"),
    ("a tenth of the frames", arrivals(1 / 6, step=10, newest_s=0.16), {}, Condition.STALE, "only 10 % .* cable"),
    ("a slow camera", arrivals(1 / 6, newest_s=0.16), {}, Condition.STALE, "delivers 6 frames per second"),
    ("slow, just received", arrivals(1 / 6, newest_s=0.02), {"age_s": 0.18}, Condition.STALE, "delivers 6 frames"),
    ("a stall", arrivals(1 / 60, newest_s=0.4), {}, Condition.STALE, r"no frame for 0\.40 s"),
    ("a stall of a slow camera", arrivals(1 / 6, newest_s=0.4), {}, Condition.STALE, r"no frame for 0\.40 s"),
    ("nothing yet", [], {}, Condition.STALE, "no frame yet"),
    ("repeated", arrivals(1 / 60, newest_s=0.4), {"refused": "repeats itself"}, Condition.STALE, "repeats itself"),
    ("damaged", arrivals(1 / 60, newest_s=0.2), {"refused": "damaged frame"}, Condition.STALE, "damaged frame"),
    ("slow processing", arrivals(1 / 60), {"age_s": 0.5}, Condition.LATE, "processed 0.50 s late: this machine is too"),
    ("hung processing", arrivals(1 / 60), {"age_s": 0.5, "hangs_s": 0.5}, Condition.STUCK, "has not returned"),
]


@pytest.mark.parametrize(("name", "frames", "known", "condition", "why"), CASES)
def test_the_cause(name: str, frames: list[Arrival], known: dict[str, object], condition: Condition, why: str) -> None:
    age_s = NOW_S - frames[-1].captured_at_s if frames else math.inf
    figures = FrameFigures(**({"age_s": age_s} | known))  # type: ignore[arg-type]
    found, text = find_cause(figures.with_arrivals(frames, NOW_S))
    assert found is condition
    assert re.search(why, text), text
    assert ("busy" in text) is (condition is Condition.LATE)


def test_a_frame_is_fresh_up_to_the_limit_on_either_side() -> None:
    for age_s in (-STALE_S, 0.0, STALE_S):
        assert find_cause(FrameFigures(age_s=age_s))[0] is Condition.FRESH
    for age_s in (-STALE_S - 0.001, STALE_S + 0.001, math.inf):
        assert find_cause(FrameFigures(age_s=age_s))[0] is not Condition.FRESH
