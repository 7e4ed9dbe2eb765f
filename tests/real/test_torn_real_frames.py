"""Torn frames spliced from real frames are found; no real frame is taken for torn after any other."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.campaigns.torn.command import detection_table, false_alarms
from tests.campaigns.torn.splices import real_captures, real_good_pairs, splice_results

pytestmark = pytest.mark.real


def test_no_real_frame_is_taken_for_torn(real_data: Path) -> None:
    found = false_alarms(real_good_pairs(real_data))
    assert sum(count for _, count in found.values()) > 9000
    assert [bad for bad, _ in found.values()] == [0] * len(found)


def test_tears_between_real_frames_are_found(real_data: Path) -> None:
    captures = real_captures(real_data, pairs=30, seed=1)
    found = detection_table(result for one in captures for result in splice_results(one, every=20))
    share, at_line, count = found["real, any two"][">10"]
    assert count > 100
    assert share > 0.97
    assert at_line > 0.9
