"""Guard mode: another program moves the arm. It is watched, and stopped when an object slips; never taken over.

RTDE is only read, and no script goes to the controller: ur-rtde, which would end the user's program, is not even
imported. The arm is stopped by the dashboard's `pause`, which a `play` ends, or by a digital output that the program
heeds. Neither needs what is watched, so a stop is tried whether the arm is seen or not. Disconnecting stops nothing.
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

PAUSE_S = 1.0
"""The dashboard answers a pause when the arm stands: a stop from full speed takes up to 0.5 s."""
LOOK_S = 0.5
"""How often it is made sure that the arm could be stopped."""
GIVE_UP_S = 1.0
SILENT_LOOKS = 2
"""So many looks in a row without an answer from the dashboard: it would not answer a pause either."""
PAUSING = "Pausing program"


class GuardModeArm(Arm):
    """One arm that somebody else moves."""

    def __init__(self, name: str, settings: Ur5Settings) -> None:
        self._name, self._host = name, settings.host
        self._monitor = StateMonitor(name, settings.host)
        self._dashboard = DashboardClient(name, settings.host)
        self._output: DigitalOutput | None = None
        if settings.stop_by == "digital_output" and settings.digital_output is not None:
            self._output = DigitalOutput(name, settings.host, settings.digital_output, settings.pulse_ms / 1000.0)
        self._watch: asyncio.Task[None] | None = None
        self._lost: str | None = None

    async def open(self) -> None:
        """Connect and make sure that the arm could be stopped; touches no program. Idempotent."""
        if self._watch is not None and not self._watch.done():
            return
        await self._disconnect()
        try:
            await self._monitor.open()
            await self._check_stop()
        except CommandRefused as error:
            await self._disconnect()
            raise DeviceLost(str(error)) from None
        except BaseException:
            await self._disconnect()
            raise
        self._lost = None
        self._watch = asyncio.create_task(self._keep_watch(), name=f"{self._name}: watch")

    async def state(self) -> ArmState:
        """What is seen. Raises DeviceTimeout when it is old, DeviceLost when it must be opened again."""
        self._check_alive()
        return self._monitor.state()

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Always refused: the arm is somebody else's."""
        self._check_alive()
        raise CommandRefused(
            f"{self._name}: in guard mode another program moves the arm; lift and lower with that, "
            'or set [guard] mode = "lift"'
        )

    async def stop(self) -> None:
        """Pause the program that moves the arm; nothing where none plays. Where an output fails, pause all the same.

        Raises CommandRefused in the controller's words where it does not pause. Where the arm is lost or was never
        opened it is stopped too, and then DeviceLost says why it is not seen.
        """
        if self._output is None:
            await self._pause()
        else:
            try:
                await self._output.pulse()
            except (DeviceError, CommandRefused) as error:
                await self._pause()
                raise CommandRefused(f"{error}; its program was paused by the dashboard instead") from None
        if (why := self._why_lost()) is not None:
            raise DeviceLost(f"{why}; it was told to stop all the same")

    async def close(self) -> None:
        """Disconnect; whatever moves goes on."""
        await self._disconnect()

    async def _pause(self) -> None:
        # Old news is no reason to be idle: only a program that is known to rest now needs no pause.
        if self._monitor.runtime_now() in (STOPPED, PAUSED):
            return
        # Over a connection of its own: the other one may be waiting for an answer that does not come.
        dashboard = DashboardClient(self._name, self._host)
        try:
            answer = await dashboard.ask("pause", deadline_s=PAUSE_S)
            if answer != PAUSING and (await dashboard.ask("programState")).upper().startswith("PLAYING"):
                raise CommandRefused(f"{self._name}: its program cannot be paused: the robot says {answer!r}")
        finally:
            dashboard.close()

    async def _check_stop(self) -> None:
        """Raises DeviceLost or CommandRefused where a stop would not be heeded."""
        if self._output is not None:
            await self._output.check()
        else:
            await self._check_remote()

    async def _check_remote(self) -> None:
        self._demand(remote=await self._dashboard.in_remote_control())

    def _demand(self, *, remote: bool) -> None:
        if not remote:
            raise DeviceLost(
                f"{self._name}: the robot is in local control and would not heed a pause; switch it to remote control, "
                'or use stop_by = "digital_output"'
            )

    def _check_alive(self) -> None:
        if (why := self._why_lost()) is not None:
            raise DeviceLost(why)

    def _why_lost(self) -> str | None:
        if self._lost is None and self._watch is None:
            return f"{self._name}: the connection is not open; open it first"
        return self._lost

    async def _keep_watch(self) -> None:
        silent = 0
        try:
            while True:
                await asyncio.sleep(LOOK_S)
                if self._monitor.age_s > GIVE_UP_S:
                    raise DeviceLost(f"{self._name}: the controller's clock has stood still; open the arm again")
                if self._output is not None:
                    self._tell_of(self._output)
                    continue
                try:
                    remote = await self._dashboard.in_remote_control()
                except DeviceError:
                    silent += 1
                    if silent >= SILENT_LOOKS:
                        raise
                    continue
                silent = 0
                self._demand(remote=remote)
        except DeviceError as error:
            self._lost = str(error)

    def _tell_of(self, output: DigitalOutput) -> None:
        """Raises DeviceLost, once, where a pulse could not be ended."""
        if output.left_high is not None:
            why, output.left_high = output.left_high, None
            raise DeviceLost(why)

    async def _disconnect(self) -> None:
        watch, self._watch = self._watch, None
        await cancel_and_wait(watch)
        if self._output is not None:
            await self._output.close()
        await self._monitor.close()
        self._dashboard.close()
