"""Trials with a high needed force, which one step does not reach, and with a fragile object."""

from __future__ import annotations

import pytest

from slipguard.bench.grip.trial_run import HIGH_MM, LIFT_MM, lift_mm, run_trial, trial_params
from slipguard.bench.grip.trials import (
    FRAGILE_MAX_N,
    LATENCIES_S,
    SHARES,
    TIGHT_SHARES,
    Block,
    draw,
    needed_range_n,
    trials,
)
from slipguard.control.force_limits import force_range
from slipguard.control.params import GuardParams, GuardTuning
from slipguard.sim.friction import needed_force_n

TIGHT: tuple[Block, ...] = ("high need", "fragile")


@pytest.mark.parametrize("block", TIGHT)
@pytest.mark.parametrize("number", range(8))
def test_the_needed_force_is_close_to_the_force_limit(block: Block, number: int) -> None:
    one = draw(number, "bar", SHARES[number % 4], LATENCIES_S[number // 2], number % 2 == 0, 60.0, block=block)
    within = force_range(one.force_max_n, (20.0, 235.0))
    assert within is not None
    share = one.needed_n / (within.high_n * one.scenario.gripper.gain)
    assert TIGHT_SHARES[0] - 0.03 < share <= TIGHT_SHARES[1]
    assert needed_force_n(one.item, one.scenario.gel) == pytest.approx(one.needed_n, rel=1e-6)
    assert one.first_n >= 20.0
    assert one.first_n * one.scenario.gripper.gain == pytest.approx(one.share * one.needed_n)
    assert (lift_mm(one), LIFT_MM) == (HIGH_MM, 60.0)


def test_blocks_have_the_same_axes_and_different_numbers() -> None:
    blocks = {block: trials(24, 0, 0, block) for block in ("matrix", *TIGHT)}
    numbers = [one.number for some in blocks.values() for one in some]
    assert len(set(numbers)) == len(numbers)
    for block, some in blocks.items():
        assert {one.block for one in some} == {block}
        assert [[one.share for one in some].count(share) for share in SHARES] == [6] * 4
    assert needed_range_n("matrix", 0.9) == needed_range_n("matrix", 1.1) == (45.0, pytest.approx(78.0))


def test_the_parameters_of_a_trial_are_valid_settings() -> None:
    fragile = trial_params(GuardParams(), trials(1, 0, 0, "fragile")[0])
    assert fragile.force_max_n == fragile.no_estimate_force_n == FRAGILE_MAX_N
    plain = trial_params(GuardParams(), trials(1, 0)[0])
    assert plain == GuardParams(tuning=GuardTuning(probe_height_mm=0.0))


def test_a_fragile_object_is_held_within_its_force_limit() -> None:
    one = draw(7_000, "wrench", 0.75, 0.1, False, 60.0, block="fragile")
    for name in ("slipguard", "fixed step", "oracle"):
        outcome = run_trial(one, name)
        assert outcome.dropped is None
        assert outcome.up
        assert outcome.force_n <= (FRAGILE_MAX_N + 0.85) * one.scenario.gripper.gain
        assert outcome.tightenings > 0
