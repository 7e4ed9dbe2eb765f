"""Stable holds: their disturbances, and which tightenings count as false."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipguard.bench.grip import stable_holds
from slipguard.bench.grip.closed_loop import FINGERS, ClosedLoop
from slipguard.bench.grip.controllers import UnguardedController
from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors, RotationOutliers
from slipguard.bench.grip.stable_holds import HOLD_NUMBERS, RENDERED_NUMBERS, StableHold, run_hold
from slipguard.bench.grip.trial_run import delivery_rng, grip, modeled_finger, world_of
from slipguard.bench.grip.trials import draw
from slipguard.control.messages import Condition, Observation, StepOutput
from slipguard.sim.gel_view import GelView
from slipguard.sim.world import World


def plan(*, soft: bool = False, margin: float = 1.6, seconds: float = 8.0) -> StableHold:
    return StableHold(draw(HOLD_NUMBERS, "wrench", 0.97, 0.1, soft, 60.0), margin, seconds)


@pytest.mark.parametrize("soft", [False, True])
def test_a_firm_grip_holds(soft: bool) -> None:
    held = run_hold(plan(soft=soft))
    assert held.failed is None
    assert held.seconds >= 8.0
    assert held.slip_deg < 0.1
    assert held.elastic_deg > (1.0 if soft else 0.05)
    assert held.false == held.tightenings + held.lifting


def test_a_failed_hold_has_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stable_holds, "LIFTS_WITHIN_S", 0.2)
    assert "not holding after the lift: lifting" in str(run_hold(plan()).failed)


def test_holds_are_spread_and_some_are_rendered() -> None:
    some, drawn = stable_holds.holds(4.0), stable_holds.holds(1.0, 0, 30.0, rendered=True)
    assert [one.trial.number for one in some] == [HOLD_NUMBERS + k for k in range(4)]
    assert [one.trial.number for one in drawn] == [RENDERED_NUMBERS, RENDERED_NUMBERS + 1]
    assert all(one.rendered for one in drawn)
    assert len({one.trial.soft for one in some}) == 2


def test_a_tightening_is_false_without_slip_since_the_last_one() -> None:
    empty = replace(World().truth(0.0), slipping=True)
    trace = [
        replace(empty, time_s=0.1 * k, slip_deg=0.02 + 0.3 * (0.1 * k >= 3.0), slip_rate_mm_s=1.0 * (k == 90))
        for k in range(100)
    ]
    tightened_s = [2.0, 4.0, 8.0, 9.5]
    assert stable_holds._false_tightenings(tightened_s, trace, 0.0) == [2.0, 8.0]
    assert stable_holds._false_tightenings([3.0 + stable_holds.RECENT_S + 0.2], trace, 0.0) == [
        3.0 + stable_holds.RECENT_S + 0.2
    ]


def test_a_single_frame_has_the_same_error_in_both_fingers() -> None:
    off = stable_holds.outliers(np.random.default_rng(1), 10.0, 60.0)
    assert off["left"].times_s == off["right"].times_s
    assert off["left"].deg == -off["right"].deg
    assert abs(off["left"].deg) == 0.6
    finger_model = ModeledFinger(PerceptionErrors(0.0, 0.0, 0.0, 0.1, 0.0), np.random.default_rng(1))
    finger_model.add_outliers(RotationOutliers((1.0,), 0.6))
    rotations = [finger_model.process(GelView("key", depth_mm=0.5), 0.9 + 0.02 * k, k).rotation_deg for k in range(12)]
    assert rotations[5:] == [pytest.approx(0.6), *[pytest.approx(0.0, abs=1e-9)] * 6]


def test_a_finger_without_frames_becomes_stale() -> None:
    trial = plan().trial
    observations: list[Observation] = []

    class Observing(UnguardedController):
        def decide(self, now: Observation) -> StepOutput:
            observations.append(now)
            return UnguardedController.decide(self, now)

    fingers = {finger: modeled_finger(trial, k) for k, finger in enumerate(FINGERS)}
    loop = ClosedLoop(world_of(trial), Observing(), fingers, delivery_rng(trial))
    grip(loop, 80.0)
    loop.wait(0.5)
    loop.outage = lambda finger, now_s: finger == "left"
    loop.wait(0.4)
    assert observations[-1].left.condition is Condition.STALE
    assert observations[-1].right.condition is Condition.FRESH
    assert observations[-1].fused is not None
    assert observations[-1].fused.fingers == ("right",)
    loop.outage = lambda finger, now_s: False
    loop.wait(0.2)
    assert observations[-1].fused is not None
    assert observations[-1].fused.fingers == ("left", "right")


def test_outages_affect_single_fingers_and_end() -> None:
    outage = stable_holds.outages(np.random.default_rng(2), 100.0, 60.0)
    times_s = 100.0 + np.arange(0.0, 62.0, 0.01)
    lost_s = {finger: sum(outage(finger, now_s) for now_s in times_s) * 0.01 for finger in FINGERS}
    assert 0.1 < sum(lost_s.values()) < 3.0
    assert not any(outage(finger, 99.0) for finger in FINGERS)
