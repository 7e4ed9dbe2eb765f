"""Lift mode: slipguard moves the arm, through ur-rtde in a process of its own.

Three things stop the arm when something goes wrong, each without the others: the stop that is told through the control
script, the dashboard's `stop` over a connection of its own, and the watchdog in the robot, which is fed only as long as
this loop runs, the worker answers, and the controller's clock is seen to advance.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import Any

from slipguard.cancellation import cancel_and_wait
from slipguard.devices import Arm, ArmState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.preconditions import check_free
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_drivers.ur5.state_monitor import STALE_S, STOPPED, StateMonitor
from slipguard_drivers.ur5.worker_link import MotionWorkerClient

BEAT_S = 0.05
GIVE_UP_S = 0.5
"""The controller's clock standing still for this long: the worker is killed and the arm must be opened again."""
STOP_S, MOVE_S, HALT_S = 0.3, 0.5, 0.3
DISAGREE_S = 1.0
"""ur-rtde's own reading may die unnoticed; what it tells of a motion is held against what is seen."""
SLOWEST_MM_S = 1.0
"""Slower is not told from standing."""
REST_S = 1.0
"""250 mm/s at the weakest stop there may be, 500 mm/s2, ends in 0.5 s."""
POLL_S = 0.01
START_S = 0.2
"""A script that was just handed over may start so much later: nothing seen to run before that proves nothing."""


class SafetyStopActive(CommandRefused):
    """It came while a command was on its way."""


class LiftModeArm(Arm):
    """One arm, its base upright: up is the base's z axis."""

    def __init__(self, name: str, settings: Ur5Settings) -> None:
        self._name = name
        self._settings = settings
        self._monitor = StateMonitor(name, settings.host, on_lost=self._lose)
        self._worker = MotionWorkerClient(name, settings.host)
        self._dashboard = DashboardClient(name, settings.host)
        self._heartbeat: asyncio.Task[None] | None = None
        self._halting: asyncio.Task[bool] | None = None
        self._lost: str | None = None
        self._resting = False  # a safety stop is active: watched without hands
        self._travelling = False
        self._stops = 0
        self._again = False
        self._taken_at_s = math.inf
        self._agreed_at_s = math.inf
        self._ours_until_s = -math.inf  # until then, a program that runs may be our own, left behind,
        self._left_at_s = -math.inf  # where none was seen to rest since

    async def open(self) -> None:
        """Connect without moving; heights count from here. Idempotent.

        While a safety stop is active the arm is only watched, and lost when the stop is over: open it again.
        """
        if self._heartbeat is not None and self._lost is None:
            return
        await self._stop_heartbeat()
        self._worker.kill()
        try:
            await self._monitor.open()
            state = self._monitor.newest
            self._resting = state.protective or state.emergency
            if not self._resting:
                await self._take()
        except BaseException as error:
            self._again = isinstance(error, DeviceError)
            self._worker.kill()
            self._dashboard.close()
            await self._monitor.close()
            raise
        self._again = False
        now_s = asyncio.get_running_loop().time()
        self._lost, self._travelling, self._taken_at_s, self._agreed_at_s = None, False, now_s, now_s
        self._heartbeat = asyncio.create_task(self._keep_beating(), name=f"{self._name}: heartbeat")

    async def state(self) -> ArmState:
        """What is seen. Raises DeviceTimeout when it is old, DeviceLost when the arm must be opened again."""
        self._check_alive()
        return self._monitor.state(travelling=self._travelling)

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start moving; return the speed applied, within the limits. A motion under way is stopped first."""
        check_lift(self._name, height_mm, speed_mm_s)
        self._check_alive()
        state = self._monitor.fresh()
        if state.emergency or state.protective:
            which = "an emergency" if state.emergency else "a protective"
            raise CommandRefused(f"{self._name}: {which} stop is active; clear it at the controller first")
        stops = self._stops
        if self._travelling or state.moving:
            await self._call("stop", deadline_s=STOP_S)
            await self._rest()
        if self._stops != stops:
            raise CommandRefused(f"{self._name}: it was stopped meanwhile")
        pose = list(self._monitor.fresh().pose)
        pose[2] += height_mm / 1000.0
        speed_mm_s = min(max(speed_mm_s, SLOWEST_MM_S), self._settings.speed_max_mm_s)
        acceleration_m_s2 = self._settings.acceleration_mm_s2 / 1000.0
        await self._call("move", pose, speed_mm_s / 1000.0, acceleration_m_s2, deadline_s=MOVE_S)
        self._travelling = True
        return speed_mm_s

    async def stop(self) -> None:
        """Stop now. A worker that does not answer is killed, and dashboard and watchdog stop the arm.

        Raises DeviceLost where the arm is lost; what may still run of ours is then stopped over the dashboard.
        """
        self._stops += 1
        if (why := self._why_lost()) is not None:
            if self._left_running and await self._halt():
                why += "; it was told over the dashboard to stop all the same"
            raise DeviceLost(why)
        if not self._resting:
            with contextlib.suppress(SafetyStopActive):
                await self._call("stop", deadline_s=STOP_S)

    async def close(self) -> None:
        """Stop the arm, end our script on the controller, disconnect.

        After a failure the process that waits to be the next worker is kept, for `open` is at hand; a further `close`
        lets go of it.
        """
        await self._stop_heartbeat()
        if self._worker.connected:
            with contextlib.suppress(DeviceError, CommandRefused):
                await self._worker.call("stop", deadline_s=STOP_S)
                await self._worker.call("leave", deadline_s=STOP_S)
        if self._again:
            self._worker.kill()
        else:
            self._worker.close()
        self._again = False
        await self._monitor.close()
        self._dashboard.close()

    async def _take(self) -> None:
        """Look whether the robot can be had; only then let ur-rtde connect to it."""
        settings = self._settings
        self._worker.prepare()  # it starts while we look
        now_s = asyncio.get_running_loop().time()
        if now_s > self._left_at_s and self._monitor.newest.runtime == STOPPED:
            self._ours_until_s = -math.inf
        await check_free(self._name, settings, self._monitor, self._dashboard, ours=self._left_running)
        self._ours_until_s, self._left_at_s = math.inf, -math.inf
        try:
            stop_m_s2 = settings.stop_mm_s2 / 1000.0
            await self._worker.connect(settings.watchdog_hz, stop_m_s2, upper=settings.registers == "upper")
        except BaseException:
            self._left_behind(START_S)
            raise

    # --- keeping it ---

    def _check_alive(self) -> None:
        if (why := self._why_lost()) is not None:
            raise DeviceLost(why)

    def _why_lost(self) -> str | None:
        if self._lost is None and self._heartbeat is None:
            return f"{self._name}: the connection is not open; open it first"
        return self._lost

    async def _keep_beating(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                due_s = max(due_s + BEAT_S, loop.time())
                await asyncio.sleep(due_s - loop.time())
                await self._beat()
        except DeviceError as error:
            self._lose(str(error))

    async def _beat(self) -> None:
        age_s = self._monitor.age_s
        if age_s > GIVE_UP_S:
            raise DeviceLost(f"{self._name}: the controller's clock has stood still for {age_s:.1f} s; open it again")
        state = self._monitor.newest
        if self._resting:
            if not (state.protective or state.emergency):
                raise DeviceLost(f"{self._name}: the safety stop is over; open the arm again")
            return
        if age_s > STALE_S:
            # Blind: stop what may be moving, and leave the watchdog unfed.
            await self._worker.call("stop", deadline_s=STOP_S)
            return
        if self._script_ended:
            await self._without_script()
            return
        reply = await self._worker.call("beat", deadline_s=1.0 / self._settings.watchdog_hz)
        self._travelling = reply["travelling"]
        if not reply["running"]:
            await self._without_script()
        now_s, moving = asyncio.get_running_loop().time(), self._monitor.newest.moving
        if self._travelling is moving:
            self._agreed_at_s = now_s
        elif now_s - self._agreed_at_s > DISAGREE_S:
            raise DeviceLost(
                f"{self._name}: the arm {'moves' if moving else 'stands'}, and ur-rtde has not seen it for "
                f"{DISAGREE_S:g} s; open it again"
            )

    @property
    def _script_ended(self) -> bool:
        """Since it was started, no program was seen to run; one that runs now is somebody else's."""
        return self._monitor.stopped_at_s > self._taken_at_s

    async def _without_script(self) -> None:
        """By a safety stop: watch on without hands. By anything else: the arm is somebody else's now."""
        self._worker.kill()
        self._ours_until_s, self._resting, self._travelling = -math.inf, True, False
        await asyncio.sleep(BEAT_S)  # the packet with the stop's bit may be on its way
        state = self._monitor.newest
        if not (state.protective or state.emergency):
            raise DeviceLost(f"{self._name}: our script on the controller has ended; open the arm again")

    async def _call(self, request: str, *arguments: object, deadline_s: float) -> Any:
        try:
            return await self._worker.call(request, *arguments, deadline_s=deadline_s)
        except DeviceLost as error:
            if self._resting:  # a safety stop came first, and ended the script
                raise SafetyStopActive(f"{self._name}: a safety stop is active") from None
            self._lose(str(error))
            raise

    async def _rest(self) -> None:
        """Until the arm stands; the watchdog is fed meanwhile."""
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + REST_S
        while True:
            reply = await self._call("beat", deadline_s=1.0 / self._settings.watchdog_hz)
            self._travelling = reply["travelling"]
            if not (self._travelling or self._monitor.fresh().moving):
                return
            if loop.time() > ends_s:
                raise CommandRefused(f"{self._name}: it does not come to rest before the new motion")
            await asyncio.sleep(POLL_S)

    def _lose(self, why: str) -> None:
        """Give up the worker, at once, and stop the arm over the dashboard where a program of ours may still run."""
        if self._lost is not None:
            return
        self._lost, self._again = why, True
        self._worker.kill()
        if self._ours_until_s == math.inf and not self._script_ended:
            self._left_behind()
            self._halting = asyncio.create_task(self._halt(), name=f"{self._name}: halt")

    async def _halt(self) -> bool:
        """Stop whatever runs; whether the dashboard answered."""
        dashboard, answered = DashboardClient(self._name, self._settings.host), False
        with contextlib.suppress(DeviceError):
            await dashboard.ask("stop", deadline_s=HALT_S)
            answered = True
        dashboard.close()
        return answered

    def _left_behind(self, starts_within_s: float = 0.0) -> None:
        """The watchdog ends what we have left behind; until then, or until it has ended, it is known as ours."""
        now_s = asyncio.get_running_loop().time()
        self._left_at_s = now_s + starts_within_s
        self._ours_until_s = now_s + 1.0 / self._settings.watchdog_hz + 2 * GIVE_UP_S

    @property
    def _left_running(self) -> bool:
        """What we have left behind may still run."""
        now_s = asyncio.get_running_loop().time()
        return now_s < self._ours_until_s and self._monitor.stopped_at_s <= self._left_at_s

    async def _stop_heartbeat(self) -> None:
        heartbeat, self._heartbeat = self._heartbeat, None
        await cancel_and_wait(heartbeat)
        if self._halting is not None:
            await self._halting
            self._halting = None


def check_lift(name: str, height_mm: float, speed_mm_s: float) -> None:
    """Raises CommandRefused for what is no motion."""
    if not math.isfinite(height_mm):
        raise CommandRefused(f"{name}: height_mm is {height_mm}; it must be a number")
    if not (math.isfinite(speed_mm_s) and speed_mm_s > 0):
        raise CommandRefused(f"{name}: speed_mm_s is {speed_mm_s}; it must be above 0")
