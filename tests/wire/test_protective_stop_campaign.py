"""A protective stop at random moments of a lift: the object is held, and lowered under control afterwards.

The whole of it: `pytest tests/wire/test_protective_stop_campaign.py --stops 10 -s`, with `--seed` 0 to 4; each takes
three minutes.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from cell_rig import cell
from protective_stop_campaign import report, stopped_lifts
from ur_scene import own_address

OPTIONS = ("--object", "wrench", "--seed", 0, "--fps", 30, "--height-mm", 80)


@pytest.mark.campaign
def test_the_object_is_held_and_lowered_under_control(
    request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    count, lifts = request.config.getoption("--stops"), []
    with cell(tmp_path, own_address(68), *OPTIONS) as there:
        for lift in stopped_lifts(there, count, request.config.getoption("--seed")):
            lifts.append(lift)
            with capsys.disabled():
                print(f"\n{len(lifts)}: {lift}", flush=True)
        assert len(there.events("released")) == count, "the jaws opened without a request"
    with capsys.disabled():
        print(f"\n{report(lifts)}")
    assert len(lifts) == count
