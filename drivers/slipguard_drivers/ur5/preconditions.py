"""Checks whether lift mode may take the robot, before ur-rtde connects, and whether a lift is valid.

ur-rtde's constructor ends the running program, uploads a script and claims the input registers. If one of these is not
possible, it hangs or reports an unclear error.
"""

from __future__ import annotations

import asyncio
import math

from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.own_script import is_marked
from slipguard_drivers.ur5.rtde import RtdeConnection, check_port
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import ROBOT_MODES, RUNNING, STOPPED, StateMonitor

SCRIPT_PORT = 30003
END_TIMEOUT_S = 0.3
POLL_S = 0.01


async def check_robot_is_free(
    name: str, settings: Ur5Settings, monitor: StateMonitor, dashboard: DashboardClient, *, own_program: bool
) -> None:
    """Raise DeviceLost with what prevents lift mode and what to do.

    Args:
        monitor: open.
        own_program: a program that runs is a script that this driver left behind; it is ended.
    """
    mode = monitor.newest.mode
    if mode != RUNNING:
        state = ROBOT_MODES.get(mode, mode)
        raise DeviceLost(f"{name}: the robot is not ready ({state}); switch the arm on at the panel")
    if not await dashboard.in_remote_control():
        raise DeviceLost(f"{name}: the robot is in local control; switch it to remote control at the panel")
    if own_program and monitor.newest.runtime != STOPPED:
        await dashboard.ask("stop")
        for _ in range(round(END_TIMEOUT_S / POLL_S)):
            if monitor.newest.runtime == STOPPED:
                break
            await asyncio.sleep(POLL_S)
    if monitor.newest.runtime != STOPPED:
        program = await dashboard.ask("programState")
        text = f"{name}: a program is running or paused ({program}), and lift mode would end it; stop it at the panel, "
        if is_marked(monitor.newest):
            raise DeviceLost(f"{text}if no other program is meant to run: it may be the script that slipguard left")
        raise DeviceLost(f'{text}or let it move the arm: [guard] mode = "guard"')
    await check_port(name, settings.host, SCRIPT_PORT, "script port")
    first = first_register(settings)
    connection = await RtdeConnection.connect(name, settings.host)
    try:
        await connection.claim_inputs([f"input_int_register_{first}", f"input_double_register_{first}"])
    except CommandRefused as error:
        other = "lower" if first else "upper"
        raise DeviceLost(f'{error}; or try registers = "{other}" in [arm.ur5]') from None
    finally:
        connection.close()


def first_register(settings: Ur5Settings) -> int:
    """Return the number of the first register that ur-rtde uses."""
    return 24 if settings.registers == "upper" else 0


def check_lift(name: str, height_mm: float, speed_mm_s: float) -> None:
    """Raise CommandRefused if height or speed is not valid."""
    if not math.isfinite(height_mm):
        raise CommandRefused(f"{name}: height_mm is {height_mm}; it must be a finite number")
    if not (math.isfinite(speed_mm_s) and speed_mm_s > 0):
        raise CommandRefused(f"{name}: speed_mm_s is {speed_mm_s}; it must be above 0")
