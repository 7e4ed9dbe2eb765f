"""Guard mode: another program moves the arm. It is monitored, paused when an object slips, and never taken over.

RTDE is only read and no script is uploaded; ur-rtde, which would end the user's program, is not even imported. The arm
is stopped by the dashboard's `pause`, which `play` ends, or by a digital output that the program reads. Neither needs
the monitored state, so a stop is tried even if no state arrives. Disconnecting stops nothing.
"""

from __future__ import annotations

import asyncio

from slipguard.cancellation import cancel_and_wait
from slipguard.devices import Arm, ArmState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.digital_output import DigitalOutput
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import PAUSED, STOPPED, StateMonitor

PAUSE_TIMEOUT_S = 1.0
"""The dashboard answers a pause when the arm is at rest: a stop from full speed takes up to 0.5 s."""
CHECK_PERIOD_S = 0.5
"""How often the driver checks that the arm could be stopped."""
LOST_S = 1.0
SILENT_CHECKS = 2
"""After this many checks in a row without a response, the dashboard would not answer a pause either."""
PAUSING = "Pausing program"


class GuardModeArm(Arm):
    """An arm that another program moves."""

    def __init__(self, name: str, settings: Ur5Settings) -> None:
        self._name, self._host = name, settings.host
        self._monitor = StateMonitor(name, settings.host)
        self._dashboard = DashboardClient(name, settings.host)
        self._output: DigitalOutput | None = None
        if settings.stop_by == "digital_output" and settings.digital_output is not None:
            self._output = DigitalOutput(name, settings.host, settings.digital_output, settings.pulse_ms / 1000.0)
        self._checking: asyncio.Task[None] | None = None
        self._lost: str | None = None

    async def open(self) -> None:
        """Connect and check that the arm could be stopped; affects no program. Idempotent."""
        if self._checking is not None and not self._checking.done():
            return
        await self.close()
        try:
            await self._monitor.open()
            if self._output is not None:
                await self._output.check()
            else:
                self._require_remote_control(await self._dashboard.in_remote_control())
        except CommandRefused as error:
            await self.close()
            raise DeviceLost(str(error)) from None
        except BaseException:
            await self.close()
            raise
        self._lost = None
        self._checking = asyncio.create_task(self._check_regularly(), name=f"{self._name}: guard mode checks")

    async def state(self) -> ArmState:
        """Return the newest state. Raises DeviceTimeout if it is old, DeviceLost if the arm must be reopened."""
        self._check_open()
        return self._monitor.arm_state()

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Refuse: another program moves the arm."""
        self._check_open()
        raise CommandRefused(
            f"{self._name}: in guard mode another program moves the arm; lift and lower with that program, "
            'or set [guard] mode = "lift"'
        )

    async def stop(self) -> None:
        """Stop the program that moves the arm; does nothing if none runs. If the output fails, pause by the dashboard.

        Raises:
            CommandRefused: with the controller's reason if it does not pause.
            DeviceLost: if the arm is lost or not open; it is stopped even then.
        """
        if self._output is None:
            await self._pause()
        else:
            try:
                await self._output.pulse()
            except (DeviceError, CommandRefused) as error:
                await self._pause()
                raise CommandRefused(f"{error}; its program was paused by the dashboard instead") from None
        if (reason := self._why_lost()) is not None:
            raise DeviceLost(f"{reason}; the stop was sent all the same")

    async def close(self) -> None:
        """Disconnect; the arm's program continues."""
        checking, self._checking = self._checking, None
        await cancel_and_wait(checking)
        if self._output is not None:
            await self._output.close()
        await self._monitor.close()
        self._dashboard.close()

    async def _pause(self) -> None:
        # An old state is not enough: only a program that is known to be stopped now needs no pause.
        if self._monitor.current_runtime in (STOPPED, PAUSED):
            return
        # A connection of its own: the other one may be waiting for a response that does not come.
        dashboard = DashboardClient(self._name, self._host)
        try:
            response = await dashboard.ask("pause", timeout_s=PAUSE_TIMEOUT_S)
            if response != PAUSING and (await dashboard.ask("programState")).upper().startswith("PLAYING"):
                raise CommandRefused(f"{self._name}: its program cannot be paused: the robot answers {response!r}")
        finally:
            dashboard.close()

    def _require_remote_control(self, remote: bool) -> None:
        if not remote:
            raise DeviceLost(
                f"{self._name}: the robot is in local control and would ignore a pause; switch it to remote control, "
                'or use stop_by = "digital_output"'
            )

    def _check_open(self) -> None:
        if (reason := self._why_lost()) is not None:
            raise DeviceLost(reason)

    def _why_lost(self) -> str | None:
        if self._lost is None and self._checking is None:
            return f"{self._name}: the connection is not open; open it first"
        return self._lost

    async def _check_regularly(self) -> None:
        silent = 0
        try:
            while True:
                await asyncio.sleep(CHECK_PERIOD_S)
                if self._monitor.age_s > LOST_S:
                    raise DeviceLost(f"{self._name}: no new state from the controller for {LOST_S:g} s; open it again")
                if self._output is not None:
                    self._output.raise_if_left_high()
                    continue
                try:
                    remote = await self._dashboard.in_remote_control()
                except DeviceError:
                    silent += 1
                    if silent >= SILENT_CHECKS:
                        raise
                    continue
                silent = 0
                self._require_remote_control(remote)
        except DeviceError as error:
            self._lost = str(error)
