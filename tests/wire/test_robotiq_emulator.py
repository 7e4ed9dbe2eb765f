"""The emulated gripper itself: its behavior, its timing, its true state."""

from __future__ import annotations

import array
import asyncio
import fcntl
import os
import termios
from collections.abc import AsyncIterator
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

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.005)):
            self.now_s += 0.005
            self.registers.tick(self.now_s)

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


def test_sensors_on_the_fingers_meet_early(bench: Bench) -> None:
    bench.jaws.fingertip_mm = 20.0
    bench.write(0x0900, 255, 0xFF40, after_s=3.0)
    assert bench.flags >> 6 == 2, "gel on gel looks like an object"
    assert bench.jaws.state_at(bench.now_s).width_mm == 40.0
    bench.write(0x0900, 0, 0xFF40, after_s=3.0)
    bench.jaws.object_mm = 10.0
    bench.write(0x0900, 255, 0xFF40, after_s=3.0)
    assert bench.jaws.state_at(bench.now_s).width_mm == 50.0


def test_activation_takes_seconds_and_moves_the_jaws_fully() -> None:
    bench = Bench()
    assert bench.flags == 0x00
    bench.write(0x0100, 0, 0)
    assert bench.flags == 0x11
    bench.wait(0.7)
    assert bench.jaws.state_at(bench.now_s).width_mm < 30.0
    bench.wait(3.0)
    assert bench.flags & 0x3F == 0x31
    assert bench.events[-1] == "activated"


def test_a_new_force_at_rest_does_nothing_and_stop_then_go_tightens(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF00, after_s=2.0)
    assert bench.flags == 0xB9
    assert bench.force_n == pytest.approx(20.0)
    bench.write(0x0900, 0xFF, 0xFFFF, after_s=2.0)
    assert bench.force_n == pytest.approx(20.0)
    bench.write(0x0100, 0xFF, 0xFFFF)
    assert bench.flags & 0x3F == 0x31
    bench.write(0x0900, 0xFF, 0xFFFF, after_s=2.0)
    assert bench.force_n == pytest.approx(235.0)
    assert "released" not in bench.events


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


def test_a_stop_and_a_go_within_one_cycle_are_no_stop(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF00, after_s=2.0)
    bench.now_s += 0.001
    bench.write(0x0100, 0xFF, 0xFFFF, after_s=0.0)
    bench.write(0x0900, 0xFF, 0xFFFF, after_s=2.0)
    assert bench.force_n == pytest.approx(20.0)


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


def test_clearing_ract_keeps_the_grip_and_activating_drops_it(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF80, after_s=2.0)
    bench.write(0, 0, 0)
    assert bench.flags == 0x00
    assert bench.force_n > 100.0
    assert "released" not in bench.events
    bench.write(0x0100, 0, 0, after_s=0.5)
    assert "released" in bench.events


def test_a_go_before_activation_is_a_fault() -> None:
    bench = Bench()
    bench.write(0x0800, 0, 0)
    assert bench.registers.read(bench.now_s)[1] >> 8 == 0x07
    bench.write(0x0900, 0, 0)
    assert bench.registers.read(bench.now_s)[1] >> 8 == 0x05


def test_silence_is_reported(bench: Bench) -> None:
    bench.registers.request_received(bench.now_s)
    bench.wait(1.5)
    assert bench.fault == 0x09


@pytest.mark.parametrize(("word", "end_mm"), [(0x1100, 0.0), (0x3100, 85.0)], ids=["rARD 0", "rARD 1"])
def test_an_automatic_release_goes_slowly_to_the_end_in_the_direction_of_rard(
    bench: Bench, word: int, end_mm: float
) -> None:
    bench.write(0x0900, 120, 0xFF00, after_s=2.0)
    before_mm = bench.width_mm
    bench.write(word, 0, 0, after_s=1.0)
    assert bench.fault == 0x0B
    assert bench.flags == 0x01, "gSTA 0, gGTO 0"
    assert abs(bench.width_mm - before_mm) == pytest.approx(20.0, abs=1.0), "at 20 mm/s"
    bench.write(0x0900, 120, 0xFF00, after_s=10.0)
    assert bench.fault == 0x0F
    assert bench.width_mm == end_mm, "rATR overrides everything but rACT"
    bench.write(0x0100, 0, 0, after_s=1.0)
    assert bench.flags & 0x30 == 0, "it must be reset first"
    bench.write(0, 0, 0)
    bench.write(0x0100, 0, 0, after_s=4.0)
    assert bench.flags & 0x3F == 0x31


def test_an_automatic_release_frees_the_object_though_the_power_was_lost(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF80, after_s=2.0)
    bench.registers.lose_power(bench.now_s)
    bench.write(0x3100, 0, 0, after_s=5.0)
    assert (bench.width_mm, bench.force_n, bench.fault) == (85.0, 0.0, 0x0F)
    assert bench.registers.activations == 1


@pytest.mark.parametrize("code", [0x0A, 0x0C])
def test_what_cannot_move_has_no_automatic_release(bench: Bench, code: int) -> None:
    bench.write(0x0900, 120, 0xFF00, after_s=2.0)
    before_mm = bench.width_mm
    bench.registers.fault = code
    bench.write(0x3100, 0, 0, after_s=2.0)
    assert (bench.width_mm, bench.fault) == (before_mm, code)


@pytest.mark.parametrize("after_power_loss", [0, 1])
def test_without_power_the_screw_holds_and_ract_must_rise_again(bench: Bench, after_power_loss: int) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF80, after_s=2.0)
    before_n = bench.force_n
    bench.registers.action_after_power_loss = after_power_loss
    bench.registers.lose_power(bench.now_s)
    bench.wait(1.0)
    assert bench.registers.stage is ActivationStage.OFF
    assert bench.force_n == before_n
    assert (bench.flags, bench.fault) == (after_power_loss, 0x05 * after_power_loss)
    bench.write(0x0100, 0, 0, after_s=1.0)
    assert ("released" in bench.events) is not bool(after_power_loss), "only an edge of rACT activates"


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


@pytest.mark.parametrize(("force", "width_mm"), [(0x80, 30.0), (0x00, 40.0)], ids=["force", "force 0"])
def test_it_closes_on_where_an_object_yields_unless_the_force_is_0(bench: Bench, force: int, width_mm: float) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF00 | force, after_s=2.0)
    bench.jaws.object_mm = 30.0
    bench.wait(1.0)
    assert bench.width_mm == width_mm
    assert bench.force_n > 0.0 or force == 0


def test_the_force_setting_does_not_limit_the_begin_of_a_motion(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF00, after_s=2.0)
    assert bench.force_n == pytest.approx(20.0), "the motion began long before the object"
    bench.write(0x0100, 0xFF, 0xFF01)
    bench.write(0x0900, 0xFF, 0xFF01, after_s=2.0)
    assert bench.force_n == pytest.approx(20.0 + RAMP_N_S * OVERRIDE_S)


def test_a_removed_object_is_noticed(bench: Bench) -> None:
    bench.jaws.object_mm = 40.0
    bench.write(0x0900, 0xFF, 0xFF80, after_s=2.0)
    bench.jaws.object_mm = None
    bench.wait(0.1)
    assert bench.force_n == 0.0
    assert "empty" in bench.events


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
