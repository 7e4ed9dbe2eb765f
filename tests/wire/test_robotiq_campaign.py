"""The gripper under every fault of the line at once.

The whole of it: `python -m pytest tests/wire/test_robotiq_campaign.py --commands 10000 --seed 0` takes some minutes.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from robotiq_campaign import Truth, agree, campaign

from slipguard.devices import GripperState
from slipguard_emulators.robotiq.emulator import FAULTS, URCAP_FAULTS
from slipguard_emulators.robotiq.jaws import JawsState

HANG_S = {"usb": 0.5, "forwarder": 1.0, "urcap": 1.0}
"""Of the driver's own time: what the machine kept the whole process from running is taken off, and printed."""


@pytest.mark.campaign
@pytest.mark.parametrize("wiring", HANG_S)
async def test_no_state_is_wrong_no_grip_opens_and_nothing_hangs(
    request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture[str], wiring: str
) -> None:
    commands = request.config.getoption("--commands")
    outcome = await campaign(tmp_path, commands, request.config.getoption("--seed"), wiring)
    with capsys.disabled():
        print(
            f"\n{wiring}: {outcome.commands} commands, {outcome.states} states, {outcome.failed} failed, "
            f"{outcome.refused} refused, {outcome.restarts_holding} restarts while holding, "
            f"longest call {outcome.longest_s:.3f} s (stalled {outcome.stalled_s:.1f} s in all); "
            f"faults: {dict(sorted(outcome.occurred.items()))}"
        )
    assert outcome.wrong == []
    assert outcome.opened == []
    assert outcome.loosened == []
    assert outcome.longest_s <= HANG_S[wiring]
    assert outcome.commands >= commands
    assert outcome.states > commands / 10
    assert outcome.restarts_holding > 0
    assert set(outcome.occurred) == set(URCAP_FAULTS if wiring == "urcap" else FAULTS) or commands < 1000


def test_a_wrong_state_is_noticed() -> None:
    state = GripperState(True, False, True, False, 41.0, 40.0, None, 0.0)
    held = JawsState(41.2, 40.2, False, met_closing=True)
    assert agree(state, Truth(0.0, True, True, held, 41.2))
    for view in (JawsState(45.0, 40.2), JawsState(41.2, 40.2, moving=True), JawsState(41.2), JawsState(41.2, 30.0)):
        assert not agree(state, Truth(0.0, True, True, view, view.width_mm))
    assert not agree(state, Truth(0.0, False, True, held, 41.2))
