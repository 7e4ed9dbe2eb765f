"""Lift mode: slipguard moves the arm, through ur-rtde in a process of its own.

Three independent means stop the arm: the stop command of the control script, the dashboard's `stop` over a connection
of its own, and the watchdog in the robot. The watchdog is fed only while this event loop runs, the worker process
responds, and the controller's clock advances.

A protective stop pauses the control script, and the robot would continue its motion after `play`, or by itself after a
safeguard stop. So the driver ends the paused script by the dashboard, which moves nothing; it also recognizes one that
was left by a lost connection or by a daemon that was killed (see `own_script`). It never unlocks a stop:
a person does, after finding the cause. Then it uploads the script again, with the heights as before, and moves
slowly at first. Until the arm is under control again, its state says that it is stopped, or what prevents control.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import replace
from typing import Any

from slipguard.cancellation import cancel_and_wait
from slipguard.devices import Arm, ArmState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.ur5.dashboard import DashboardClient, stop_program
from slipguard_drivers.ur5.motion_client import MotionWorkerClient
from slipguard_drivers.ur5.own_script import MARK, OwnScript
from slipguard_drivers.ur5.preconditions import check_lift, check_robot_is_free, first_register
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import STALE_S, RobotState, StateMonitor

HEARTBEAT_S = 0.05
LOST_S = 0.5
"""If the controller's clock stands still this long, the worker is killed and the arm must be opened again."""
STOP_TIMEOUT_S, MOVE_TIMEOUT_S = 0.3, 0.5
DISAGREE_S = 1.0
"""ur-rtde's own receiver may die unnoticed, so its report of a motion is compared with the monitored speed."""
SPEED_MIN_MM_S = 1.0
"""A slower motion cannot be distinguished from rest."""
REST_TIMEOUT_S = 1.0
"""From 250 mm/s, the weakest allowed stop (500 mm/s2) takes 0.5 s."""
POLL_S = 0.01
RETRY_S = 0.5
"""How often a paused script is to be ended during a stop, where a controller may refuse it, and how often control of
the arm is tried to be regained afterwards."""
AFTER_STOP_MM_S = 20.0
"""Speed limit after a safety stop, until a motion has reached its goal."""
REACHED_M = 0.001


class SafetyStopActive(CommandRefused):
    """A safety stop became active during a command."""


class LiftModeArm(Arm):
    """One arm. It lifts along the z axis of its base, so the base must stand upright (see `mounting`)."""

    def __init__(self, name: str, settings: Ur5Settings) -> None:
        self._name = name
        self._settings = settings
        first = first_register(settings)
        self._monitor = StateMonitor(name, settings.host, on_lost=self._lose, first_register=first)
        self._worker = MotionWorkerClient(name, settings.host)
        self._dashboard = DashboardClient(name, settings.host)
        self._script = OwnScript(self._monitor, 1.0 / settings.watchdog_hz + 2 * LOST_S)
        self._heartbeat: asyncio.Task[None] | None = None
        self._dashboard_stop: asyncio.Task[bool] | None = None
        self._lost: str | None = None
        self._monitoring_only = False  # the script is interrupted
        self._regaining = False  # by a safety stop, and the arm is not under control again yet
        self._after_stop = False  # no motion has reached its goal since a safety stop
        self._first_goal_m = math.nan  # height of that goal
        self._retry_at_s = -math.inf
        self._blocked: str | None = None  # why control could not be regained after a safety stop
        self._moving = False  # as ur-rtde reports it
        self._stops = 0
        self._reopen_expected = False
        self._agreed_at_s = math.inf

    async def open(self) -> None:
        """Connect without moving; heights are relative to the present position. Idempotent.

        During a safety stop the arm is only monitored; it is taken under control when the stop is over.
        """
        if self._heartbeat is not None and self._lost is None:
            return
        await self._end_tasks()
        self._worker.kill()
        try:
            await self._monitor.open()
            self._monitoring_only = self._regaining = self._monitor.newest.safety_stop
            self._after_stop, self._first_goal_m = self._after_stop or self._monitoring_only, math.nan
            if not self._monitoring_only:
                await self._take_control()
        except BaseException as error:
            self._reopen_expected = isinstance(error, DeviceError)
            self._worker.kill()
            self._dashboard.close()
            await self._monitor.close()
            raise
        self._reopen_expected = False
        self._lost, self._blocked, self._moving = None, None, False
        self._agreed_at_s = asyncio.get_running_loop().time()
        self._script.controlled()
        self._heartbeat = asyncio.create_task(self._run_heartbeat(), name=f"{self._name}: heartbeat")

    async def state(self) -> ArmState:
        """Return the newest state. Raises DeviceTimeout if it is old, DeviceLost if the arm must be reopened.

        After a safety stop, `protective_stop` stays true until the arm is under control again. DeviceTimeout: something
        prevents that, such as local control.
        """
        self._check_open()
        state = self._monitor.arm_state(command_running=self._moving)
        if self._blocked is not None:
            raise DeviceTimeout(self._blocked)
        if self._regaining and not state.emergency_stop:
            return replace(state, protective_stop=True)
        return state

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start moving; return the speed applied, within the limits. A motion under way is stopped first."""
        check_lift(self._name, height_mm, speed_mm_s)
        self._check_open()
        state = self._monitor.fresh()
        if state.safety_stop:
            kind = "an emergency" if state.emergency else "a protective"
            raise CommandRefused(f"{self._name}: {kind} stop is active; clear it at the controller first")
        if self._monitoring_only:
            raise CommandRefused(f"{self._name}: not under control again after a stop; wait, then send the lift again")
        stops = self._stops
        if self._moving or state.moving:
            await self._call("stop", timeout_s=STOP_TIMEOUT_S)
            await self._wait_for_rest()
        if self._stops != stops:
            raise CommandRefused(f"{self._name}: it was stopped during the command; send the lift again")
        pose = list(self._monitor.fresh().pose)
        if abs(pose[2] - self._first_goal_m) < REACHED_M:
            self._after_stop, self._first_goal_m = False, math.nan
        pose[2] += height_mm / 1000.0
        limit_mm_s = min(self._settings.speed_max_mm_s, AFTER_STOP_MM_S if self._after_stop else math.inf)
        speed_mm_s = min(max(speed_mm_s, SPEED_MIN_MM_S), limit_mm_s)
        acceleration_m_s2 = self._settings.acceleration_mm_s2 / 1000.0
        await self._call("move", pose, speed_mm_s / 1000.0, acceleration_m_s2, timeout_s=MOVE_TIMEOUT_S)
        self._moving, self._first_goal_m = True, pose[2] if self._after_stop else math.nan
        return speed_mm_s

    async def stop(self) -> None:
        """Stop now. A worker that does not respond is killed; dashboard and watchdog then stop the arm.

        Raises DeviceLost if the arm is lost; a script of ours that may still run is then stopped by the dashboard.
        """
        self._stops += 1
        if (reason := self._why_lost()) is not None:
            if self._script.may_run and await stop_program(self._name, self._settings.host):
                reason += "; a stop was sent to the dashboard all the same"
            raise DeviceLost(reason)
        if not self._monitoring_only:
            with contextlib.suppress(SafetyStopActive):
                await self._call("stop", timeout_s=STOP_TIMEOUT_S)

    async def close(self) -> None:
        """Stop the arm, end our script on the controller, disconnect.

        After a failure the spare worker process is kept, because `open` usually follows; a second `close` ends it.
        """
        await self._end_tasks()
        if self._worker.connected:
            with contextlib.suppress(DeviceError, CommandRefused):
                await self._worker.call("stop", timeout_s=STOP_TIMEOUT_S)
                await self._worker.call("leave", timeout_s=STOP_TIMEOUT_S)
        elif self._monitoring_only and self._script.may_run:
            await stop_program(self._name, self._settings.host)
        self._monitoring_only = False
        if self._reopen_expected:
            self._worker.kill()
        else:
            self._worker.close()
        self._reopen_expected = False
        await self._monitor.close()
        self._dashboard.close()

    async def _take_control(self) -> None:
        """Check that the robot is free; only then let ur-rtde connect to it."""
        settings = self._settings
        self._worker.start_spare()  # it starts during the checks
        self._script.forget_if_stopped()
        own_program = self._script.may_run
        await check_robot_is_free(self._name, settings, self._monitor, self._dashboard, own_program=own_program)
        self._script.uploading()
        try:
            upper_registers = settings.registers == "upper"
            await self._worker.connect(
                settings.watchdog_hz, settings.stop_mm_s2 / 1000.0, MARK, upper_registers=upper_registers
            )
        except BaseException:
            self._script.abandon(starting=True)
            raise

    # --- heartbeat ---

    def _check_open(self) -> None:
        if (reason := self._why_lost()) is not None:
            raise DeviceLost(reason)

    def _why_lost(self) -> str | None:
        if self._lost is None and self._heartbeat is None:
            return f"{self._name}: the connection is not open; open it first"
        return self._lost

    async def _run_heartbeat(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                due_s = max(due_s + HEARTBEAT_S, loop.time())
                await asyncio.sleep(due_s - loop.time())
                await self._beat()
        except DeviceError as error:
            self._lose(str(error))
        except Exception as error:  # such as OSError: no process for the worker could be started
            self._lose(f"{self._name}: the heartbeat has failed ({type(error).__name__}: {error}); open the arm again")

    async def _beat(self) -> None:
        age_s = self._monitor.age_s
        if age_s > LOST_S:
            raise DeviceLost(f"{self._name}: no new state from the controller for {age_s:.1f} s; open it again")
        state = self._monitor.newest
        if self._monitoring_only:
            await self._follow_safety_stop(state)
            return
        if age_s > STALE_S:  # stop what may be moving, and do not feed the watchdog
            await self._worker.call("stop", timeout_s=STOP_TIMEOUT_S)
            return
        if self._script.has_ended or self._script.safety_stopped:
            await self._handle_interrupted_script()
            return
        reply = await self._worker.call("beat", timeout_s=1.0 / self._settings.watchdog_hz)
        self._moving = reply["moving"]
        if not reply["running"]:
            await self._handle_interrupted_script()
            return
        now_s, moving = asyncio.get_running_loop().time(), self._monitor.newest.moving
        if self._moving is moving:
            self._agreed_at_s = now_s
        elif now_s - self._agreed_at_s > DISAGREE_S:
            raise DeviceLost(
                f"{self._name}: the arm {'moves' if moving else 'is at rest'}, and ur-rtde reports the opposite for "
                f"{DISAGREE_S:g} s; open it again"
            )

    async def _handle_interrupted_script(self) -> None:
        """After a safety stop, only monitor the arm; after anything else, give it up to the other program."""
        self._worker.kill()
        self._monitoring_only, self._moving = True, False
        if not self._script.safety_stopped:
            await asyncio.sleep(HEARTBEAT_S)  # the packet that reports the stop may not have arrived yet
        if not self._script.safety_stopped:
            self._script.forget()
            raise DeviceLost(f"{self._name}: the control script has ended on the controller; open the arm again")
        self._regaining = self._after_stop = True
        self._first_goal_m, self._retry_at_s = math.nan, -math.inf
        self._script.paused()

    async def _follow_safety_stop(self, state: RobotState) -> None:
        """End our paused script; take control again when the stop is over."""
        loop = asyncio.get_running_loop()
        due = loop.time() >= self._retry_at_s
        if self._script.still_paused() and (due or not state.safety_stop):
            self._retry_at_s = loop.time() + RETRY_S
            await stop_program(self._name, self._settings.host)
        elif state.safety_stop:
            self._blocked = None
        elif due:
            try:
                await self._take_control()
            except DeviceLost as error:
                self._blocked, self._retry_at_s = str(error), loop.time() + RETRY_S
                return
            self._monitoring_only = self._regaining = False
            self._blocked, self._agreed_at_s = None, loop.time()
            self._script.controlled()

    async def _call(self, request: str, *arguments: object, timeout_s: float) -> Any:
        try:
            return await self._worker.call(request, *arguments, timeout_s=timeout_s)
        except DeviceLost as error:
            if self._monitoring_only:  # a safety stop has ended the script
                raise SafetyStopActive(f"{self._name}: a safety stop is active; clear it at the controller") from None
            self._lose(str(error))
            raise

    async def _wait_for_rest(self) -> None:
        """Wait until the arm is at rest; feed the watchdog meanwhile."""
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + REST_TIMEOUT_S
        while True:
            reply = await self._call("beat", timeout_s=1.0 / self._settings.watchdog_hz)
            self._moving = reply["moving"]
            if not (self._moving or self._monitor.fresh().moving):
                return
            if loop.time() > ends_s:
                raise CommandRefused(f"{self._name}: the arm still moves after {REST_TIMEOUT_S:g} s; stop it first")
            await asyncio.sleep(POLL_S)

    def _lose(self, reason: str) -> None:
        """Kill the worker at once, and stop the arm by the dashboard if a script of ours may still run."""
        if self._lost is not None:
            return
        self._lost, self._reopen_expected = reason, True
        self._worker.kill()
        if self._script.can_be_lost:
            self._script.abandon()
            stopping = stop_program(self._name, self._settings.host)
            self._dashboard_stop = asyncio.create_task(stopping, name=f"{self._name}: dashboard stop")

    async def _end_tasks(self) -> None:
        heartbeat, self._heartbeat = self._heartbeat, None
        if not self._worker.connected:
            self._worker.kill()  # ends a connection attempt, which may take seconds
        await cancel_and_wait(heartbeat)
        if self._dashboard_stop is not None:
            await self._dashboard_stop
            self._dashboard_stop = None
