"""A finger that is certain that nothing rotates (dirt, an imprint, a pad that rotates along) hides no slip."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from observations import estimate, gripper, observation
from records import changed, grasp_state, released_mm

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.finger_fusion import DIFFER_DEG, DIFFER_SHARE, FusedEstimate, fuse
from slipguard.control.messages import StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.perception.estimate import Estimate
from slipguard.perception.skipping import repeat_estimate, second_finger_can_skip

PARAMS = GuardParams()
FRAME_S = 1 / 60
REST_S = 1.0
"""Time at rest before the slip begins."""
NOTICED_S = 0.25


@dataclass(slots=True)
class Pair:
    """The left finger is stuck at 0 with an unchanged image; the right one sees the object rotate and come to rest."""

    sigma_deg: float
    rate_deg_s: float
    spare: bool = False
    rests_deg: float = 12.0
    declines_every: int = 0
    silent_s: tuple[float, float] = (math.inf, math.inf)
    phase_s: float = 0.0
    left_measured_s: float = 0.0
    right: Estimate | None = None
    looks: list[float] = field(default_factory=list)

    def rotation_deg(self, now_s: float) -> float:
        return min(max(now_s - REST_S - self.phase_s, 0.0) * self.rate_deg_s, self.rests_deg)

    def assess_slip(self, now_s: float) -> Estimate:
        self.looks.append(now_s)
        silent = self.silent_s[0] <= now_s < self.silent_s[1]
        if silent or (self.declines_every and len(self.looks) % self.declines_every == 0):
            return estimate(None, at_s=now_s, shift_mm=(0.0, 0.0), declined="estimators disagree")
        rotation_deg = self.rotation_deg(now_s)
        rate_deg_s = -self.rate_deg_s * (0.0 < rotation_deg < self.rests_deg)
        return estimate(-rotation_deg, self.sigma_deg, at_s=now_s, rate_deg_s=rate_deg_s, shift_mm=(0.0, 0.0))

    def see(self, now_s: float) -> FusedEstimate:
        skips = now_s - self.left_measured_s < NOTICED_S
        self.left_measured_s = self.left_measured_s if skips else now_s
        left = estimate(0.0, 0.1, at_s=now_s, rate_deg_s=0.0, shift_mm=(0.0, 0.0), measured_s=self.left_measured_s)
        left = changed(left, skipped="unchanged" if skips else None)
        if self.spare and self.right is not None and second_finger_can_skip(self.right, left, now_s, NOTICED_S):
            self.right = repeat_estimate(self.right, now_s, 1)
        else:
            self.right = self.assess_slip(now_s)
        both = fuse(left, self.right)
        assert both is not None
        return both


def played(pair: Pair, seconds: float) -> tuple[ControlState, list[tuple[float, FusedEstimate, StepOutput]]]:
    """Held at rest in the air with 40 N, and what the controller does; the gripper takes what it is given."""
    guard = ControlState(grasp_state(phase=Phase.HOLDING, adopted=True, target_n=40.0, referenced=True, closed=True))
    log, force_n = [], 40.0
    for k in range(1, round(seconds / FRAME_S)):
        now_s = k * FRAME_S
        view = pair.see(now_s)
        guard, command = control_step(
            guard, observation(now_s, fused=view, gripper=gripper(force_n, at_s=now_s)), PARAMS
        )
        force_n = command.hold_force_n or force_n
        log.append((now_s, view, command))
    return guard, log


@pytest.mark.parametrize("spare", [False, True])
@pytest.mark.parametrize(("sigma_deg", "within_deg"), [(0.1, 5.0), (0.2, 5.0), (0.44, 5.0), (1.0, 7.0)])
def test_the_controller_tightens_and_then_stops_the_arm(sigma_deg: float, within_deg: float, spare: bool) -> None:
    pair = Pair(sigma_deg, 20.0, spare)
    guard, log = played(pair, REST_S + 2.5)
    late_deg = 20.0 * NOTICED_S * spare  # a finger that is left out is looked at that late
    tightened_s = next(now_s for now_s, _, command in log if command.hold_force_n is not None)
    assert 0.0 < pair.rotation_deg(tightened_s) <= within_deg + late_deg
    begun_s = next(now_s for now_s, view, _ in log if view.conflict is not None)
    given = [command.text for _, _, command in log if command.text is not None and "(left +0.0°" in command.text]
    assert len(given) == 2  # once when it begins, once as a fault
    fault_s, stop = next((now_s, command) for now_s, _, command in log if command.fault is not None)
    assert stop.fault is not None
    assert stop.fault.code is FaultCode.ESTIMATE_UNTRUSTED
    assert stop.arm == StopArm()
    assert fault_s - begun_s == pytest.approx(PARAMS.tuning.estimate_timeout_s, abs=2 * FRAME_S)
    assert guard.grasp.phase is Phase.FAULT
    assert all(released_mm(command) is None for _, _, command in log)


@pytest.mark.parametrize("rate_deg_s", [5.0, 20.0, 100.0])
@pytest.mark.parametrize("phase_s", [0.0, 0.07, 0.14, 0.21])
def test_what_a_finger_that_is_left_out_would_say_is_known_within_250_ms(rate_deg_s: float, phase_s: float) -> None:
    pair = Pair(0.3, rate_deg_s, spare=True, phase_s=phase_s)
    _, log = played(pair, REST_S + 1.5)
    beyond_s = next(now_s for now_s, _, _ in log if pair.rotation_deg(now_s) * (1.0 - DIFFER_SHARE) > DIFFER_DEG)
    noticed_s = next(now_s for now_s, view, _ in log if view.conflict is not None)
    assert noticed_s - beyond_s <= NOTICED_S
    at_rest = [now_s for now_s in pair.looks if now_s < REST_S]
    assert len(at_rest) <= 5  # it is left out as long as nothing rotates
    after = [now_s for now_s in pair.looks if now_s >= noticed_s]
    assert np.diff(after) == pytest.approx(FRAME_S)


def test_a_stuck_finger_is_reported_while_the_object_rests_rotated() -> None:
    guard, _ = played(Pair(0.2, 4000.0), REST_S + 1.5)
    assert guard.grasp.fault is not None
    assert guard.grasp.fault.code is FaultCode.ESTIMATE_UNTRUSTED


@pytest.mark.parametrize(("every", "spare"), [(2, False), (5, False), (10, False), (2, True), (10, True)])
def test_a_contradiction_is_not_settled_by_a_moment_of_silence(every: int, spare: bool) -> None:
    """The finger that sees the rotation declines now and then; meanwhile only the stuck one gives an estimate."""
    guard, log = played(Pair(0.2, 20.0, spare, declines_every=every), REST_S + 2.0)
    assert guard.grasp.fault is not None
    assert guard.grasp.fault.code is FaultCode.ESTIMATE_UNTRUSTED
    assert sum("for 1 s" in (command.text or "") for _, _, command in log) == 1


@pytest.mark.parametrize(("silent_for_s", "from_the_start"), [(0.5, True), (0.7, False)])
def test_how_long_a_moment_is(silent_for_s: float, from_the_start: bool) -> None:
    silent_s = (REST_S + 0.4, REST_S + 0.4 + silent_for_s)
    _, log = played(Pair(0.2, 20.0, silent_s=silent_s), REST_S + 3.0)
    begun_s = next(now_s for now_s, view, _ in log if view.conflict is not None)
    fault_s = next(now_s for now_s, _, command in log if command.fault is not None)
    counted_from_s = begun_s if from_the_start else silent_s[1]
    assert fault_s - counted_from_s == pytest.approx(PARAMS.tuning.estimate_timeout_s, abs=2 * FRAME_S)


def test_a_finger_that_is_silent_for_good_leaves_the_other_one_to_be_believed() -> None:
    guard, _ = played(Pair(0.2, 20.0, silent_s=(REST_S + 0.3, math.inf)), REST_S + 3.0)
    assert guard.grasp.phase is Phase.HOLDING


@pytest.mark.parametrize("rotation_deg", [0.0, 2.0, 10.0, 20.0, 30.0])
def test_honest_fingers_do_not_contradict_each_other(rotation_deg: float) -> None:
    """The largest errors of a finger in rendered grasps: 0.8 degrees after the first motion, then 0.8 % of it."""
    off_deg = 0.8 * math.tanh(rotation_deg) + 0.008 * rotation_deg
    both = fuse(estimate(rotation_deg + off_deg, 0.1), estimate(-(rotation_deg - off_deg), 0.1))
    assert both is not None
    assert both.conflict is None
