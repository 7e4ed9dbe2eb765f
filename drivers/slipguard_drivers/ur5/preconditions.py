"""Whether the robot can be had for lift mode, in words, before ur-rtde touches anything.

ur-rtde's constructor ends whatever program runs, uploads a script and takes the input registers; where one of these
cannot be, it hangs or complains in words of its own. So all of it is looked at first.
"""

from __future__ import annotations

import asyncio

from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.rtde import RtdeConnection, check_port
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import MODES, RUNNING, STOPPED, StateMonitor

SCRIPT_PORT = 30003
END_S = 0.3
POLL_S = 0.01


async def check_free(
    name: str, settings: Ur5Settings, monitor: StateMonitor, dashboard: DashboardClient, *, ours: bool
) -> None:
    """Raises DeviceLost with what is in the way and what to do. monitor: open.

    ours: a program that runs is a script of our own, left behind: it is ended.
    """
    mode = monitor.newest.mode
    if mode != RUNNING:
        raise DeviceLost(f"{name}: the robot is not ready ({MODES.get(mode, mode)}); switch the arm on at the panel")
    if not await dashboard.in_remote_control():
        raise DeviceLost(f"{name}: the robot is in local control; switch it to remote control at the panel")
    if ours and monitor.newest.runtime != STOPPED:
        await _end(monitor, dashboard)
    if monitor.newest.runtime != STOPPED:
        program = await dashboard.ask("programState")
        raise DeviceLost(
            f"{name}: a program is on ({program}), and lift mode would end it; stop it at the panel, "
            'or let it move the arm: [guard] mode = "guard"'
        )
    await check_port(name, settings.host, SCRIPT_PORT, "script port")
    await _check_inputs(name, settings)


async def _end(monitor: StateMonitor, dashboard: DashboardClient) -> None:
    await dashboard.ask("stop")
    for _ in range(round(END_S / POLL_S)):
        if monitor.newest.runtime == STOPPED:
            return
        await asyncio.sleep(POLL_S)


async def _check_inputs(name: str, settings: Ur5Settings) -> None:
    """The registers of the control script are nobody else's."""
    first = 24 if settings.registers == "upper" else 0
    connection = await RtdeConnection.connect(name, settings.host)
    try:
        await connection.inputs([f"input_int_register_{first}", f"input_double_register_{first}"])
    except CommandRefused as error:
        other = "lower" if first else "upper"
        raise DeviceLost(f'{error}; or try registers = "{other}" in [arm.ur5]') from None
    finally:
        connection.close()
