"""A short fault campaign, and that it would notice what it looks for."""

from __future__ import annotations

import json
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
from tests.campaigns.faults import campaign_cell, command, trial
from tests.campaigns.faults.command import describe, quiet_trial
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
    results = [quiet_trial(seed) for seed in range(len(KINDS))]
    assert {plan.kind.name for result in results for plan in result.plans} == set(KINDS)
    assert [describe(result) for result in results if result.failed] == []


def test_every_kind_of_fault_is_drawn_and_every_fault_of_the_fakes_is_a_kind() -> None:
    plans = [plan for seed in range(3 * len(KINDS)) for plan in draw(np.random.default_rng(seed), seed)]
    assert {plan.kind.name for plan in plans} == set(KINDS)
    assert {f"{device}.{fault}" for device, faults in ON_THE_BOARD.items() for fault in faults} <= set(KINDS)
    assert all(0.0 < plan.at_s < 10.0 for plan in plans)
    assert {len(draw(np.random.default_rng(seed), seed)) for seed in range(50)} == {1, 2, 3}


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
    assert "force added" in describe(result)


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
    failing = TrialResult(7, "cap", planned(("arm.stuck", 1.0, 2.0)), unnamed=("arm.stuck",), due=("arm.stuck",))
    fine = TrialResult(
        8, "cap", planned(("left.stall", 1.0, np.inf)), named=(("left.stall", 0.2),), due=("left.stall",)
    )
    monkeypatch.setattr(command, "trial", lambda seed: failing if seed == 7 else fine)
    assert run(["faults", "--runs", "2", "--seed", "7", "--jobs", "1", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["runs"], found["unnamed faults"], found["avoidable drops"]) == (2, 1, 0)
    assert found["exceeded"] == ["unnamed faults"]
    assert found["faults"]["left.stall"] == {"observable": 1.0, "named_s_median": 0.2, "named_s_max": 0.2}
    assert found["failed"] == ["seed 7 (cap; arm.stuck at 1.00 s for 2.00 s): not named: arm.stuck"]
    assert run(["faults", "--runs", "1", "--seed", "8"]) == 0
