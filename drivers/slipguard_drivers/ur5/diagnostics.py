"""Checks of `slipguard doctor` on a UR controller: its ports, questions to the dashboard, received RTDE data.

Nothing is taken over: no input registers, no script, no commands. A running program is not disturbed.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import AsyncIterator, Iterator
from typing import Literal

from slipguard.devices import ArmState
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import DeviceError
from slipguard.host_lookup import resolve_host
from slipguard.mounting import TILT_MAX_DEG, mounting_name, tilt_deg
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.mounting import flange_rotation, rotation_matrix
from slipguard_drivers.ur5.preconditions import SCRIPT_PORT
from slipguard_drivers.ur5.rtde import RATE_HZ, RtdeConnection, check_port
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import ROBOT_MODES, RUNNING, RobotState, StateMonitor

MEASURE_S = 1.0
RATE_SHARE_MIN = 0.9
URCAPS = {
    63352: ("Robotiq's gripper URCap", "use the gripper in no program of the panel while slipguard guards"),
    54321: ("the RS-485 forwarder URCap", "no other program may use the tool's RS-485"),
}
"""URCaps that use the gripper's line, by the port they listen on, and what to do about each. The driver `robotiq` uses
either."""
URCAP_CONFLICT = "both claim the tool's RS-485 (Universal Robots' ROS driver, tool communication): uninstall one"
URCAP_TIMEOUT_S = 0.3
PAYLOAD_MIN_KG = 0.5
"""Every supported gripper weighs more: a 2F-85 0.9 kg (Robotiq's manual), without sensors."""
POWER_UP = "power the robot on and release its brakes at the panel"


async def check_controller(
    name: str, settings: Ur5Settings, mode: Literal["lift", "guard"], *, owned: bool
) -> AsyncIterator[CheckResult]:
    """Make all checks; end early if nothing answers. owned: in lift mode, slipguard's own program runs."""
    dashboard, monitor = DashboardClient(name, settings.host), StateMonitor(name, settings.host)
    loop = asyncio.get_running_loop()
    try:
        try:
            await monitor.open()
        except DeviceError as error:
            yield problem_from_error("controller", error, name, "check the robot's power, network cable and address")
            return
        yield ok("controller", f"{settings.host}, software {'.'.join(map(str, monitor.version))}")
        begun_s, packets = loop.time(), monitor.packets
        async for result in check_dashboard(name, dashboard, settings, mode, owned=owned):
            yield result
        await asyncio.sleep(max(0.0, begun_s + MEASURE_S - loop.time()))
        rate_hz = (monitor.packets - packets) / (loop.time() - begun_s)
        try:
            state = monitor.fresh()
        except DeviceError as error:
            yield problem_from_error("RTDE rate", error, name, "check the network cable")
            return
        yield check_rate(rate_hz)
        for result in check_state(state):
            yield result
        yield check_mounting(monitor.arm_state(), mode)
        yield check_tcp(state)
        yield await check_payload(name, settings.host)
        if mode == "lift":
            yield await check_script_port(name, settings.host)
        for result in await check_urcaps(settings.host):
            yield result
    finally:
        dashboard.close()
        await monitor.close()


async def check_dashboard(
    name: str, dashboard: DashboardClient, settings: Ur5Settings, mode: Literal["lift", "guard"], *, owned: bool
) -> AsyncIterator[CheckResult]:
    """Ask for serial number, remote control and the running program; sends no commands."""
    try:
        serial = await dashboard.ask("get serial number")
        if serial.isalnum():
            yield ok("serial number", serial)
        remote = await dashboard.in_remote_control()
        program = await dashboard.ask("programState")
    except DeviceError as error:
        yield problem_from_error("dashboard", error, name, "enable the dashboard in the robot's security settings")
        return
    needs_remote = mode == "lift" or settings.stop_by == "dashboard_pause"
    if remote or not needs_remote:
        yield ok("control", "remote" if remote else "local, which is enough for a stop by digital output")
    else:
        refused = "scripts" if mode == "lift" else "a pause"
        yield problem("control", f"local: the robot refuses {refused}", "switch it to remote control at the panel")
    running = program.upper().startswith(("PLAYING", "PAUSED"))
    if mode == "lift" and running and not owned:
        yield problem(
            "program",
            f"{program}: mode 'lift' would end it, so slipguard does not take the arm",
            'stop that program, or set [guard] mode = "guard" if it is to move the arm',
        )
    else:
        yield ok("program", program)


def check_rate(rate_hz: float) -> CheckResult:
    """Compare the measured rate of the states with the requested rate."""
    observed = f"{rate_hz:.0f} states per second, {RATE_HZ:.0f} requested"
    if rate_hz < RATE_SHARE_MIN * RATE_HZ:
        return problem("RTDE rate", observed, "use a cable instead of Wi-Fi, directly or through one switch")
    return ok("RTDE rate", observed)


def check_state(state: RobotState) -> Iterator[CheckResult]:
    """Check whether the robot is on, and whether a stop is active."""
    mode = ROBOT_MODES.get(state.mode, f"mode {state.mode}")
    if state.emergency:
        yield problem("stops", "emergency stop or safety fault", f"release the button, then {POWER_UP}")
    elif state.protective:
        yield problem("stops", "protective or safeguard stop", "find the cause, then unlock it at the panel")
    else:
        yield ok("stops", "none active")
    if state.mode != RUNNING and not state.emergency:
        yield problem("robot", mode, POWER_UP)
    else:
        yield ok("robot", f"{mode}, {'moving' if state.moving else 'at rest'}")


def check_mounting(arm: ArmState, mode: Literal["lift", "guard"]) -> CheckResult:
    """Compare the accelerometer in the tool with the z axis of the base, along which slipguard lifts."""
    if arm.up is None:
        observed = "the arm moves" if arm.moving else "the accelerometer in the tool does not measure gravity"
        return note("mounting", f"not checked: {observed}", "check by eye that the arm is mounted upright")
    tilt = tilt_deg(arm.up)
    observed = f"{mounting_name(tilt)}: up is {tilt:.0f}° from the z axis of the base"
    if tilt > TILT_MAX_DEG and mode == "lift":
        return problem("mounting", observed, 'mount it upright, or set [guard] mode = "guard": slipguard lifts along z')
    return ok("mounting", observed)


def check_tcp(state: RobotState) -> CheckResult:
    """Compare the z axis of the TCP, which slipguard takes for the fingers' direction, with that of the flange."""
    share = float(rotation_matrix(state.pose[3:])[:, 2] @ flange_rotation(state.joints)[:, 2])
    angle_deg = math.degrees(math.acos(min(1.0, max(-1.0, share))))
    observed = f"its z axis is {angle_deg:.0f}° from that of the flange"
    if angle_deg > TILT_MAX_DEG:
        return note("TCP", observed, "set its orientation at the panel so that z points along the fingers")
    return ok("TCP", observed)


async def check_payload(name: str, host: str) -> CheckResult:
    """Check that a payload is set; older software does not report it."""
    try:
        connection = await RtdeConnection.connect(name, host)
        try:
            await connection.request_outputs([("payload", "DOUBLE")])
            await connection.start()
            async with asyncio.timeout(MEASURE_S):
                (payload_kg,) = struct.unpack(">d", await connection.receive())
        finally:
            connection.close()
    except (DeviceError, TimeoutError, struct.error):
        return ok("payload", "not reported by this software")
    observed = f"{payload_kg:.2f} kg"
    if payload_kg < PAYLOAD_MIN_KG:
        action = "enter mass and center of gravity of gripper and sensors at the panel, or the arm may stop by itself"
        return note("payload", observed, action)
    return ok("payload", observed)


async def check_script_port(name: str, host: str) -> CheckResult:
    """Check the port that accepts scripts; nothing is sent."""
    try:
        await check_port(name, host, SCRIPT_PORT, "script port")
    except DeviceError as error:
        return problem_from_error("script port", error, name, "enable it in the robot's security settings")
    return ok("script port", f"{host}:{SCRIPT_PORT} is open")


async def check_urcaps(host: str) -> list[CheckResult]:
    """Find URCaps that would interfere, by the ports they listen on."""
    found = await asyncio.gather(*(_listens(host, port) for port in URCAPS))
    notes = [
        note("URCap", f"{text} runs on the controller (port {port})", action)
        for (port, (text, action)), listens in zip(URCAPS.items(), found, strict=True)
        if listens
    ]
    if len(notes) == len(URCAPS):
        notes.append(note("URCap", "Robotiq's URCap and the RS-485 forwarder are both on", URCAP_CONFLICT))
    return notes or [ok("URCap", "none that is known to interfere")]


async def _listens(host: str, port: int) -> bool:
    try:
        async with asyncio.timeout(URCAP_TIMEOUT_S):
            _, writer = await asyncio.open_connection(await resolve_host(host), port)
    except (OSError, TimeoutError):
        return False
    writer.transport.abort()
    return True
