"""`kill -9` at random moments of a lift: the object is still held, and the next daemon guards it soon.

The whole of it: `pytest tests/wire/test_kill_campaign.py --kills 100 --seed 0 -s` takes half an hour.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from cell_rig import cell
from kill_campaign import campaign, report
from ur_scene import own_address

GUARDING_S = 2.0
PATIENT_S = 10.0
SHORT = 20
"""Fewer kills than this are the short version, on a machine that runs other tests as well: it may take `PATIENT_S`."""
OPTIONS = ("--object", "wrench", "--seed", 0, "--fps", 30, "--height-mm", 80)


@pytest.mark.campaign
def test_the_object_is_still_held_and_soon_guarded_again(
    request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count = request.config.getoption("--kills")
    kills = []
    with cell(tmp_path, own_address(64), *OPTIONS) as there:
        for kill in campaign(there, count, request.config.getoption("--seed")):
            kills.append(kill)
            with capsys.disabled():
                print(f"\n{len(kills)}: {kill}", flush=True)
    with capsys.disabled():
        print(f"\n{report(kills, tmp_path)}")
    assert len(kills) == count
    allowed_s = GUARDING_S if count >= SHORT else PATIENT_S
    assert [kill for kill in kills if kill.guarding_s > allowed_s] == []
    assert [kill for kill in kills if not kill.rotation_kept] == []
