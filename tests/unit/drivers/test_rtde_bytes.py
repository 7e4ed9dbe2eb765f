"""RTDE's handshake, byte by byte: what the driver sends and what the emulator answers, compared with the protocol."""

from __future__ import annotations

import asyncio
import math
import os
import struct
from collections.abc import AsyncIterator, Callable

import pytest

from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.ur5.digital_output import DigitalOutput
from slipguard_drivers.ur5.rtde import RtdeConnection
from slipguard_drivers.ur5.state_monitor import LAYOUT, VARIABLES, StateMonitor
from slipguard_emulators.ur5.controller import EmulatedController
from slipguard_emulators.ur5.rtde import message
from slipguard_emulators.ur5.rtde_session import RtdeSession
from slipguard_emulators.ur5.tool import StraightTool

HOST = f"127.{20 + os.getpid() // 256 % 200}.{os.getpid() % 256}.33"
"""Of this run of the tests alone: the ports cannot be chosen."""
NAMES = (
    b"timestamp,actual_TCP_pose,actual_TCP_speed,actual_q,actual_tool_accelerometer,"
    b"runtime_state,safety_status_bits,robot_mode"
)
TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR3D,UINT32,UINT32,INT32"
# Big endian: size (with itself), type, payload.
VERSION = (b"\x00\x05V\x00\x02", b"\x00\x04V\x01")
CONTROLLER = (b"\x00\x03v", b"\x00\x13v" + bytes.fromhex("00000005 00000011 00000003 00000000"))
RECIPE = (
    b"\x00\x84O" + bytes.fromhex("405f400000000000") + NAMES,  # 125.0
    b"\x00\x42O\x01" + TYPES,
)
START = (b"\x00\x03S", b"\x00\x04S\x01")
POSE, SPEED = (-0.3, -0.2, 0.3, 0.0, 3.14, 0.0), (0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
JOINTS, UP_IN_TOOL = (0.0, -math.pi / 2, 0.0, -math.pi / 2, 0.0, 0.0), (0.0, -9.82, 0.0)
DATA = b"\x00\xc0U\x01" + struct.pack(">22d2Ii", 12.5, *POSE, *SPEED, *JOINTS, *UP_IN_TOOL, 2, 1, 7)
AT_REST = b"\x00\xc0U\x01" + struct.pack(">22d2Ii", 12.5, *POSE, *[0.0] * 6, *JOINTS, *UP_IN_TOOL, 2, 1, 7)


def answered(kind: str, payload: bytes, session: RtdeSession) -> bytes:
    answer = session.answer(kind, payload, 0.0)
    assert answer is not None
    return message(kind, answer)


def session(version: tuple[int, ...] = (5, 17, 3, 0)) -> RtdeSession:
    return RtdeSession(EmulatedController(StraightTool(), lambda event, **details: None), version, 500.0)


def test_the_emulator_answers_as_the_protocol_says() -> None:
    emulated = session()
    for request, answer in (VERSION, CONTROLLER, RECIPE, START):
        assert answered(chr(request[2]), request[3:], emulated) == answer
    assert len(LAYOUT.pack(*[0] * 25)) == len(DATA) - 4
    assert [cycle for cycle in range(8) if emulated.due(cycle)] == [0, 4], "125 of 500 cycles a second"


def test_the_emulator_knows_a_wrong_name_and_does_not_start_without_outputs() -> None:
    emulated = session()
    assert answered("O", struct.pack(">d", 125.0) + b"timestamp,no_such_thing", emulated)[3:] == b"\x00DOUBLE,NOT_FOUND"
    assert answered("S", b"", emulated) == b"\x00\x04S\x00"


def test_an_input_belongs_to_its_first_client_until_it_disconnects() -> None:
    controller = EmulatedController(StraightTool(), lambda event, **details: None)
    first, second = (RtdeSession(controller, (5, 17, 3, 0), 500.0) for _ in range(2))
    names = b"standard_digital_output_mask,input_int_register_0"
    assert answered("I", names, first) == b"\x00\x0fI\x01UINT8,INT32"
    assert answered("I", b"input_double_register_3", first)[3] == 2, "a second recipe of the same client"
    assert answered("I", names, second)[3:] == b"\x00IN_USE,IN_USE"
    controller.release(first)
    assert answered("I", names, second)[3:] == b"\x01UINT8,INT32"


Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], object]


@pytest.fixture
async def served() -> AsyncIterator[tuple[list[bytes], dict[bytes, bytes]]]:
    """A server that notes each message and answers it from a table; without an answer it stays silent."""
    received: list[bytes] = []
    answers = dict((VERSION, CONTROLLER, RECIPE, (START[0], START[1] + DATA)))

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                head = await reader.readexactly(2)
                request = head + await reader.readexactly(struct.unpack(">H", head)[0] - 2)
                received.append(request)
                writer.write(answers.get(request, b""))
        except (asyncio.IncompleteReadError, OSError):
            writer.close()

    server = await asyncio.start_server(serve, HOST, 30004)
    yield received, answers
    server.close()
    await asyncio.sleep(0.02)  # the server's side of the connections ends


async def test_the_driver_asks_as_the_protocol_says(served: tuple[list[bytes], dict[bytes, bytes]]) -> None:
    received, _ = served
    monitor = StateMonitor("arm", HOST)
    await monitor.open()
    assert received == [VERSION[0], CONTROLLER[0], RECIPE[0], START[0]]
    assert monitor.version == (5, 17, 3, 0)
    state = monitor.newest
    assert (state.timestamp_s, state.pose, state.velocity) == (12.5, POSE, SPEED)
    assert monitor.arm_state().orientation_rad == POSE[3:]
    assert (state.runtime, state.safety_bits, state.mode) == (2, 1, 7)
    assert state.moving
    assert (state.joints, state.acceleration) == (JOINTS, UP_IN_TOOL)
    assert monitor.arm_state().up is None, "in motion, the accelerometer reads the motion, too"
    await monitor.close()


async def test_up_is_measured_at_rest(served: tuple[list[bytes], dict[bytes, bytes]]) -> None:
    """With all links upright, the flange's y axis points down (known from the robot's own display of that pose)."""
    served[1][START[0]] = START[1] + AT_REST
    monitor = StateMonitor("arm", HOST)
    await monitor.open()
    assert monitor.arm_state().up == pytest.approx((0.0, 0.0, 1.0), abs=1e-9)
    await monitor.close()


async def test_inputs_are_taken_and_sent_by_their_recipe(served: tuple[list[bytes], dict[bytes, bytes]]) -> None:
    received, answers = served
    answers[b"\x00\x1cIstandard_digital_output,x"[:2] + b"Istandard_digital_output,x"] = b"\x00\x0fI\x05UINT8,UINT8"
    connection = await RtdeConnection.connect("arm", HOST)
    recipe = await connection.claim_inputs(["standard_digital_output", "x"])
    connection.send(recipe, b"\x08\x08")
    await asyncio.sleep(0.02)
    assert received[-1] == b"\x00\x06U\x05\x08\x08"
    connection.close()


@pytest.mark.parametrize(
    ("request_", "answer", "error", "words"),
    [
        (VERSION[0], b"\x00\x04V\x00", DeviceLost, "PolyScope 3.5"),
        (CONTROLLER[0], b"\x00\x05v\x00\x00", DeviceLost, "check the robot.s address"),
        (CONTROLLER[0], b"HTTP/1.1 400 Bad Request\r\n", DeviceLost, "does not send RTDE"),
        (RECIPE[0], b"\x00\x43O\x00" + TYPES.replace(b"INT32", b"NOT_FOUND", 1), DeviceLost, "does not offer runtime"),
        (START[0], b"\x00\x04S\x00", DeviceLost, "does not start"),
        (START[0], START[1] + b"\x00\x05U\x01\x00", DeviceLost, "bytes of RTDE data"),
        (START[0], START[1] + DATA[:4] + b"\x7f\xf8" + DATA[6:], DeviceLost, "a number that is not finite"),
    ],
)
async def test_an_invalid_response_is_reported_in_one_line(
    served: tuple[list[bytes], dict[bytes, bytes]],
    request_: bytes,
    answer: bytes,
    error: type[Exception],
    words: str,
) -> None:
    served[1][request_] = answer
    monitor = StateMonitor("arm", HOST)
    with pytest.raises(error, match=words) as caught:
        await monitor.open()
    assert "\n" not in str(caught.value)
    with pytest.raises(DeviceLost, match="not open"):
        _ = monitor.newest


async def test_an_input_in_use_names_possible_holders(served: tuple[list[bytes], dict[bytes, bytes]]) -> None:
    served[1][b"\x00\x17Iinput_int_register_0"] = b"\x00\x0aI\x00IN_USE"
    connection = await RtdeConnection.connect("arm", HOST)
    with pytest.raises(CommandRefused, match=r"holds input_int_register_0 .* ROS driver"):
        await connection.claim_inputs(["input_int_register_0"])
    connection.close()


async def test_outputs_of_another_size_are_reported_in_one_line(served: tuple[list[bytes], dict[bytes, bytes]]) -> None:
    received, answers = served
    names = b"standard_digital_output_mask,standard_digital_output"
    recipe = bytes.fromhex("405f400000000000") + b"actual_digital_output_bits"
    answers[struct.pack(">H", 3 + len(recipe)) + b"O" + recipe] = b"\x00\x0aO\x01UINT64"
    answers[struct.pack(">H", 3 + len(names)) + b"I" + names] = b"\x00\x0fI\x01UINT8,UINT8"
    with pytest.raises(DeviceLost, match="188 bytes of digital outputs instead of 8"):
        await DigitalOutput("arm", HOST, 3, 0.1).pulse()
    assert all(request[2:3] != b"U" for request in received), "nothing is set where it is not known how it stands"


def test_the_recipe_is_what_the_layout_holds() -> None:
    sizes = {"DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "UINT32": "I", "INT32": "i"}
    assert struct.calcsize(">" + "".join(sizes[kind] for _, kind in VARIABLES)) == LAYOUT.size
    assert ",".join(name for name, _ in VARIABLES).encode() == NAMES
