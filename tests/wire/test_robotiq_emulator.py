"""The emulated gripper itself: its behavior, its timing, its true state."""

from __future__ import annotations

import array
import asyncio
import fcntl
import os
import termios
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import serial

from slipguard.errors import CommandRefused, InputError
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import OVERRIDE_S, RAMP_N_S, SimpleJaws
from slipguard_emulators.robotiq.modbus_frames import crc16
from slipguard_emulators.robotiq.registers import FIGURES, ActivationStage, GripperRegisters

TIOCGEXCL = 0x80045440


class Bench:
    """Registers with plain jaws, and a clock that is set by hand."""

    def __init__(self) -> None:
        self.jaws = SimpleJaws()
        self.events: list[str] = []
        self.registers = GripperRegisters(
            self.jaws, FIGURES["2F-85"], lambda event, **details: self.events.append(event)
        )
        self.now_s = 100.0
        self.widths_mm: list[float] = []

    def wait(self, seconds: float) -> None:
        ends_s = self.now_s + seconds
        while self.now_s < ends_s - 1e-9:
            self.now_s = min(self.now_s + 0.005, ends_s)
            self.widths_mm.append(self.registers.tick(self.now_s).width_mm)

    def write(self, *words: int, after_s: float = 0.05) -> None:
        self.registers.write(self.now_s, 0x03E8, words)
        self.wait(after_s)

    @property
    def flags(self) -> int:
        return self.registers.read(self.now_s)[0] >> 8

    @property
    def fault(self) -> int:
        return self.registers.read(self.now_s)[1] >> 8

    @property
    def position(self) -> int:
        return self.registers.read(self.now_s)[2] >> 8

    @property
    def width_mm(self) -> float:
        return self.jaws.state_at(self.now_s).width_mm

    @property
    def force_n(self) -> float:
        return self.jaws.state_at(self.now_s).force_n


@pytest.fixture
def bench() -> Bench:
    bench = Bench()
    bench.write(0x0100, 0, 0, after_s=4.0)
    return bench


GRIP, FIRM, GO_FIRM, STOP_FIRM = (
    (0x0900, 0xFF, 0xFF00),
    (0x0900, 0xFF, 0xFF80),
    (0x0900, 0xFF, 0xFFFF),
    (0x0100, 0xFF, 0xFFFF),
)
OPEN, ACTIVE, RESET, GO_IN_RESET = (0x0900, 0x00, 0xFF00), (0x0100, 0, 0), (0, 0, 0), (0x0800, 0, 0)
HALF, FREE, ROUND_OFF = (0x0900, 120, 0xFF00), (0x3100, 0, 0), (0x1100, 0, 0)
POWER_LOSS = "power"


@dataclass(frozen=True)
class Step:
    """What is done, how long that is waited for, and what is seen then; None is not compared."""

    do: tuple[int, ...] | str | float | None
    """Registers written, a loss of power, the width of the object that is there from now on (0: none), or nothing."""
    wait_s: float
    flags: int | None = None
    fault: int | None = None
    force_n: float | None = None
    width_mm: float | None = None
    """0: it was reached at some time."""


SESSIONS: dict[str, list[Step]] = {
    "an activation takes seconds and moves the jaws fully": [
        Step(RESET, 0.1, flags=0x00),
        Step(ACTIVE, 0.05, flags=0x11),
        Step(None, 0.7, width_mm=0.0),
        Step(None, 3.0, flags=0x31, width_mm=85.0),
    ],
    "a new force at rest does nothing; stop, then go tightens": [
        Step(40.0, 0.0),
        Step(GRIP, 2.0, flags=0x39 | 0x80, force_n=20.0),
        Step(GO_FIRM, 2.0, force_n=20.0),
        Step(STOP_FIRM, 0.05, flags=0x31),
        Step(GO_FIRM, 2.0, force_n=235.0, width_mm=40.0),
    ],
    "a stop and a go within one cycle are no stop": [
        Step(40.0, 0.0), Step(GRIP, 2.001), Step(STOP_FIRM, 0.0), Step(GO_FIRM, 2.0, force_n=20.0),
    ],
    "a reset keeps the grip, an activation drops it": [
        Step(40.0, 0.0), Step(FIRM, 2.0), Step(RESET, 0.05, flags=0x00, width_mm=40.0), Step(ACTIVE, 0.5, force_n=0.0),
    ],
    "a go in reset or before the activation is a fault": [
        Step(RESET, 0.05), Step(GO_IN_RESET, 0.05, fault=0x07), Step((0x0900, 0, 0), 0.05, fault=0x05),
    ],
    "an automatic release opens slowly, overrides a go, and ends in a state that needs an activation": [
        Step(HALF, 2.0),
        Step(FREE, 0.3, flags=0x01, fault=0x0B),
        Step(HALF, 10.0, fault=0x0F, width_mm=85.0),
        Step(ACTIVE, 1.0, flags=0x01),
        Step(RESET, 0.05),
        Step(ACTIVE, 4.0, flags=0x31),
    ],
    "an automatic release without rARD closes": [Step(HALF, 2.0), Step(ROUND_OFF, 10.0, fault=0x0F, width_mm=0.0)],
    "an automatic release frees the object though the power was lost": [
        Step(40.0, 0.0), Step(FIRM, 2.0), Step(POWER_LOSS, 0.5, flags=0x01, fault=0x05, width_mm=40.0),
        Step(FREE, 5.0, fault=0x0F, force_n=0.0, width_mm=85.0),
    ],
    "without power the screw holds, and a set rACT activates nothing": [
        Step(40.0, 0.0), Step(GO_FIRM, 2.0), Step(POWER_LOSS, 1.0, force_n=235.0), Step(ACTIVE, 1.0, force_n=235.0),
    ],
    "it closes on where an object yields": [
        Step(40.0, 0.0), Step(FIRM, 2.0), Step(30.0, 1.0, width_mm=30.0),
    ],
    "but not with force 0": [Step(40.0, 0.0), Step(GRIP, 2.0), Step(30.0, 1.0, width_mm=40.0, force_n=0.0)],
    "a removed object is noticed": [Step(40.0, 0.0), Step(FIRM, 2.0), Step(0.0, 0.1, force_n=0.0)],
    "the force setting does not limit the begin of a motion": [
        Step(40.0, 0.0), Step(GRIP, 2.0, force_n=20.0), Step((0x0100, 0xFF, 0xFF01), 0.05),
        Step((0x0900, 0xFF, 0xFF01), 2.0, force_n=20.0 + RAMP_N_S * OVERRIDE_S),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", SESSIONS)
def test_a_session_with_the_registers(bench: Bench, name: str) -> None:
    bench.widths_mm.clear()
    for number, step in enumerate(SESSIONS[name]):
        if isinstance(step.do, tuple):
            bench.registers.write(bench.now_s, 0x03E8, step.do)
        elif step.do == POWER_LOSS:
            bench.registers.lose_power(bench.now_s)
        elif isinstance(step.do, float):
            bench.jaws.object_mm = step.do or None
        bench.wait(step.wait_s)
        lowest_mm = min(bench.widths_mm) if step.width_mm == 0.0 else bench.width_mm
        seen = {"flags": bench.flags, "fault": bench.fault, "force_n": bench.force_n, "width_mm": lowest_mm}
        if not step.flags or not step.flags & 0x08:
            seen["flags"] = bench.flags & 0x3F  # gOBJ means nothing while gGTO is 0
        for key, value in seen.items():
            if (expected := getattr(step, key)) is not None:
                assert value == pytest.approx(expected, abs=1e-6), f"{key} after step {number + 1}"


@pytest.mark.parametrize("code", [0x0A, 0x0C])
def test_what_cannot_move_has_no_automatic_release(bench: Bench, code: int) -> None:
    bench.write(*HALF, after_s=2.0)
    before_mm = bench.width_mm
    bench.registers.fault = code
    bench.write(*FREE, after_s=2.0)
    assert (bench.width_mm, bench.fault) == (before_mm, code)


def test_a_unit_that_starts_reset_is_activated_by_the_next_rise_of_ract(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(*FIRM, after_s=2.0)
    bench.registers.action_after_power_loss = 0
    bench.registers.lose_power(bench.now_s)
    bench.write(*ACTIVE, after_s=1.0)
    assert "released" in bench.events


def test_an_activation_presses_the_gels_on_each_other_with_full_force() -> None:
    bench = Bench()
    bench.jaws.fingertip_mm = 20.0
    bench.write(0x0100, 0, 0, after_s=0.0)
    most_n = 0.0
    for _ in range(100):
        bench.wait(0.05)
        most_n = max(most_n, bench.force_n)
    assert most_n == 235.0
    assert bench.registers.stage is ActivationStage.READY
    assert bench.jaws.state_at(bench.now_s).width_mm == 85.0


@pytest.mark.parametrize("lag_s", [0.0, 0.016, 0.19])
def test_gobj_keeps_its_former_value_for_a_while_after_a_go(bench: Bench, lag_s: float) -> None:
    bench.write(0x0900, 0, 0xFF00, after_s=0.5)
    assert bench.flags >> 6 == 3
    bench.registers.draw_lag_s = lambda: lag_s
    bench.write(0x0900, 0xFF, 0xFF00, after_s=0.0)
    seen = []
    for _ in range(100):
        bench.wait(0.005)
        seen.append(bench.flags >> 6)
    assert bench.registers.read(bench.now_s)[1] & 0xFF == 0xFF
    assert seen.count(3) == pytest.approx(lag_s / 0.005, abs=1)
    assert set(seen[seen.count(3) :]) == {0}


def test_the_lag_differs_from_go_to_go_and_repeats_with_the_seed(bench: Bench) -> None:
    lags_s = [bench.registers.draw_lag_s() for _ in range(100)]
    assert min(lags_s) < 0.02
    assert 0.18 < max(lags_s) <= 0.2
    again, once_more = Bench().registers, Bench().registers
    assert [again.draw_lag_s() for _ in range(5)] == [once_more.draw_lag_s() for _ in range(5)]


def test_gobj_means_nothing_while_rgto_is_0(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    seen = set()
    for _ in range(40):
        bench.write(0x0900, 0xFF, 0xFF00, after_s=1.0)
        assert bench.flags == 0xB9
        bench.write(0x0100, 0xFF, 0xFF00)
        seen.add(bench.flags >> 6)
    assert seen == {0, 1, 2, 3}


def test_force_never_falls_until_the_jaws_open(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF80, after_s=2.0)
    before_n = bench.force_n
    bench.write(0x0100, 0xFF, 0xFF00)
    bench.write(0x0900, 0xFF, 0xFF00, after_s=2.0)
    assert 100.0 < before_n <= bench.force_n <= before_n + RAMP_N_S * OVERRIDE_S + 1e-9
    bench.write(0x0900, 0x00, 0xFF00, after_s=2.0)
    assert bench.force_n == 0.0
    assert "released" in bench.events


def test_silence_is_reported(bench: Bench) -> None:
    bench.registers.request_received(bench.now_s)
    bench.wait(1.5)
    assert bench.fault == 0x09


def test_the_position_has_no_reference_without_power_and_another_calibration_with_each_activation() -> None:
    bench, opened, closed = Bench(), set(), set()
    for _ in range(12):
        bench.registers.lose_power(bench.now_s)
        unreferenced = bench.position
        bench.write(0, 0, 0)
        bench.write(0x0100, 0, 0, after_s=4.0)
        opened.add(bench.position)
        bench.write(0x0900, 0xFF, 0xFF00, after_s=1.0)
        closed.add(bench.position)
        assert abs(bench.position - unreferenced) > 0
        bench.write(0x0900, 0, 0xFF00, after_s=1.0)
    assert len(opened) > 3
    assert min(opened) >= 3
    assert max(opened) <= 13
    assert len(closed) > 3
    assert min(closed) >= 225
    assert max(closed) <= 235


@pytest.fixture
async def emulator(tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    emulator = RobotiqEmulator(RobotiqEmulator.Settings(link=tmp_path / "tty", activated=True, latency_timer_ms=16.0))
    await emulator.start()
    yield emulator
    await emulator.stop()


def framed(text: str) -> bytes:
    raw = bytes.fromhex(text)
    return raw + crc16(raw)


async def exchange(emulator: RobotiqEmulator, request: bytes, size: int) -> tuple[bytes, float]:
    """What comes back within half a second, and after how long."""

    def talk() -> bytes:
        with serial.Serial(emulator.address, 115200, timeout=0.5) as port:
            port.write(request)
            return bytes(port.read(size))

    loop = asyncio.get_running_loop()
    began_s = loop.time()
    return await loop.run_in_executor(None, talk), loop.time() - began_s


async def test_an_answer_takes_the_time_of_the_wire(emulator: RobotiqEmulator) -> None:
    answer, took_s = await exchange(emulator, framed("09 04 07D0 0003"), 11)
    assert len(answer) == 11
    assert took_s >= (8 + 11) * 10 / 115200 + 0.001 + 0.016


async def test_the_log_has_the_time_of_a_commands_last_byte(emulator: RobotiqEmulator) -> None:
    began_s = asyncio.get_running_loop().time()
    answer, _ = await exchange(emulator, framed("09 10 03E8 0003 06 0900 00FF FFFF"), 8)
    assert answer == framed("09 10 03E8 0003")
    (event,) = emulator.events("write")
    last_byte_s = event["last_byte_s"]
    assert isinstance(last_byte_s, float)
    assert last_byte_s >= began_s + 15 * 10 / 115200
    assert event["registers"] == ["0900", "00FF", "FFFF"]


@pytest.mark.parametrize("request_", ["07 04 07D0 0003", "09 04 07D0 0009", "09 2B 0E01", "09 04 07D0"])
async def test_unknown_requests_are_not_answered(emulator: RobotiqEmulator, request_: str) -> None:
    assert await exchange(emulator, framed(request_), 1) == (b"", pytest.approx(0.5, abs=0.5))
    await asyncio.sleep(0.03)
    assert len((await exchange(emulator, framed("09 04 07D0 0003"), 11))[0]) == 11


async def test_the_port_returns_under_its_name(emulator: RobotiqEmulator) -> None:
    def there() -> bool:
        return Path(emulator.address).is_symlink()

    assert there()
    emulator.control("fault unplug")
    assert not there()
    emulator.control("clear unplug")
    assert (await exchange(emulator, framed("09 04 07D0 0003"), 11))[0]
    await emulator.stop()
    await emulator.stop()
    assert not there()


async def test_exclusive_use_ends_with_the_client(
    emulator: RobotiqEmulator,
) -> None:
    port = os.open(emulator.address, os.O_RDWR | os.O_NOCTTY)
    fcntl.ioctl(port, termios.TIOCEXCL)
    await asyncio.sleep(0.1)
    os.close(port)
    await asyncio.sleep(0.1)
    port = os.open(emulator.address, os.O_RDWR | os.O_NOCTTY)
    claimed = array.array("i", [1])
    fcntl.ioctl(port, TIOCGEXCL, claimed)
    os.close(port)
    assert claimed[0] == 0
    await asyncio.sleep(0.1)


async def test_object_and_fault_are_set_by_commands(emulator: RobotiqEmulator) -> None:
    assert isinstance(emulator.jaws, SimpleJaws)
    emulator.control("object 40")
    assert emulator.jaws.object_mm == 40.0
    emulator.control("object none")
    assert emulator.jaws.object_mm is None
    emulator.control("gflt 0x0E")
    assert emulator.registers.fault == 0x0E
    for words in ("object", "object 900", "object wide", "gflt", "gflt 99", "gflt x"):
        with pytest.raises(CommandRefused):
            emulator.control(words)


async def test_a_name_in_use_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    emulator = RobotiqEmulator(RobotiqEmulator.Settings(link=tmp_path / "file"))
    with pytest.raises(InputError, match="is not a link"):
        await emulator.start()
    nowhere = RobotiqEmulator(RobotiqEmulator.Settings(link=tmp_path / "no" / "tty"))
    with pytest.raises(InputError, match="cannot be created"):
        await nowhere.start()
    assert (tmp_path / "file").read_text() == "mine"
