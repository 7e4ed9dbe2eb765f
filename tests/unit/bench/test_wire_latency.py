"""Latency by stage: each command is found in the gripper's log, and the stages add up."""

from __future__ import annotations

import pytest

from slipguard.bench.wire_latency import (
    OWN,
    STAGES,
    STEP_N,
    TOTAL,
    ForceProbe,
    LatencyOptions,
    ProbingController,
    _CommandTimes,
    _evaluate,
)
from slipguard.control.control_step import ControlState
from slipguard.control.messages import Observation
from slipguard.control.params import GuardParams
from slipguard.errors import SlipguardError


def command(at_s: float) -> _CommandTimes:
    """Return a command captured at `at_s`, received 40 ms later, then after 5 ms, 1 ms and 2 ms."""
    return _CommandTimes(ForceProbe(50.0, at_s, at_s), at_s + 0.040, at_s + 0.045, at_s + 0.046, at_s + 0.048)


def writes(at_s: float) -> list[dict[str, object]]:
    """Return the writes of stop and go, 60 ms and 80 ms after the exposure."""
    return [
        {"registers": ["0100", "00FF", "FF32"], "last_byte_s": at_s + 0.060},
        {"registers": ["0900", "00FF", "FF32"], "last_byte_s": at_s + 0.080},
    ]


def test_the_stages_add_up() -> None:
    starts_s = [10.0, 10.2, 10.5]
    seen = [command(at_s) for at_s in starts_s]
    log = [entry for at_s in starts_s for entry in writes(at_s)]
    found = _evaluate(LatencyOptions(commands=3), seen, log, frames=99)
    assert (found.commands, found.frames) == (3, 99)
    assert found.stages[TOTAL].p50_ms == pytest.approx(80.0)
    assert found.stages[OWN].p99_ms == pytest.approx(6.0)
    assert [round(found.stages[stage].p50_ms, 2) for stage in STAGES] == [40.0, 5.0, 1.0, 2.0, 10.7, 20.0, 1.3]
    assert sum(found.stages[stage].p50_ms for stage in STAGES) == pytest.approx(found.stages[TOTAL].p50_ms)


def test_a_command_that_did_not_arrive_is_not_counted() -> None:
    found = _evaluate(LatencyOptions(), [command(10.0), command(10.2)], writes(10.2), frames=0)
    assert found.commands == 1
    with pytest.raises(SlipguardError, match="no command"):
        _evaluate(LatencyOptions(), [command(10.0)], [], frames=0)


def test_no_force_step_is_added_before_an_object_is_held() -> None:
    probe = ProbingController(5)
    state, issued = probe(ControlState(), Observation(now_s=1.0), GuardParams())
    assert issued.hold_force_n is None
    assert probe.left == 5
    assert not probe.probes
    assert state.grasp.grip.target_n == 0.0
    assert STEP_N > 215.0 / 255.0, "at least one count of the register"
