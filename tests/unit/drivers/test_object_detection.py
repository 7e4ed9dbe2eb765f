"""The meaning of successive statuses of a 2F: gOBJ lags, and has no meaning while gGTO is 0."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slipguard_drivers.robotiq.object_detection import OBJECT_LAG_S, STANDS_S, ObjectDetection
from slipguard_drivers.robotiq.registers import MODEL_2F85, FingerMotion, RobotiqModel, RobotiqStatus

MOVING, OPENED_ON, ON_OBJECT, ARRIVED = FingerMotion
OPEN, OBJECT, CLOSED = 3, 120, 230


class Jaws:
    """An object detection and its clock."""

    def __init__(self, model: RobotiqModel = MODEL_2F85) -> None:
        self.detection = ObjectDetection(model)
        self.now_s = 100.0

    def see(
        self, motion: FingerMotion, echo: int, position: int, *, going: bool = True, ready: bool = True,
        after_s: float = 0.005,
    ) -> tuple[bool, bool, bool]:  # fmt: skip
        """Whether the fingers move, hold, and have closed on nothing, after one more status."""
        self.now_s += after_s
        self.detection.update(RobotiqStatus(True, going, ready, motion, 0, echo, position), self.now_s)
        return self.detection.moving, self.detection.holding, self.detection.closed_on_nothing

    def rested(self, motion: FingerMotion, echo: int, position: int) -> Jaws:
        """At rest for a while."""
        self.see(motion, echo, position)
        self.see(motion, echo, position, after_s=OBJECT_LAG_S)
        return self


UNDECIDED, HELD, EMPTY, NOTHING = (
    (True, False, False),
    (False, True, False),
    (False, False, False),
    (False, False, True),
)
TIGHTENING = (True, True, False)


def test_open_jaws_that_are_to_close_have_not_closed_on_nothing() -> None:
    jaws = Jaws().rested(ARRIVED, 0, OPEN)
    assert jaws.see(ARRIVED, 255, OPEN) == UNDECIDED, "gOBJ is still that of the opening"
    assert jaws.see(ARRIVED, 255, OPEN) == UNDECIDED
    assert jaws.see(MOVING, 255, OPEN + 9) == UNDECIDED
    assert jaws.see(ON_OBJECT, 255, OBJECT) == HELD


def test_after_the_longest_lag_it_counts_without_motion() -> None:
    jaws = Jaws().rested(ON_OBJECT, 255, OBJECT)
    assert jaws.see(ON_OBJECT, 255, OBJECT, going=False) == HELD
    assert jaws.see(ON_OBJECT, 255, OBJECT) == TIGHTENING
    assert jaws.see(ON_OBJECT, 255, OBJECT, after_s=OBJECT_LAG_S - 0.01) == TIGHTENING
    assert jaws.see(ON_OBJECT, 255, OBJECT, after_s=0.011) == HELD


def test_a_motion_from_before_the_command_does_not_count() -> None:
    jaws = Jaws()
    jaws.see(MOVING, 0, OBJECT)
    assert jaws.see(MOVING, 255, OBJECT - 5) == UNDECIDED
    assert jaws.see(ARRIVED, 255, OBJECT - 5) == UNDECIDED, "the end of the opening, late"
    assert jaws.see(MOVING, 255, OBJECT) == UNDECIDED
    assert jaws.see(ARRIVED, 255, CLOSED, after_s=OBJECT_LAG_S) == NOTHING


@pytest.mark.parametrize(("position", "expected"), [(CLOSED, NOTHING), (CLOSED - 4, NOTHING), (CLOSED - 9, UNDECIDED)])
def test_closed_on_nothing_only_near_the_closed_position(position: int, expected: object) -> None:
    jaws = Jaws().rested(ARRIVED, 0, OPEN)
    jaws.see(MOVING, 255, OBJECT)
    assert jaws.see(ARRIVED, 255, position) == expected


@pytest.mark.parametrize("motion", FingerMotion)
def test_without_ggto_the_position_alone_counts(motion: FingerMotion) -> None:
    assert Jaws().see(motion, 255, OBJECT, going=False) == HELD, "halted on the way: it may have met something"
    assert Jaws().see(motion, 255, CLOSED, going=False) == NOTHING
    assert Jaws().see(motion, OBJECT, OPEN, going=False) == HELD
    assert Jaws().see(motion, 0, OPEN, going=False) == EMPTY
    assert Jaws().see(motion, 0, OBJECT, going=False) == EMPTY, "halted while opening"


@pytest.mark.parametrize("motion", FingerMotion)
def test_an_object_that_is_as_thin_as_paper_stays_held_while_it_is_tightened(motion: FingerMotion) -> None:
    jaws = Jaws().rested(ON_OBJECT, 255, CLOSED - 1)
    assert jaws.see(motion, 255, CLOSED - 1, going=False) == HELD
    assert jaws.see(ON_OBJECT, 255, CLOSED - 1) == TIGHTENING


@pytest.mark.parametrize(
    ("beyond", "expected"), [(1, NOTHING), (-1, NOTHING), (-5, HELD)], ids=["closer", "near", "2 mm and more"]
)
def test_gels_that_meet_are_recognized_by_their_width(beyond: int, expected: object) -> None:
    """A thickness that is configured a little too small must not make gel on gel a held object."""
    model = replace(MODEL_2F85, fingertip_mm=15.0)
    goal = model.goal_count
    jaws = Jaws(model).rested(ARRIVED, 0, OPEN)
    jaws.see(MOVING, 255, OPEN + 9)
    assert jaws.see(ON_OBJECT, 255, goal + beyond) == expected
    assert Jaws(model).rested(ARRIVED, goal, goal).see(ARRIVED, goal, goal) == NOTHING


def test_a_soft_object_that_yields_until_the_gels_almost_meet_stays_held() -> None:
    model = replace(MODEL_2F85, fingertip_mm=15.0)
    goal = model.goal_count
    jaws = Jaws(model).rested(ON_OBJECT, goal, goal - 8)
    for position in range(goal - 8, goal):
        assert jaws.see(ON_OBJECT, goal, position, after_s=OBJECT_LAG_S) == HELD


def test_what_is_held_at_the_start_is_held_at_once() -> None:
    jaws = Jaws()
    assert jaws.see(ON_OBJECT, 255, OBJECT) == TIGHTENING
    assert jaws.detection.gripped_at == OBJECT
    assert jaws.see(ON_OBJECT, 255, OBJECT, after_s=OBJECT_LAG_S) == HELD


def test_a_release_just_before_the_start_is_no_grip() -> None:
    jaws = Jaws()
    assert jaws.see(ON_OBJECT, 0, OBJECT) == UNDECIDED
    assert jaws.see(ON_OBJECT, 0, OBJECT, after_s=OBJECT_LAG_S) == EMPTY


def test_a_released_object_is_not_held_though_the_former_value_says_so() -> None:
    jaws = Jaws().rested(ON_OBJECT, 255, OBJECT)
    assert jaws.see(ON_OBJECT, 0, OBJECT) == UNDECIDED
    assert jaws.see(MOVING, 0, OBJECT - 40) == UNDECIDED
    assert jaws.see(ARRIVED, 0, OPEN) == EMPTY


def test_an_object_lost_while_it_is_tightened_is_not_held() -> None:
    jaws = Jaws().rested(ON_OBJECT, 255, OBJECT)
    jaws.see(MOVING, 255, OBJECT, going=False)
    assert jaws.see(MOVING, 255, OBJECT + 2) == TIGHTENING
    assert jaws.see(MOVING, 255, OBJECT + 9) == UNDECIDED
    assert jaws.see(ARRIVED, 255, CLOSED) == NOTHING


def test_jaws_that_stand_apart_without_an_object_do_not_move_forever() -> None:
    """gOBJ 3 with a goal of closing: either they still close where an object was lost, or they stand."""
    jaws = Jaws().rested(ON_OBJECT, 255, OBJECT)
    for position in range(OBJECT + 2, CLOSED - 9, 9):
        assert jaws.see(ARRIVED, 255, position, after_s=STANDS_S - 0.01) == UNDECIDED
    assert jaws.see(ARRIVED, 255, position, after_s=STANDS_S - 0.01) == UNDECIDED
    assert jaws.see(ARRIVED, 255, position, after_s=0.02) == EMPTY
    assert jaws.see(ARRIVED, 255, position, going=False) == HELD, "halted there: it may hold something"
    assert jaws.see(ARRIVED, 255, position) == UNDECIDED, "a new command"


def test_opening_against_an_object_holds_nothing() -> None:
    assert Jaws().rested(OPENED_ON, 0, OBJECT).see(OPENED_ON, 0, OBJECT) == EMPTY


def test_a_gripper_that_is_not_activated_holds_nothing_that_is_known() -> None:
    jaws = Jaws().rested(ON_OBJECT, 255, OBJECT)
    assert jaws.see(ON_OBJECT, 255, OBJECT, ready=False) == EMPTY
    assert jaws.detection.gripped_at is None
