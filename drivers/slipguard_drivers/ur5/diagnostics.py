"""What `slipguard doctor` looks at about a UR controller: its ports, questions to the dashboard, RTDE received.

Nothing is taken over: no input registers, no script, no orders. A program that runs goes on undisturbed.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from typing import Literal

from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import DeviceError
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.rtde import check_port
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import MODES, RATE_HZ, RUNNING, RobotState, StateMonitor

LOOK_S = 1.0
RATE_SHARE = 0.9
SCRIPT_PORT = 30003
URCAPS = {
    63352: ("Robotiq's gripper URCap", "two programs must not command one gripper: let none of the robot's do it"),
    54321: (
        "an RS-485 URCap (tool communication)",
        "the gripper must hang on this computer, not on the robot's tool",
    ),
}
"""What listens at these ports of the controller, and what it would disturb."""
URCAP_S = 0.3
POWER_UP = "power the robot on and release its brakes at the panel"


async def check_controller(
    name: str, settings: Ur5Settings, mode: Literal["lift", "guard"], *, owned: bool
) -> AsyncIterator[CheckResult]:
    """All of it; ends early where nothing answers. owned: a program that runs in lift mode is slipguard's own."""
    dashboard, monitor = DashboardClient(name, settings.host), StateMonitor(name, settings.host)
    try:
        try:
            await monitor.open()
        except DeviceError as error:
            yield problem_from_error("controller", error, name, "check the robot's power, network cable and address")
            return
        yield ok("controller", f"{settings.host}, software {'.'.join(map(str, monitor.version))}")
        begun_s, packets = asyncio.get_running_loop().time(), monitor.packets
        async for result in ask(name, dashboard, settings, mode, owned=owned):
            yield result
        await asyncio.sleep(max(0.0, begun_s + LOOK_S - asyncio.get_running_loop().time()))
        rate_hz = (monitor.packets - packets) / (asyncio.get_running_loop().time() - begun_s)
        try:
            state = monitor.fresh()
        except DeviceError as error:
            yield problem_from_error("RTDE rate", error, name, "check the network cable")
            return
        yield rate(rate_hz)
        for result in robot(state):
            yield result
        if mode == "lift":
            yield await script_port(name, settings.host)
        for result in await urcaps(settings.host):
            yield result
    finally:
        dashboard.close()
        await monitor.close()


async def ask(
    name: str, dashboard: DashboardClient, settings: Ur5Settings, mode: Literal["lift", "guard"], *, owned: bool
) -> AsyncIterator[CheckResult]:
    """Questions only: serial number, remote control, the program."""
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
        check = "take scripts" if mode == "lift" else "let itself be paused"
        yield problem("control", f"local: the robot will not {check}", "switch it to remote control at the panel")
    on = program.upper().startswith(("PLAYING", "PAUSED"))
    if mode == "lift" and on and not owned:
        yield problem(
            "program",
            f"{program}: mode 'lift' would end it, so slipguard does not take the arm beside it",
            'stop that program, or set [guard] mode = "guard" where it is to move the arm',
        )
    else:
        yield ok("program", program)


def rate(rate_hz: float) -> CheckResult:
    """How often the state really comes."""
    observed = f"{rate_hz:.0f} states a second of {RATE_HZ:.0f} asked for"
    if rate_hz < RATE_SHARE * RATE_HZ:
        return problem(
            "RTDE rate", observed, "use a cable instead of Wi-Fi, straight to the controller or by one switch"
        )
    return ok("RTDE rate", observed)


def robot(state: RobotState) -> Iterator[CheckResult]:
    """Is it on, and does anything stop it."""
    mode = MODES.get(state.mode, f"mode {state.mode}")
    if state.emergency:
        yield problem("stops", "emergency stop or safety fault", f"release the button, then {POWER_UP}")
    elif state.protective:
        yield problem("stops", "protective or safeguard stop", "look why, then unlock it at the panel")
    else:
        yield ok("stops", "none active")
    if state.mode != RUNNING and not state.emergency:
        yield problem("robot", mode, POWER_UP)
    else:
        yield ok("robot", f"{mode}, {'moving' if state.moving else 'at rest'}")


async def script_port(name: str, host: str) -> CheckResult:
    """Where a script would be handed over; nothing is sent."""
    try:
        await check_port(name, host, SCRIPT_PORT, "script port")
    except DeviceError as error:
        return problem_from_error("script port", error, name, "enable it in the robot's security settings")
    return ok("script port", f"{host}:{SCRIPT_PORT} is open")


async def urcaps(host: str) -> list[CheckResult]:
    """URCaps that would get in the way, known by the ports they listen at."""
    open_ports = await asyncio.gather(*(_listens(host, port) for port in URCAPS))
    clashes = [note("URCap", f"{URCAPS[port][0]} runs on the controller (port {port})", URCAPS[port][1])
               for port, listens in zip(URCAPS, open_ports, strict=True) if listens]  # fmt: skip
    return clashes or [ok("URCap", "none that is known to get in the way")]


async def _listens(host: str, port: int) -> bool:
    try:
        async with asyncio.timeout(URCAP_S):
            _, writer = await asyncio.open_connection(host, port)
    except (OSError, TimeoutError):
        return False
    writer.transport.abort()
    return True
