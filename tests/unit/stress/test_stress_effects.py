"""The family that sweeps the effects of real contacts reports where estimates break."""

from __future__ import annotations

from typing import Any

from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.stress.effect_families import LEVELS
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.report import as_json, summary
from slipguard.stress.runner import StressOutcome, run, select_families


class CertainPipeline:
    """Reports a rotation that no scene has."""

    def __init__(self, *_: Any) -> None:
        pass

    def process(self, frame: Frame) -> Estimate:
        at_s = frame.captured_at_s
        return Estimate(frame.sequence, at_s, at_s, True, 900, "model", rotation_deg=500.0, sigma_deg=0.1)


def stressed(pipeline: Any, trials: int) -> StressOutcome:
    ticks = iter(range(1000))
    product = ProductFunctions(pipeline=pipeline)
    return run(select_families(["effects"]), 1, float(trials), product, clock=lambda: float(next(ticks)))


def test_an_estimate_that_is_certain_and_wrong_breaks_at_the_smallest_size() -> None:
    outcome = stressed(CertainPipeline, 3)
    broken = as_json(outcome)["families"]["effects"]["broken_at"]
    assert broken
    assert broken == {effect: LEVELS[effect][0] for effect in broken}
    assert summary(outcome)["broken_at"] == broken
    assert as_json(outcome)["families"]["effects"]["worst_sigmas"]["rocking"] > 1_000.0


def test_declined_estimates_break_nowhere() -> None:
    class Declining(CertainPipeline):
        def process(self, frame: Frame) -> Estimate:
            at_s = frame.captured_at_s
            return Estimate(frame.sequence, at_s, at_s, True, 900, "model", declined="too uncertain")

    outcome = stressed(Declining, 2)
    found = as_json(outcome)["families"]["effects"]
    assert found["broken_at"] == {}
    assert found["declined"] > 0
