"""The campaign with torn frames, in its short form."""

from __future__ import annotations

from itertools import islice

import pytest

from tests.campaigns.torn.angle_errors import angle_errors
from tests.campaigns.torn.closed_loop import torn_lift
from tests.campaigns.torn.command import detection_by_line, detection_table, false_alarms, violations
from tests.campaigns.torn.splices import SpliceResult, rendered_captures, rendered_good_pairs, splice_results


def test_results_are_counted_by_the_difference_at_the_line() -> None:
    results = [
        SpliceResult("a", "row", 0.0, 0.5, False, False),
        SpliceResult("a", "row", 0.13, 5.0, True, False),
        SpliceResult("a", "column", 0.99, 99, True, True),
    ]
    by_line = detection_by_line(results)["a"]
    assert (by_line["row"][:2], by_line["column"][-1]) == ([[0.0, 0], [1.0, 1]], [1.0, 1])
    assert detection_table(results) == {"a": {"0-1": [0.0, 0.0, 1], "4-6": [1.0, 0.0, 1], ">10": [1.0, 1.0, 1]}}


def test_each_exceeded_limit_is_reported() -> None:
    held = {
        "object_name": "bar",
        "kind": "firm",
        "seed": 0,
        "share": 0.0,
        "outcome": "held",
        "tightenings": 1,
        "causeless": 0,
    }
    torn = held | {"share": 0.4}
    found: dict[str, object] = {
        "detection": {"a": {">10": [0.5, 0.5, 100]}},
        "false_alarms": {"b": [1, 100]},
        "angle_errors": {"false": 0, "undetected_max_deg": 9.0},
        "lifts": [held, torn, torn | {"causeless": 1}, torn | {"tightenings": 2}],
    }
    expected = ["b", "a, >10", "angle errors", "lift", "lift"]
    assert [line.split(":")[0] for line in violations(found)] == expected


def test_a_drop_is_a_failure_even_if_the_same_lift_fails_without_tears() -> None:
    dropped = {
        "object_name": "bar",
        "kind": "slides",
        "seed": 0,
        "outcome": "dropped",
        "tightenings": 0,
        "causeless": 0,
    }
    found = {
        "detection": {},
        "false_alarms": {},
        "angle_errors": {"false": 0, "undetected_max_deg": 0.0},
        "lifts": [dropped | {"share": 0.0}, dropped | {"share": 0.4}],
    }
    assert len(violations(found)) == 2


def test_rendered_tears_are_found_and_good_frames_are_not_taken_for_torn() -> None:
    captures = [one for one in islice(rendered_captures(1), 12) if one.kind == "rendered, textured, 1500°/s"]
    table = detection_table(result for one in captures for result in splice_results(one, every=16))
    assert table["rendered, textured, 1500°/s"][">10"][0] > 0.9
    assert {bad for bad, _ in false_alarms(islice(rendered_good_pairs(1), 30)).values()} == {0}


@pytest.mark.campaign
def test_undetected_tears_cost_less_than_a_degree() -> None:
    errors = angle_errors(("wrench", "bar", "hook"), 0.25)
    assert errors.false == 0
    assert errors.refused > 0
    assert max(errors.undetected_deg) < 1.5


@pytest.mark.campaign
@pytest.mark.parametrize("kind", ["firm", "rotates", "slides"])
def test_a_lift_with_torn_frames_ends_as_without(kind: str) -> None:
    alone, torn = torn_lift("wrench", kind, 0.0), torn_lift("wrench", kind, 0.4)
    assert (torn.outcome, alone.outcome) == ("held", "held")
    assert torn.causeless == alone.causeless == 0
    assert torn.tightenings <= alone.tightenings
    assert torn.rotation_deg == pytest.approx(alone.rotation_deg, abs=2.0)
