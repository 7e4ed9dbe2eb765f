"""The 2F's register map against the manual's own frames, and its conversions."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard.errors import CommandRefused, DeviceError
from slipguard_drivers.robotiq.registers import (
    AUTO_RELEASE,
    CLOSED_COUNT,
    GEL_GAP_MM,
    INPUT_ADDRESS,
    MODEL_2F85,
    MODEL_2F140,
    MODEL_HAND_E,
    OUTPUT_ADDRESS,
    FingerMotion,
    RobotiqCommand,
    count_to_force,
    count_to_width,
    decode,
    encode,
    force_to_count,
    nothing_between,
    width_to_count,
)

OPEN_FULLY = bytes.fromhex("09 10 03E8 0003 06 0900 0000 FFFF 7219")
READ_STATUS = bytes.fromhex("09 04 07D0 0003 B1CE")
GRASPED_AT_189 = bytes.fromhex("09 04 06 B900 00FF BD00 5C9A")


def words(payload: bytes) -> list[int]:
    return list(struct.unpack(f">{len(payload) // 2}H", payload))


def test_the_manuals_open_command() -> None:
    address, count = struct.unpack(">HH", OPEN_FULLY[2:6])
    assert (address, count) == (OUTPUT_ADDRESS, 3)
    assert encode(RobotiqCommand(activate=True, go=True, position=0, speed=255, force=255)) == words(OPEN_FULLY[7:13])


def test_activation_clears_everything_but_ract() -> None:
    assert encode(RobotiqCommand(activate=True, go=False, position=0, speed=0, force=0)) == [0x0100, 0, 0]


def test_an_automatic_release_opens_and_needs_ract() -> None:
    """Bits 0 (rACT), 4 (rATR) and 5 (rARD: 1 opens) of the action request, in one write."""
    assert encode(AUTO_RELEASE) == [0x3100, 0, 0]


def test_the_manuals_status_of_a_grasp() -> None:
    assert struct.unpack(">H", READ_STATUS[2:4]) == (INPUT_ADDRESS,)
    status = decode(words(GRASPED_AT_189[3:9]))
    assert status.activated
    assert status.ready
    assert status.going
    assert status.motion is FingerMotion.STOPPED_CLOSING
    assert status.stopped_on_object
    assert status.fault is None
    assert (status.position_echo, status.position) == (255, 189)


@pytest.mark.parametrize(
    ("flags", "echo", "position", "stopped"),
    [
        (0xB9, 255, 189, True),
        (0xB1, 255, 189, False),  # gGTO is 0: gOBJ means nothing
        (0xB9, 0, 189, False),  # gOBJ is from before this opening
        (0x39, 255, 120, False),  # still closing
        (0xF9, 255, 230, False),
        (0x91, 255, 189, False),  # not activated
    ],
)
def test_when_gobj_says_that_an_object_is_held(flags: int, echo: int, position: int, stopped: bool) -> None:
    assert decode([flags << 8, echo, position << 8]).stopped_on_object is stopped


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (0x00, None),
        (0x05, None),  # passes: it moves as soon as it is activated
        (0x07, None),  # passes: not activated, which is reported anyway
        (0x08, "too hot"),
        (0x09, None),  # passes: the line was silent for a second
        (0x0A, "voltage"),
        (0x0B, None),  # belongs to an automatic release, as 0x0F
        (0x0C, "internal fault"),
        (0x0D, "activation fault"),
        (0x0E, "overcurrent"),
        (0x0F, None),
        (0x06, "0x06"),
    ],
)
def test_faults_are_texts(code: int, expected: str | None) -> None:
    fault = decode([0xB900, code << 8 | 255, 0xBD00]).fault
    assert fault is None if expected is None else expected in (fault or "")


@pytest.mark.parametrize(
    ("flags", "code", "activating", "releasing", "auto_released"),
    [
        (0x11, 0x00, True, False, False),
        (0x01, 0x05, False, False, False),  # after a loss of power
        (0x00, 0x00, False, False, False),
        (0x01, 0x0B, False, True, False),
        (0x01, 0x0F, False, False, True),
    ],
)
def test_what_a_gripper_does_that_is_not_active(
    flags: int, code: int, activating: bool, releasing: bool, auto_released: bool
) -> None:
    status = decode([flags << 8, code << 8, 0x7B00])
    assert not status.ready
    assert (status.activating, status.releasing, status.auto_released) == (activating, releasing, auto_released)


@pytest.mark.parametrize("registers", [[], [0xB900, 255], [0xB900, 255, 0x10000], [0xB900, -1, 0]])
def test_an_invalid_status_is_refused(registers: list[int]) -> None:
    with pytest.raises(DeviceError):
        decode(registers)


@pytest.mark.parametrize("name", ["position", "speed", "force"])
@pytest.mark.parametrize("count", [-1, 256])
def test_counts_are_bytes(name: str, count: int) -> None:
    with pytest.raises(ValueError, match=name):
        encode(RobotiqCommand(activate=True, go=True, **{"position": 0, "speed": 0, "force": 0, name: count}))


def test_the_force_range_of_each_model() -> None:
    assert [count_to_force(count, MODEL_2F85) for count in (0, 255)] == [20.0, 235.0]
    assert [count_to_force(count, MODEL_2F140) for count in (0, 255)] == [10.0, 125.0]
    assert [count_to_force(count, MODEL_HAND_E) for count in (0, 255)] == [20.0, 185.0]
    assert count_to_force(1, MODEL_2F85) - 20.0 == pytest.approx(0.843, abs=1e-3)


@given(st.floats(min_value=0.0, allow_infinity=False))
def test_the_force_is_never_less_than_requested_within_the_limits(force_n: float) -> None:
    count = force_to_count(force_n, MODEL_2F85)
    applied_n = count_to_force(count, MODEL_2F85)
    if 20.0 <= force_n <= 235.0:
        assert force_n - 1e-6 <= applied_n < force_n + 0.844
    else:
        assert applied_n == (20.0 if force_n < 20.0 else 235.0)


@given(st.integers(0, 255))
def test_a_force_count_is_its_own_force(count: int) -> None:
    assert force_to_count(count_to_force(count, MODEL_2F85), MODEL_2F85) == count


@given(st.floats(0.0, 85.0))
def test_a_width_comes_back_within_half_a_count(width_mm: float) -> None:
    count = width_to_count(width_mm, MODEL_2F85)
    assert 3 <= count <= 230
    assert count_to_width(count, MODEL_2F85) == pytest.approx(width_mm, abs=85.0 / 227 / 2 + 1e-9)


@given(st.floats(0.0, 50.0))
def test_a_width_of_a_hand_e_comes_back_within_half_a_count(width_mm: float) -> None:
    count = width_to_count(width_mm, MODEL_HAND_E)
    half_mm = 50.0 / 255 / 2 + 1e-9
    expected = pytest.approx(max(width_mm, 50.0 / 255), abs=half_mm)
    assert count_to_width(count, MODEL_HAND_E) == expected, "a move never aims at the goal of closing"


def test_the_ends_of_the_stroke() -> None:
    assert width_to_count(50.0, MODEL_HAND_E) == 0
    assert count_to_width(255, MODEL_HAND_E) == 0.0
    assert width_to_count(85.0, MODEL_2F85) == 3
    assert width_to_count(0.0, MODEL_2F85) == 230
    assert count_to_width(0, MODEL_2F85) == 85.0
    assert count_to_width(CLOSED_COUNT, MODEL_2F85) == 0.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0])
def test_an_invalid_number_is_refused(value: float) -> None:
    with pytest.raises(CommandRefused):
        force_to_count(value, MODEL_2F85)
    with pytest.raises(CommandRefused):
        width_to_count(value, MODEL_2F85)


def test_a_width_beyond_the_stroke_is_fully_open() -> None:
    assert width_to_count(100.0, MODEL_2F85) == 3


@pytest.mark.parametrize("fingertip_mm", [0.2, 5.0, 17.3, 40.0])
def test_widths_between_the_gels_and_the_limit_that_keeps_them_apart(fingertip_mm: float) -> None:
    model = replace(MODEL_2F85, fingertip_mm=fingertip_mm)
    assert count_to_width(3, model) == pytest.approx(85.0 - 2 * fingertip_mm)
    assert width_to_count(1000.0, model) == 3
    assert GEL_GAP_MM <= count_to_width(model.goal_count, model) < GEL_GAP_MM + model.mm_per_count
    assert width_to_count(0.0, model) == model.goal_count - 1, "a move never aims at the goal of closing"
    count = width_to_count(3.0, model)
    assert count_to_width(count, model) == pytest.approx(3.0, abs=0.2)
    assert width_to_count(100.0, MODEL_2F140) > 3
    with pytest.raises(CommandRefused, match="0 to 140"):
        width_to_count(-0.1, MODEL_2F140)


def test_fingers_are_closed_within_two_millimeters() -> None:
    assert [nothing_between(count_to_width(count, MODEL_2F85)) for count in (255, 230, 225, 224, 3)] == [
        True, True, True, False, False,
    ]  # fmt: skip
