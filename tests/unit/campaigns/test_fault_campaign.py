"""A short fault campaign, and that it would notice what it looks for."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import HaltJaws, Observation, ReleaseJaws, StepOutput
from slipguard.control.params import GuardParams
from slipguard.daemon.loop import device_health
from slipguard.daemon.loop.service import Service
from slipguard.sim.injected_faults import KINDS as ON_THE_BOARD
from tests.campaigns.command_line import run
from tests.campaigns.faults import campaign_cell, trial
from tests.campaigns.faults.campaign import CampaignResult, run_campaign
from tests.campaigns.faults.command import describe
from tests.campaigns.faults.kinds import KINDS, PlannedFault, draw
from tests.campaigns.faults.trial import TrialResult

pytestmark = pytest.mark.campaign


def planned(*plans: tuple[str, float, float]) -> tuple[PlannedFault, ...]:
    return tuple(PlannedFault(KINDS[name], at_s, for_s) for name, at_s, for_s in plans)


def with_plans(monkeypatch: pytest.MonkeyPatch, *plans: tuple[str, float, float], seed: int = 3) -> TrialResult:
    monkeypatch.setattr(trial, "draw", lambda rng, seed: planned(*plans))
    return trial.trial(seed)


def test_a_run_with_each_kind_of_fault() -> None:
    """The first fault of a run follows from its seed; the log must name each in the words of the present messages."""
    found = run_campaign(len(KINDS), 0)
    assert all(tally.runs for tally in found.kinds.values())
    assert not found.failures, [describe(result) for result in found.failures]


def test_every_kind_of_fault_is_drawn_and_every_fault_of_the_fakes_is_a_kind() -> None:
    plans = [plan for seed in range(3 * len(KINDS)) for plan in draw(np.random.default_rng(seed), seed)]
    assert {plan.kind.name for plan in plans} == set(KINDS)
    assert {f"{device}.{fault}" for device, faults in ON_THE_BOARD.items() for fault in faults} <= set(KINDS)
    assert all(0.0 < plan.at_s < 10.0 for plan in plans)
    assert {len(draw(np.random.default_rng(seed), seed)) for seed in range(50)} == {1, 2, 3}


def test_the_same_seed_is_the_same_run() -> None:
    assert trial.trial(20) == trial.trial(20)


def test_a_removed_object_and_a_stuck_arm_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    result = with_plans(monkeypatch, ("arm.stuck", 0.9, np.inf), ("object.taken", 6.0, np.inf))
    assert set(result.due) == {"arm.stuck", "object.taken"}
    assert not result.failed
    assert any("arm stuck" in line for line in result.lines)


# Broken products: the campaign must see it.


def test_it_detects_jaws_that_open(monkeypatch: pytest.MonkeyPatch) -> None:
    def opens(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, StepOutput]:
        state, output = control_step(state, observation, params)
        return state, replace(output, gripper=ReleaseJaws(60.0)) if output.fault is not None else output

    monkeypatch.setattr(campaign_cell, "control_step", opens)
    result = with_plans(monkeypatch, ("arm.timeout", 3.0, np.inf))
    assert result.openings
    assert result.failed


def test_it_detects_jaws_that_go_on_in_a_stop_of_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    def goes_on(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, StepOutput]:
        state, output = control_step(state, observation, params)
        return state, replace(output, gripper=None if isinstance(output.gripper, HaltJaws) else output.gripper)

    plan = ("arm.emergency_stop", 0.3, np.inf)
    assert with_plans(monkeypatch, plan).presses == 0
    monkeypatch.setattr(campaign_cell, "control_step", goes_on)
    result = with_plans(monkeypatch, plan)
    assert result.presses
    assert result.failed
    assert "pressed harder" in describe(result)


def test_it_detects_a_drop_that_holding_would_have_prevented(monkeypatch: pytest.MonkeyPatch) -> None:
    def lets_slip(
        state: ControlState, observation: Observation, params: GuardParams
    ) -> tuple[ControlState, StepOutput]:
        state, output = control_step(state, observation, params)
        late = observation.arm is not None and observation.arm.height_mm > 140.0
        return state, replace(output, gripper=ReleaseJaws(70.0)) if late else output

    monkeypatch.setattr(campaign_cell, "control_step", lets_slip)
    monkeypatch.setitem(campaign_cell.LIFT, "lift_height_mm", 150.0)
    result = with_plans(monkeypatch, ("left.stall", 1.2, np.inf), seed=23)
    assert result.dropped is not None
    assert result.avoidable


def test_it_detects_a_fault_that_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_health.DeviceAlerts, "update", lambda self, *observation: None)
    result = with_plans(monkeypatch, ("left.corrupt", 4.0, np.inf))
    assert result.unnamed == ("left.corrupt",)


def test_it_detects_a_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks(self: Service, now_s: float) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(Service, "_run_cycle", breaks)
    result = with_plans(monkeypatch, ("left.corrupt", 4.0, np.inf))
    assert any("of all things" in crash for crash in result.crashes)


def test_it_detects_a_task_that_is_left_over(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = []
    built = Service.run

    async def leaks(self: Service) -> None:
        import asyncio

        kept.append(asyncio.create_task(asyncio.Event().wait(), name="forgotten"))
        await built(self)

    monkeypatch.setattr(Service, "run", leaks)
    result = with_plans(monkeypatch, ("left.duplicate", 1.0, 1.0))
    assert result.leaked == ("forgotten",)


def test_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.campaigns.faults import campaign as campaigns

    failing = TrialResult(7, "cap", planned(("arm.stuck", 1.0, 2.0)), unnamed=("arm.stuck",), due=("arm.stuck",))
    fine = TrialResult(
        8, "cap", planned(("left.stall", 1.0, np.inf)), named=(("left.stall", 0.2),), due=("left.stall",)
    )
    monkeypatch.setattr(campaigns, "trial", lambda seed: failing if seed == 7 else fine)
    assert run(["faults", "--runs", "2", "--seed", "7", "--jobs", "1", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found | {"runs": 2, "unnamed_faults": 1, "drops_avoidable": 0, "failed_seeds": [7]} == found
    assert set(found) >= {"runs", "drops_avoidable", "openings", "unnamed_faults", "crashes", "leaked_tasks"}
    assert run(["faults", "--runs", "2", "--seed", "7", "--jobs", "1"]) == 1
    message = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert "--runs 1 --seed 7" in message
    assert run(["faults", "--runs", "1", "--seed", "8", "--jobs", "1"]) == 0
    assert "seed 8" in capsys.readouterr().out
    assert run(["faults", "--runs", "0"]) == 2
    assert "--runs" in capsys.readouterr().err


def test_an_empty_campaign_has_nothing_to_show() -> None:
    assert CampaignResult().as_json()["runs"] == 0


def test_each_kind_is_listed_with_the_time_until_it_was_named() -> None:
    found = CampaignResult()
    for seed, named_s in ((1, 0.1), (2, 0.3), (3, 0.4)):
        plans = planned(("arm.timeout", 1.0, np.inf))
        found.count(TrialResult(seed, "cap", plans, named=(("arm.timeout", named_s),), due=("arm.timeout",)))
    kinds = found.as_json()["kinds"]
    assert isinstance(kinds, dict)
    assert kinds["arm.timeout"] == {
        "runs": 3, "observable": 3, "unnamed": 0, "named_s_median": 0.3, "named_s_max": 0.4,
    }  # fmt: skip
    assert kinds["arm.stuck"]["named_s_max"] is None
