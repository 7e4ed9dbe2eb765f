"""Driver `robotiq`: a Robotiq 2F or Hand-E, on any `transport`. Each command is written and then verified.

Two properties of the hardware determine the design:

* Activation (rACT from 0 to 1) opens and closes the fingers fully, at full speed and force: it would crush what is
  held, and then drop it. Only `activate` sets rACT; see `registers` for how `release` opens a gripper that is not
  active.
* The force register acts only while the fingers move, so tightening is a stop followed by a go. The stop must have been
  reported before the go is sent: within one cycle of the gripper the two would cancel out. The screw keeps the grip
  meanwhile. The force can rise, but not fall, until the fingers open.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator, Coroutine
from dataclasses import replace
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from slipguard.devices import ACTIVATION_HINT, DriverContext, Gripper, GripperState
from slipguard.diagnosis import CheckResult, note, ok
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import registers
from slipguard_drivers.robotiq.byte_line import host_and_port, is_tcp
from slipguard_drivers.robotiq.modbus import ModbusConnection
from slipguard_drivers.robotiq.object_detection import ObjectDetection
from slipguard_drivers.robotiq.registers import AUTO_RELEASE, MODELS, RESET, RobotiqCommand, RobotiqModel, RobotiqStatus
from slipguard_drivers.robotiq.transport import GripperTransport
from slipguard_drivers.robotiq.urcap import UrcapConnection

T = TypeVar("T")
CALL_TIMEOUTS = 8
"""A call takes at most this many response time-outs (0.4 s), unless it activates the gripper."""
ECHO_READS = 5
"""Status reads until a command must be visible in the status: 5 x 5 ms; the gripper's cycle is 5 ms."""
ECHO_SETTLES = 4.0
"""If the transport has a `settle_s`, reading goes on for this many of them."""
RELEASE_COUNTS_MIN = 15
"""A release opens at least this far (5.6 mm on a 2F-85, 2.9 mm on a Hand-E), even if a smaller width is requested."""
OPENING_MIN_MM = 5.0
"""Two fingertip sensors must leave at least this much of the stroke."""
ACTIVATION_TIMEOUT_S = 10.0
"""A 2F-85 takes about 3 s to open and close fully."""
ACTIVATION_POLL_S = 0.05
IN_RESET = (
    "not released: the gripper is in reset (its activation bit is 0), so only an activation would open it, and that "
    "also closes the jaws. Support what it holds, switch its 24 V off and on, which sets the bit, then release again"
)
ACTIVATION_ECHO_S = 0.1
"""A commanded activation must be visible in the status after this time; the gripper's cycle is 5 ms."""
MAY_STILL_MOVE = "its activation was commanded and may still move the jaws fully, until it responds again"
SILENT_S = 1.0
SILENT_CALLS = 2
"""A gripper that answers nothing for this time, and for so many calls, is lost; its own limit for its master is
1 s too."""


class RobotiqSettings(BaseModel):
    """How the gripper is connected (`port` or `urcap`), and what it is."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    port: Annotated[str | None, Field(min_length=1)] = None
    """A serial port of this computer, preferably a name under /dev/serial/by-id, which stays with the adapter; or
    `socket://ROBOT:54321`, the RS-485 forwarder on the robot."""
    urcap: Annotated[str | None, Field(min_length=1)] = None
    """`ROBOT:63352`: Robotiq's URCap on the robot."""
    model: Literal["2F-85", "2F-140", "Hand-E"] = "2F-85"
    """20-235 N, 10-125 N or 20-185 N."""
    slave_id: Annotated[int, Field(ge=1, le=247)] = registers.SLAVE_ID
    """Modbus address."""
    timeout_ms: Annotated[float, Field(ge=20.0, le=1000.0)] = 50.0
    """For one response; longer if the measured round trip needs it."""
    approach_speed: Annotated[float, Field(ge=0.0, le=1.0)] = 0.25
    """Share of the speed range, 20 to 150 mm/s on a 2F-85, at which the fingers close on an object."""
    fingertip_mm: Annotated[float, Field(ge=0.0, le=40.0)] = 0.0
    """Thickness of the sensor and its mount on each finger; `slipguard ctl fingertips` measures it."""

    @field_validator("port", "urcap")
    @classmethod
    def _is_an_address(cls, value: str | None, info: ValidationInfo) -> str | None:
        if value is not None and (info.field_name == "urcap" or is_tcp(value)):
            host_and_port(value)
        return value

    @model_validator(mode="after")
    def _has_one_connection(self) -> RobotiqSettings:
        if (self.port is None) == (self.urcap is None):
            found = "neither port nor urcap is set" if self.port is None else "port and urcap are both set"
            raise ValueError(
                f'{found}; set one: port = "/dev/serial/by-id/NAME" (USB adapter), port = "socket://ROBOT:54321" '
                '(RS-485 forwarder) or urcap = "ROBOT:63352" (Robotiq\'s URCap)'
            )
        return self

    @model_validator(mode="after")
    def _leaves_an_opening(self) -> RobotiqSettings:
        most_mm = (MODELS[self.model].stroke_mm - OPENING_MIN_MM) / 2.0
        if self.fingertip_mm > most_mm:
            problem = f"fingertip_mm = {self.fingertip_mm:g} leaves no opening on a {self.model}"
            raise ValueError(f"{problem}: it must be at most {most_mm:g}")
        return self


def check_fingertips(model: RobotiqModel) -> CheckResult:
    """Check whether the thickness of the fingertip sensors is configured."""
    if model.fingertip_mm == 0.0:
        observed = "fingertip_mm = 0: with sensors on the fingers, gel on gel looks like a held object"
        return note("fingertips", observed, "measure it with `slipguard ctl fingertips`")
    limit = "closed on nothing, they must be 1 mm apart"
    return ok("fingertips", f"{model.fingertip_mm:g} mm each; the gels open to {model.opening_mm:.0f} mm; {limit}")


def make_transport(name: str, settings: RobotiqSettings) -> GripperTransport:
    """Return the transport that the settings name; nothing is opened."""
    timeout_s = settings.timeout_ms / 1000.0
    if settings.urcap is not None:
        return UrcapConnection(name, settings.urcap, settings.slave_id, timeout_s)
    return ModbusConnection(name, settings.port or "", settings.slave_id, timeout_s)


class RobotiqGripper(Gripper):
    """A 2F-85, 2F-140 or Hand-E."""

    Settings = RobotiqSettings

    def __init__(self, settings: RobotiqSettings, context: DriverContext) -> None:
        self._name = context.name
        self._model = replace(MODELS[settings.model], fingertip_mm=settings.fingertip_mm)
        self._approach_speed = round(settings.approach_speed * 255)
        self._transport = make_transport(context.name, settings)
        self._one_command = asyncio.Lock()
        self._running: set[asyncio.Task[Any]] = set()
        self._closing_down = False
        self._applied: int | None = None
        """Force count of the grip; None if the fingers are open, or if another program closed them."""
        self._jaws = ObjectDetection(self._model, self._transport.settle_s)
        self._activating = False
        """Whether an activation moves the fingers, or may do so unseen."""
        self._activation_sent_s = -math.inf
        self._silent_since_s = math.inf
        """Since when the gripper has answered no request for its status."""
        self._silent_calls = 0
        """How many calls of `state` in a row it has not answered."""

    @property
    def force_limits_n(self) -> tuple[float, float]:
        """Return the force range of the model."""
        return self._model.force_min_n, self._model.force_max_n

    @property
    def force_latency_s(self) -> float | None:
        """Return the time from a request to tighten to the first change of the force; None before `open()`."""
        return self._transport.force_latency_s

    async def open(self) -> None:
        """Connect and read the status. A gripper that is not activated stays so until `activate`."""
        self._closing_down, self._silent_since_s, self._silent_calls = False, math.inf, 0
        is_new = not self._transport.connected
        if is_new:
            self._forget_grip()  # another program may have changed it meanwhile
            try:
                await self._transport.connect()
            except DeviceError as error:
                raise self._with_activation(error) from None
        try:
            if is_new:
                await self._complete(self._transport.measure())
            await self._complete(self._status(self._deadline_s()))
        except DeviceError:
            self._transport.close()
            raise

    async def state(self) -> GripperState:
        """Read the status now. Raises DeviceLost if the gripper has answered nothing for `SILENT_S` and two calls."""
        loop = asyncio.get_running_loop()
        self._silent_since_s = min(self._silent_since_s, loop.time())
        try:
            status = await self._complete(self._status(self._deadline_s()))
        except DeviceTimeout as error:
            self._silent_calls += 1
            silent_max_s = max(SILENT_S, 2.0 * self._call_max_s)
            if self._silent_calls < SILENT_CALLS or loop.time() - self._silent_since_s < silent_max_s:
                raise
            self._transport.close()
            raise DeviceLost(str(error)) from None
        return GripperState(
            active=status.ready,
            moving=self._jaws.moving or self._activating or status.releasing,
            holding=self._jaws.holding,
            closed_on_nothing=self._jaws.closed_on_nothing,
            width_mm=registers.count_to_width(status.position, self._model),
            force_n=self._force_n(status),
            fault=status.fault,
            measured_at_s=asyncio.get_running_loop().time(),
            force_known=self._applied is not None or not self._jaws.holding,
            auto_released=status.auto_released,
        )

    async def hold(self, force_n: float) -> float:
        """Close with `force_n` or tighten to it; return the force applied."""
        force = registers.force_to_count(force_n, self._model)
        return await self._complete(self._hold(force, self._deadline_s()))

    async def move(self, width_mm: float, force_n: float) -> float:
        """Move the fingers without an object; return the width commanded.

        Refused while an object is held, and outward while the fingers close: they may just have reached an object.
        """
        position = registers.width_to_count(width_mm, self._model)
        force = registers.force_to_count(force_n, self._model)
        return await self._complete(self._move(position, force, self._deadline_s()))

    async def halt(self) -> None:
        """Stop the fingers where they are; an activation is not interrupted."""
        await self._complete(self._halt(self._deadline_s()))

    async def release(self, width_mm: float) -> None:
        """Open. A gripper that is not active, or faulty, opens slowly and fully by an automatic release."""
        await self._complete(self._release(registers.width_to_count(width_mm, self._model), self._deadline_s()))

    async def activate(self) -> None:
        """Activate an empty gripper and wait until it is active; the fingers open and close fully."""
        await self._complete(self._activate(self._deadline_s()))

    async def close(self) -> None:
        """Disconnect; the grip stays. An activation continues by itself."""
        self._closing_down = True
        if self._running:
            await asyncio.wait(self._running)
        self._transport.close()
        await self._transport.closed()

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """Check settings and wiring for `slipguard doctor`, without connecting."""
        for result in self._transport.diagnose():
            yield result
        yield check_fingertips(self._model)

    @property
    def _call_max_s(self) -> float:
        """Longest time of a call that activates nothing."""
        return CALL_TIMEOUTS * self._transport.timeout_s + 2.0 * self._transport.settle_s

    def _deadline_s(self) -> float:
        """Return when a call that begins now must have ended."""
        return asyncio.get_running_loop().time() + self._call_max_s

    @contextlib.asynccontextmanager
    async def _exclusive(self, deadline_s: float) -> AsyncIterator[None]:
        """Execute one command at a time."""
        try:
            async with asyncio.timeout_at(deadline_s):
                await self._one_command.acquire()
        except TimeoutError:
            raise DeviceTimeout(f"{self._name}: busy with an earlier command; try again") from None
        try:
            yield
        finally:
            self._one_command.release()

    async def _complete(self, command: Coroutine[Any, Any, T]) -> T:
        """Complete a command even if the caller is cancelled: an unread response would put the line out of sync."""
        task = asyncio.create_task(command, name=f"{self._name}: command")
        self._running.add(task)
        task.add_done_callback(self._on_complete)
        try:
            return await asyncio.shield(task)
        except DeviceError as error:
            raise self._with_activation(error) from None

    def _with_activation(self, error: DeviceError) -> DeviceError:
        """Return the error, which says so if the fingers may move although the command has failed."""
        return type(error)(f"{error}; {MAY_STILL_MOVE}") if self._activating else error

    def _on_complete(self, task: asyncio.Task[Any]) -> None:
        self._running.discard(task)
        if not task.cancelled():
            task.exception()  # mark it as read: the caller may have been cancelled

    async def _hold(self, force: int, deadline_s: float) -> float:
        async with self._exclusive(deadline_s):
            status = await self._ready_status(deadline_s)
            closing = status.going and status.position_echo >= self._model.goal_count
            holding, moving, goal = self._jaws.holding, self._jaws.moving, self._model.goal_count
            goal = max(goal, status.position)  # the limit may have been set since: a grip never opens
            gripping = holding or (closing and moving)
            if gripping and self._applied is not None:
                if force <= self._applied and closing:
                    return registers.count_to_force(self._applied, self._model)
                force = max(force, self._applied)
            if not holding or moving:
                self._applied = None  # there was no grip, or the stop below interrupts it
            speed = registers.FULL_SPEED if self._jaws.gripped_at is not None else self._approach_speed
            if holding or closing:
                await self._write(deadline_s, go=False, position=goal, speed=speed, force=force)
                await self._expect(deadline_s, goal, going=False)
                await asyncio.sleep(self._transport.settle_s)
            await self._write(deadline_s, go=True, position=goal, speed=speed, force=force)
            await self._expect(deadline_s, goal, going=True)
            self._applied = force
            return registers.count_to_force(force, self._model)

    async def _move(self, position: int, force: int, deadline_s: float) -> float:
        async with self._exclusive(deadline_s):
            status = await self._ready_status(deadline_s)
            if self._jaws.holding:
                raise CommandRefused(f"{self._name}: an object is held and would fall; support it, then use release")
            closing = self._jaws.moving and status.position_echo > status.position
            if closing and position < status.position_echo:
                raise CommandRefused(
                    f"{self._name}: the fingers are closing and may hold an object; try again when they are at rest"
                )
            self._applied = None
            await self._write(deadline_s, go=True, position=position, speed=self._approach_speed, force=force)
            await self._expect(deadline_s, position, going=True)
            self._applied = force
            return registers.count_to_width(position, self._model)

    async def _halt(self, deadline_s: float) -> None:
        """Clear rGTO and keep the goal, so that the status still shows that the fingers were closing."""
        async with self._exclusive(deadline_s):
            status = await self._status(deadline_s)
            if not self._jaws.moving:
                return
            position, self._applied = status.position_echo, None
            await self._write(deadline_s, go=False, position=position, speed=self._approach_speed, force=0)
            await self._expect(deadline_s, position, going=False)

    async def _release(self, position: int, deadline_s: float) -> None:
        async with self._exclusive(deadline_s):
            status = await self._status(deadline_s)
            if not status.ready or status.fault is not None:
                await self._release_automatically(status, deadline_s)
                return
            position = max(0, min(position, status.position - RELEASE_COUNTS_MIN))
            self._applied = None
            await self._write(deadline_s, go=True, position=position, speed=registers.FULL_SPEED, force=0)
            await self._expect(deadline_s, position, going=True)

    async def _release_automatically(self, status: RobotiqStatus, deadline_s: float) -> None:
        """Start an automatic release, unless one runs or has ended. Never sets rACT, which would activate."""
        if status.releasing or status.auto_released:
            return
        if not status.activated:
            raise CommandRefused(f"{self._name}: {IN_RESET}")
        await self._transport.write_command(AUTO_RELEASE, deadline_s)
        async for status in self._echoes(deadline_s):
            if status.releasing or status.auto_released:
                return
        raise DeviceTimeout(
            f"{self._name}: the gripper does not begin its automatic release ({status.fault or 'no fault reported'}); "
            "check its power"
        )

    async def _activate(self, deadline_s: float) -> None:
        async with self._exclusive(deadline_s):
            status = await self._status(deadline_s)
            if status.ready and status.fault is None:
                raise CommandRefused(f"{self._name}: the gripper is already activated")
            if self._jaws.holding:
                raise CommandRefused(f"{self._name}: an object is held and would fall; support it, then use release")
            await self._reset_and_activate(deadline_s)

    async def _reset_and_activate(self, deadline_s: float) -> None:
        await self._transport.write_command(RESET, deadline_s)
        await self._expect(deadline_s, 0, going=False, activated=False)
        await asyncio.sleep(self._transport.settle_s)
        self._activating, self._activation_sent_s = True, asyncio.get_running_loop().time()
        await self._write(deadline_s, go=False, position=0, speed=0, force=0)
        status = await self._expect(deadline_s, 0, going=False)
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + ACTIVATION_TIMEOUT_S
        while self._activating and loop.time() < ends_s and not self._closing_down:
            await asyncio.sleep(ACTIVATION_POLL_S)
            with contextlib.suppress(DeviceTimeout):  # the activation continues without communication
                status = await self._status(self._deadline_s())
        if status.ready and status.fault is None:
            return
        if self._closing_down:
            raise DeviceLost(f"{self._name}: disconnected during the activation of the gripper; repeat the command")
        fault = status.fault or "no fault reported"
        if not self._activating:
            raise DeviceTimeout(
                f"{self._name}: the gripper lost power or was reset during its activation ({fault}); repeat the command"
            )
        raise DeviceTimeout(
            f"{self._name}: not activated after {ACTIVATION_TIMEOUT_S:.0f} s ({fault}); switch its 24 V off before you "
            "remove what blocks the fingers"
        )

    async def _status(self, deadline_s: float) -> RobotiqStatus:
        status = await self._transport.read_status(deadline_s)
        if not status.ready:
            self._forget_grip()  # it lost power, or another program has reset it
        now_s, self._silent_since_s, self._silent_calls = asyncio.get_running_loop().time(), math.inf, 0
        if status.activating or now_s > self._activation_sent_s + ACTIVATION_ECHO_S + self._transport.settle_s:
            self._activating = status.activating
        self._jaws.update(status, now_s)
        return status

    def _forget_grip(self) -> None:
        self._applied = None
        self._jaws.forget()

    async def _ready_status(self, deadline_s: float) -> RobotiqStatus:
        status = await self._status(deadline_s)
        if status.fault is not None:
            raise DeviceError(f"{self._name}: the gripper reports a fault: {status.fault}; {ACTIVATION_HINT}")
        if not status.ready:
            raise CommandRefused(f"{self._name}: the gripper is not activated; {ACTIVATION_HINT}")
        return status

    async def _write(self, deadline_s: float, *, go: bool, position: int, speed: int, force: int) -> None:
        command = RobotiqCommand(go=go, position=position, speed=speed, force=force)
        await self._transport.write_command(command, deadline_s)

    async def _echoes(self, deadline_s: float) -> AsyncIterator[RobotiqStatus]:
        """Yield the statuses in which a command must become visible."""
        loop = asyncio.get_running_loop()
        ends_s, reads = loop.time() + ECHO_SETTLES * self._transport.settle_s, 0
        while reads < ECHO_READS or loop.time() < ends_s:
            reads += 1
            yield await self._status(deadline_s)

    async def _expect(self, deadline_s: float, position: int, *, going: bool, activated: bool = True) -> RobotiqStatus:
        """Wait until the status shows that the gripper has accepted a command."""
        async for status in self._echoes(deadline_s):
            if (status.position_echo, status.going, status.activated) == (position, going, activated):
                return status
        seen, wanted = ("going" if on else "stopped" for on in (status.going, going))
        raise DeviceTimeout(
            f"{self._name}: the gripper does not accept commands: it reports {seen}, position {status.position_echo}, "
            f"instead of {wanted}, position {position}; check whether another program commands it"
        )

    def _force_n(self, status: RobotiqStatus) -> float:
        """Return the force applied; a completed grip has at least the lowest force."""
        if self._applied is not None and (self._jaws.holding or status.position_echo >= self._model.goal_count):
            return registers.count_to_force(self._applied, self._model)
        return self._model.force_min_n if self._jaws.gripped_at is not None else 0.0
