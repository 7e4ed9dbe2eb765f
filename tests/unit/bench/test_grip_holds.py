"""Stable holds: that they hold, what disturbs them, and what counts as a tightening for nothing."""

from __future__ import annotations

import numpy as np
import pytest

from slipguard.bench.grip import stable_holds
from slipguard.bench.grip.closed_loop import FINGERS, ClosedLoop, LoopTrace
from slipguard.bench.grip.controllers import UnguardedController
from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors, RotationOutliers
from slipguard.bench.grip.stable_holds import HOLD_NUMBERS, RENDERED_NUMBERS, StableHold, hold
from slipguard.bench.grip.trial_run import chances, grip, model_sight, world_of
from slipguard.bench.grip.trials import draw
from slipguard.control.messages import Condition, Observation, StepOutput
from slipguard.sim.gel_view import GelView


def plan(*, soft: bool = False, margin: float = 1.6, seconds: float = 8.0) -> StableHold:
    return StableHold(draw(HOLD_NUMBERS, "wrench", 0.97, 0.1, soft, 60.0), margin, seconds)


@pytest.mark.parametrize("soft", [False, True])
def test_a_firm_hold_holds(soft: bool) -> None:
    held = hold(plan(soft=soft))
    assert held.failed is None
    assert held.seconds >= 8.0
    assert held.slip_deg < 0.1
    assert held.wound_deg > (1.0 if soft else 0.05)
    assert held.false == held.tightenings + held.lifting


def test_a_hold_that_is_none_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stable_holds, "LIFTS_WITHIN_S", 0.2)
    assert "not holding after the lift: lifting" in str(hold(plan()).failed)


def test_holds_are_spread_and_some_are_rendered() -> None:
    some, drawn = stable_holds.holds(4.0), stable_holds.holds(1.0, 0, 30.0, rendered=True)
    assert [one.trial.number for one in some] == [HOLD_NUMBERS + k for k in range(4)]
    assert [one.trial.number for one in drawn] == [RENDERED_NUMBERS, RENDERED_NUMBERS + 1]
    assert all(one.rendered for one in drawn)
    assert len({one.trial.soft for one in some}) == 2


def test_a_tightening_counts_as_false_where_nothing_slipped_since_the_one_before() -> None:
    trace = LoopTrace(time_s=[0.1 * k for k in range(100)], sliding=[k == 90 for k in range(100)])
    trace.slip_deg = [0.02 + 0.3 * (time_s >= 3.0) for time_s in trace.time_s]
    told = [2.0, 4.0, 8.0, 9.5]
    assert stable_holds._for_nothing(told, trace, 0.0) == [2.0, 8.0]
    assert stable_holds._for_nothing([3.0 + stable_holds.LATELY_S + 0.2], trace, 0.0) == [
        3.0 + stable_holds.LATELY_S + 0.2
    ]


def test_one_frame_is_off_and_its_turn_is_common_to_both_fingers() -> None:
    off = stable_holds.outliers(np.random.default_rng(1), 10.0, 60.0)
    assert off["left"].times_s == off["right"].times_s
    assert off["left"].deg == -off["right"].deg
    assert abs(off["left"].deg) == 0.6
    sight = ModeledFinger(PerceptionErrors(0.0, 0.0, 0.0, 0.1, 0.0), np.random.default_rng(1))
    sight.err_at(RotationOutliers((1.0,), 0.6))
    rotations = [sight.look(GelView("key", depth_mm=0.5), 0.9 + 0.02 * k, k).angle_deg for k in range(12)]
    assert rotations[5:] == [pytest.approx(0.6), *[pytest.approx(0.0, abs=1e-9)] * 6]


def test_a_blind_finger_says_nothing_once_its_newest_frame_is_old() -> None:
    trial = plan().trial
    seen: list[Observation] = []

    class Watching(UnguardedController):
        def decide(self, now: Observation) -> StepOutput:
            seen.append(now)
            return UnguardedController.decide(self, now)

    fingers = {finger: model_sight(trial, k) for k, finger in enumerate(FINGERS)}
    loop = ClosedLoop(world_of(trial), Watching(), fingers, chances(trial))
    grip(loop, 80.0)
    loop.wait(0.5)
    loop.blind = lambda finger, now_s: finger == "left"
    loop.wait(0.4)
    assert seen[-1].left.condition is Condition.STALE
    assert seen[-1].right.condition is Condition.FRESH
    assert seen[-1].fused is not None
    assert seen[-1].fused.fingers == ("right",)
    loop.blind = lambda finger, now_s: False
    loop.wait(0.2)
    assert seen[-1].fused is not None
    assert seen[-1].fused.fingers == ("left", "right")


def test_outages_come_to_one_finger_at_a_time_and_pass() -> None:
    blind = stable_holds.outages(np.random.default_rng(2), 100.0, 60.0)
    times_s = 100.0 + np.arange(0.0, 62.0, 0.01)
    dark_s = {finger: sum(blind(finger, now_s) for now_s in times_s) * 0.01 for finger in FINGERS}
    assert 0.1 < sum(dark_s.values()) < 3.0
    assert not any(blind(finger, 99.0) for finger in FINGERS)
