"""The gripper on the robot: behind the RS-485 forwarder, and behind Robotiq's URCap."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest
from pydantic import ValidationError
from robotiq_rig import OBJECT_MM, put, until, until_it_rests
from ur_scene import own_address

from slipguard.config import read_config
from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_emulators.cell.emulator import CellEmulator
from slipguard_emulators.robotiq.emulator import URCAP_FAULTS, RobotiqEmulator
from slipguard_emulators.robotiq.urcap import UrcapPort

through_the_robot = pytest.mark.parametrize("wiring", ["forwarder", "urcap"])


def driver(emulator: RobotiqEmulator, **keys: object) -> RobotiqGripper:
    settings = {"approach_speed": 1.0, **emulator.driver_settings, **keys}
    return RobotiqGripper(RobotiqGripper.Settings.model_validate(settings), DriverContext("gripper"))


@asynccontextmanager
async def emulated(wiring: str, **options: object) -> AsyncIterator[RobotiqEmulator]:
    quick = {"tcp_port": 0, "baud": 0, "response_ms": 0.0, "relay_ms": 0.5, "jitter_ms": 0.5, "quick": 5.0}
    settings = {**quick, "activated": True, "wiring": wiring, **options}
    emulator = RobotiqEmulator(RobotiqEmulator.Settings.model_validate(settings))
    await emulator.start()
    try:
        yield emulator
    finally:
        await emulator.stop()


@asynccontextmanager
async def holding(wiring: str, **options: object) -> AsyncIterator[tuple[RobotiqEmulator, RobotiqGripper]]:
    """An emulated gripper that holds an object with 40 N, and its driver."""
    async with emulated(wiring, **options) as emulator:
        gripper = driver(emulator, timeout_ms=150.0)
        await gripper.open()
        put(emulator, OBJECT_MM)
        await gripper.hold(40.0)
        await until_it_rests(gripper)
        emulator.log.clear()
        yield emulator, gripper
        await gripper.close()


async def read_on(gripper: RobotiqGripper) -> None:
    """Read for half a second; time-outs are read again."""
    for _ in range(50):
        with suppress(DeviceTimeout):
            await gripper.state()
        await asyncio.sleep(0.01)


def pressed_n(emulator: RobotiqEmulator) -> float:
    return emulator.registers.tick(asyncio.get_running_loop().time()).force_n


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({}, "neither port nor urcap is set"),
        ({"port": "/dev/ttyUSB0", "urcap": "192.0.2.1:63352"}, "port and urcap are both set"),
        ({"port": "socket://192.0.2.1"}, "is not HOST:PORT"),
        ({"port": "socket://192.0.2.1:port"}, "[Pp]ort"),
        ({"urcap": "192.0.2.1"}, "is not HOST:PORT"),
        ({"urcap": "192.0.2.1:99999"}, "[Pp]ort"),
        ({"urcap": "http://192.0.2.1:63352"}, "is not HOST:PORT|[Pp]ort"),
    ],
)
def test_settings_that_name_no_connection_are_refused(keys: dict[str, str], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        RobotiqGripper.Settings.model_validate(keys)


@through_the_robot
async def test_nothing_listens_there(wiring: str) -> None:
    async with emulated(wiring) as emulator:
        gripper = driver(emulator)
    with pytest.raises(DeviceLost, match=r"does not accept connections .*URCap"):
        await gripper.open()
    await gripper.close()


@pytest.mark.parametrize(("wiring", "relay_ms"), [("usb", 25.0), ("forwarder", 12.0), ("urcap", 25.0)])
async def test_the_time_out_follows_the_measured_round_trip(wiring: str, relay_ms: float) -> None:
    slow = {"response_ms": 25.0} if wiring == "usb" else {"relay_ms": relay_ms, "jitter_ms": 10.0}
    async with emulated(wiring, **slow) as emulator:
        gripper = driver(emulator)
        assert gripper.force_latency_s is None
        await gripper.open()
        latency_s = gripper.force_latency_s
        assert latency_s is not None
        assert latency_s >= 2 * 0.025
        for _ in range(100 if wiring != "urcap" else 15):
            await gripper.state()  # none is lost
        await gripper.close()


async def test_the_forwarder_serves_one_client_and_the_next_when_that_leaves() -> None:
    async with holding("forwarder") as (emulator, first):
        second = driver(emulator)
        with pytest.raises(DeviceTimeout, match="no other program"):
            await second.open()
        await first.close()
        await second.open()
        state = await second.state()
        assert state.holding
        assert not state.force_known
        await second.close()


@through_the_robot
async def test_a_restart_of_the_robot_loses_no_grip(wiring: str) -> None:
    async with holding(wiring) as (emulator, gripper):
        emulator.control("fault unplug")
        with pytest.raises(DeviceLost):
            await read_on(gripper)
        with pytest.raises(DeviceLost):
            await gripper.open()
        emulator.control("clear unplug")
        await gripper.open()
        state = await gripper.state()
        assert state.holding
        assert not state.force_known
        assert await gripper.hold(60.0) >= 60.0
        await until_it_rests(gripper)
        assert pressed_n(emulator) == pytest.approx(60.5, abs=0.5)
        assert emulator.events("released") == []


@pytest.mark.parametrize(("wiring", "advice"), [("forwarder", "Tool I/O"), ("urcap", "24 V")])
async def test_a_gripper_without_power_is_reported_and_can_be_released_afterwards(wiring: str, advice: str) -> None:
    async with holding(wiring) as (emulator, gripper):
        emulator.control("fault power")
        await asyncio.sleep(0.05)
        with pytest.raises(DeviceTimeout, match=advice):
            await gripper.state()
        emulator.control("clear power")
        await until(lambda: asyncio.get_running_loop().time() > emulator._down_until_s)
        await asyncio.sleep(0.05)
        assert not (await gripper.state()).active
        assert emulator.events("released") == []
        await gripper.release(60.0)
        await until(lambda: pressed_n(emulator) == 0.0)
        assert emulator.registers.activations == 0


@pytest.mark.parametrize("fault", [name for name in URCAP_FAULTS if name not in ("ignore", "unplug", "power")])
async def test_a_status_after_any_fault_of_the_urcap_is_the_present_one(fault: str) -> None:
    async with holding("urcap", late_ms=180.0, outage_ms=200.0) as (emulator, gripper):
        for _ in range(3):
            emulator.control(f"fault {fault} 1")
            for _ in range(4):
                try:
                    state = await gripper.state()
                except DeviceTimeout:
                    continue
                assert state.holding
                assert state.width_mm == pytest.approx(OBJECT_MM, abs=1.0), "a torn or foreign number"
        await asyncio.sleep(0.3)
        emulator.control("panel SET POS 0 FOR 0 GTO 1")
        await until(lambda: pressed_n(emulator) == 0.0)
        await asyncio.sleep(0.3)
        assert (await gripper.state()).width_mm > 80.0, "a late value is taken for the present one"


async def test_a_command_that_the_urcap_ignores_is_reported() -> None:
    async with holding("urcap") as (emulator, gripper):
        emulator.control("fault ignore")
        with pytest.raises(DeviceTimeout, match="another program"):
            await gripper.hold(80.0)
        emulator.control("clear")
        await gripper.hold(80.0)
        await until_it_rests(gripper)
        assert pressed_n(emulator) == pytest.approx(80.5, abs=0.5)


@pytest.mark.parametrize("refresh_ms", [4.0, 16.0, 50.0])
async def test_tightening_acts_however_slowly_the_urcap_refreshes(refresh_ms: float) -> None:
    async with holding("urcap", refresh_ms=refresh_ms) as (emulator, gripper):
        for force_n in (60.0, 80.0, 100.0):
            await gripper.hold(force_n)
            await until_it_rests(gripper)
            assert pressed_n(emulator) == pytest.approx(force_n, abs=1.0)


@pytest.mark.parametrize("name", ["ARD", "ADR", "neither"])
async def test_an_automatic_release_starts_only_if_its_direction_is_certain(name: str) -> None:
    async with holding("urcap") as (emulator, gripper):
        port = emulator._port
        assert isinstance(port, UrcapPort)
        emulator.registers.lose_power(asyncio.get_running_loop().time())
        port.unplug()
        port.direction = name
        port.plug()
        with pytest.raises(DeviceLost):
            await gripper.state()
        await gripper.open()
        emulator.log.clear()
        if name == "neither":
            with pytest.raises(CommandRefused, match="might close"):
                await gripper.release(60.0)
            assert emulator.events("drive") == []
        else:
            await gripper.release(60.0)
            assert [event["width_mm"] for event in emulator.events("drive")] == [85.0]


async def test_a_program_of_the_panel_that_opens_is_seen_and_one_that_interferes_is_named() -> None:
    async with holding("urcap") as (emulator, gripper):

        async def panel() -> None:
            while True:
                emulator.control("panel SET POS 200 GTO 1")
                await asyncio.sleep(0.002)

        interfering = asyncio.create_task(panel())
        with pytest.raises(DeviceError, match="another program"):
            await gripper.hold(60.0)
        interfering.cancel()
        emulator.control("panel SET POS 0 GTO 1")
        await until(lambda: pressed_n(emulator) == 0.0)
        await until_it_rests(gripper)
        assert not (await gripper.state()).holding


@pytest.mark.parametrize(("slave_id", "found"), [(9, True), (2, False)])
async def test_the_urcap_selects_the_gripper_by_its_address(slave_id: int, found: bool) -> None:
    async with emulated("urcap") as emulator:
        gripper = driver(emulator, slave_id=slave_id)
        if found:
            await gripper.open()
        else:
            with pytest.raises(DeviceLost, match="knows no gripper 2"):
                await gripper.open()
        await gripper.close()


@pytest.mark.parametrize(
    ("requests", "response"),
    [
        ([b"GET POS\n"], b"POS 3"),
        ([b"GE", b"T STA", b"\n"], b"STA 3"),
        ([b"SET POS 100 SPE 255 FOR 0 GTO 1\n"], b"ack"),
        ([b"SET FOR 300\nGET FOR\n"], b"ackFOR 255"),
        ([b"SET SID 9\nGET ACT\n"], b"ackACT 1"),
        ([b"SET SID 4\nGET ACT\n"], b"ACT 1"),
        ([b"GET XYZ\nSET POS\nSET POS x\n\n\xff\nGET OBJ\n"], b"OBJ 0"),
    ],
)
async def test_the_emulated_urcap_follows_its_grammar(requests: list[bytes], response: bytes) -> None:
    async with emulated("urcap") as emulator:
        host, port = emulator.address.split(":")
        streams = [await asyncio.open_connection(host, int(port)) for _ in range(2)]  # several clients at once
        await asyncio.sleep(0.03)
        for reader, writer in streams:
            for request in requests:
                writer.write(request)
                await asyncio.sleep(0.005)
            assert await reader.readexactly(len(response)) == response
            writer.close()


@pytest.mark.parametrize("wiring", ["usb", "forwarder", "urcap"])
async def test_the_configuration_of_an_emulated_cell_names_its_gripper(wiring: str) -> None:
    with tempfile.TemporaryDirectory(prefix="sg") as folder:
        options = {"folder": folder, "gripper": wiring, "host": own_address(92), "object": "none", "activated": True}
        cell = CellEmulator(CellEmulator.Settings.model_validate(options))
        await cell.start()
        config = await asyncio.to_thread(read_config, cell.places.config)
        gripper = RobotiqGripper(config.gripper.settings, DriverContext("gripper"))  # type: ignore[arg-type]
        await gripper.open()
        await gripper.move(30.0, 40.0)
        now_s = asyncio.get_running_loop().time
        await until(lambda: cell.world.gripper_state(now_s()).width_mm == pytest.approx(30.0, abs=2.0))
        await gripper.close()
        await cell.stop()
