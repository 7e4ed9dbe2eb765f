"""A Robotiq 2F over Modbus RTU: intents of the port turned into register writes, each verified.

Two habits of the hardware decide everything here. Activating it (rACT from 0 to 1) moves the fingers all the way, so
an object falls: that happens in `release` and nowhere else. And the force register acts only while the fingers move,
so tightening is stop, then go, and the stop must have been seen: within one cycle of the gripper the two would cancel
out. The screw holds the grip meanwhile. Force can rise, never fall, until the fingers open.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from typing import Annotated, Any, Literal, TypeVar

import structlog
from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import DriverContext, Gripper, GripperState
from slipguard.diagnosis import CheckResult
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import registers, serial_port
from slipguard_drivers.robotiq.diagnostics import check_serial_port
from slipguard_drivers.robotiq.modbus import ModbusConnection
from slipguard_drivers.robotiq.registers import CLOSED_COUNT, MODELS, FingerMotion, RobotiqStatus

T = TypeVar("T")
log = structlog.get_logger()

CALL_TIMEOUTS = 8
"""No call takes longer than so many time-outs of one answer (0.4 s), but one that activates."""
ECHO_TRIES = 5
"""Status reads until a command must be seen in the status: 5 x 5 ms, the gripper's cycle being 5 ms."""
GIVE_COUNTS = 3
"""Fingers that press an object move by no more than this while the force rises (1.1 mm on a 2F-85)."""
LETTING_GO_COUNTS = 15
"""A release opens at least this far (5.6 mm on a 2F-85), whatever width was asked for."""
ACTIVATION_S = 10.0
"""Opening and closing fully takes a 2F-85 about 3 s."""
ACTIVATION_POLL_S = 0.05


class RobotiqGripper(Gripper):
    """A 2F-85 or 2F-140 on a serial port of its own."""

    class Settings(BaseModel):
        """port: best a name under /dev/serial/by-id, which stays with the adapter."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        port: Annotated[str, Field(min_length=1)]
        model: Literal["2F-85", "2F-140"] = "2F-85"
        slave_id: Annotated[int, Field(ge=1, le=247)] = registers.SLAVE_ID
        timeout_ms: Annotated[float, Field(ge=20.0, le=1000.0)] = 50.0
        approach_speed: Annotated[float, Field(ge=0.0, le=1.0)] = 0.25
        """Share of the full speed (150 mm/s on a 2F-85) at which the fingers meet an object."""

    def __init__(self, settings: Settings, context: DriverContext) -> None:
        self._name = context.name
        self._port = settings.port
        self._model = MODELS[settings.model]
        self._approach = round(settings.approach_speed * 255)
        self._line = ModbusConnection(
            context.name, settings.port, settings.slave_id, settings.timeout_ms / 1000.0, registers.INPUT_ADDRESS
        )
        self._call_s = CALL_TIMEOUTS * settings.timeout_ms / 1000.0
        self._command = asyncio.Lock()
        self._under_way: set[asyncio.Task[Any]] = set()
        self._closing_down = False
        self._applied: int | None = None
        """Force count of the grip; None while fingers are open, or where another program closed them."""
        self._gripped_at: int | None = None
        """Position at which they were seen to hold something; None when they no longer do."""

    @property
    def force_limits_n(self) -> tuple[float, float]:
        """Those of the model."""
        return self._model.force_min_n, self._model.force_max_n

    async def open(self) -> None:
        """Connect and look. A gripper that is not activated is left so: `release` activates it."""
        self._closing_down = False
        if not self._line.connected:
            self._applied = self._gripped_at = None  # whoever had the gripper meanwhile may have gripped anew
            await self._line.connect()
            if slow := serial_port.slow_adapter(self._port):
                log.warning(f"{self._name}: {slow}")
        try:
            await self._finish(self._status(self._by_s()))
        except DeviceError:
            self._line.close()
            raise

    async def state(self) -> GripperState:
        """Ask the gripper now."""
        status = await self._finish(self._status(self._by_s()))
        return GripperState(
            active=status.ready,
            moving=status.going and status.motion is FingerMotion.MOVING,
            holding=self._holds(status),
            closed_on_nothing=status.closed_on_nothing,
            width_mm=registers.count_to_width(status.position, self._model),
            force_n=self._force_n(status),
            fault=status.fault,
            measured_at_s=asyncio.get_running_loop().time(),
        )

    async def hold(self, force_n: float) -> float:
        """Close with `force_n` or tighten to it; return the force applied."""
        return await self._finish(self._hold(registers.force_to_count(force_n, self._model), self._by_s()))

    async def move(self, width_mm: float, force_n: float) -> float:
        """Move empty-handed; return the width commanded.

        Refused while something is held, and outwards while the fingers are closing: they may just have met something.
        """
        position = registers.width_to_count(width_mm, self._model)
        return await self._finish(self._move(position, registers.force_to_count(force_n, self._model), self._by_s()))

    async def halt(self) -> None:
        """Stop the fingers where they are; a gripper that is being activated is let finish."""
        await self._finish(self._halt(self._by_s()))

    async def release(self, width_mm: float) -> None:
        """Open, activating the gripper first where it needs that; the fingers then move all the way."""
        await self._finish(self._release(registers.width_to_count(width_mm, self._model), self._by_s()))

    async def close(self) -> None:
        """Disconnect; the grip stays. A gripper that is being activated goes on by itself."""
        self._closing_down = True
        if self._under_way:
            await asyncio.wait(self._under_way)
        self._line.close()

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """For the doctor: the port from outside."""
        for result in check_serial_port(self._port):
            yield result

    def _by_s(self) -> float:
        """When a call that begins now must have ended."""
        return asyncio.get_running_loop().time() + self._call_s

    @contextlib.asynccontextmanager
    async def _in_turn(self, by_s: float) -> AsyncIterator[None]:
        """One command at a time."""
        try:
            async with asyncio.timeout_at(by_s):
                await self._command.acquire()
        except TimeoutError:
            raise DeviceTimeout(f"{self._name}: busy with an earlier command; ask again") from None
        try:
            yield
        finally:
            self._command.release()

    async def _finish(self, work: Coroutine[Any, Any, T]) -> T:
        """Do `work` to its end even when the caller is cancelled: an answer nobody waits for confuses the line."""
        task = asyncio.create_task(work, name=f"{self._name}: command")
        self._under_way.add(task)
        task.add_done_callback(self._done)
        return await asyncio.shield(task)

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._under_way.discard(task)
        if not task.cancelled():
            task.exception()  # the caller may have been cancelled; then nobody else asks

    async def _hold(self, force: int, by_s: float) -> float:
        async with self._in_turn(by_s):
            status = await self._ready_status(by_s)
            closing = status.going and status.position_echo == CLOSED_COUNT
            gripping = status.may_hold or (closing and status.motion is FingerMotion.MOVING)
            if gripping and self._applied is not None:
                if force <= self._applied and closing:
                    return registers.count_to_force(self._applied, self._model)
                force = max(force, self._applied)
            if not status.may_hold or status.motion is FingerMotion.MOVING:
                self._applied = None  # there was no grip, or it is stopped half-way
            speed = registers.FULL_SPEED if self._gripped_at is not None else self._approach
            if status.may_hold or closing:
                await self._write(by_s, go=False, position=CLOSED_COUNT, speed=speed, force=force)
                await self._expect(by_s, CLOSED_COUNT, going=False)
            await self._write(by_s, go=True, position=CLOSED_COUNT, speed=speed, force=force)
            await self._expect(by_s, CLOSED_COUNT, going=True)
            self._applied = force
            return registers.count_to_force(force, self._model)

    async def _move(self, position: int, force: int, by_s: float) -> float:
        async with self._in_turn(by_s):
            status = await self._ready_status(by_s)
            if self._holds(status):
                raise CommandRefused(
                    f"{self._name}: an object is held and a move would let it go; use release for that"
                )
            if status.closing and position < status.position_echo:
                raise CommandRefused(
                    f"{self._name}: the fingers are closing and may have met something; ask again when they are at rest"
                )
            self._applied = None
            await self._write(by_s, go=True, position=position, speed=self._approach, force=force)
            await self._expect(by_s, position, going=True)
            self._applied = force
            return registers.count_to_width(position, self._model)

    async def _halt(self, by_s: float) -> None:
        """rGTO = 0, the goal as it is: what was closing is told to have been."""
        async with self._in_turn(by_s):
            status = await self._status(by_s)
            if not (status.ready and status.going and status.motion is FingerMotion.MOVING):
                return
            position, self._applied = status.position_echo, None
            await self._write(by_s, go=False, position=position, speed=self._approach, force=0)
            await self._expect(by_s, position, going=False)

    async def _release(self, position: int, by_s: float) -> None:
        async with self._in_turn(by_s):
            status = await self._status(by_s)
            if not status.ready or status.fault is not None:
                status = await self._activate(by_s)
                by_s = self._by_s()
            position = max(0, min(position, status.position - LETTING_GO_COUNTS))
            self._applied = self._gripped_at = None
            await self._write(by_s, go=True, position=position, speed=registers.FULL_SPEED, force=0)
            await self._expect(by_s, position, going=True)

    async def _activate(self, by_s: float) -> RobotiqStatus:
        """Reset and activate: the fingers open and close fully. Only an explicit release may ask for that."""
        await self._line.write(registers.OUTPUT_ADDRESS, [0, 0, 0], by_s)
        await self._expect(by_s, 0, going=False, activated=False)
        await self._write(by_s, go=False, position=0, speed=0, force=0)
        status = await self._expect(by_s, 0, going=False)
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + ACTIVATION_S
        while status.activated and loop.time() < deadline_s and not self._closing_down:
            if status.ready and status.fault is None:
                return status
            await asyncio.sleep(ACTIVATION_POLL_S)
            with contextlib.suppress(DeviceTimeout):  # it goes on activating, whether it is heard or not
                status = await self._status(self._by_s())
        if self._closing_down:
            raise DeviceLost(f"{self._name}: disconnected while the gripper was being activated; release again")
        if not status.activated:
            raise DeviceTimeout(f"{self._name}: the gripper was reset while it was being activated; release again")
        raise DeviceTimeout(
            f"{self._name}: not activated after {ACTIVATION_S:.0f} s ({status.fault or 'no fault reported'}); "
            "check what is in the fingers' way"
        )

    async def _status(self, by_s: float) -> RobotiqStatus:
        status = registers.decode(await self._line.read(registers.INPUT_ADDRESS, registers.REGISTERS, by_s))
        if not status.ready:
            self._applied = self._gripped_at = None  # it has been without power, or another program has reset it
        elif status.motion is FingerMotion.STOPPED_CLOSING:
            self._gripped_at = status.position
        elif not self._holds(status):
            self._gripped_at = None
        return status

    async def _ready_status(self, by_s: float) -> RobotiqStatus:
        status = await self._status(by_s)
        if status.fault is not None:
            raise DeviceError(f"{self._name}: the gripper reports a fault: {status.fault}; release clears it")
        if not status.ready:
            raise CommandRefused(
                f"{self._name}: the gripper is not activated; release does that: its fingers open and close fully, "
                "so take away what is between them"
            )
        return status

    async def _write(self, by_s: float, *, go: bool, position: int, speed: int, force: int) -> None:
        values = registers.encode(activate=True, go=go, position=position, speed=speed, force=force)
        await self._line.write(registers.OUTPUT_ADDRESS, values, by_s)

    async def _expect(self, by_s: float, position: int, *, going: bool, activated: bool = True) -> RobotiqStatus:
        """Wait until the gripper says that it has taken a command over."""
        for _ in range(ECHO_TRIES):
            status = await self._status(by_s)
            if (status.position_echo, status.going, status.activated) == (position, going, activated):
                return status
        raise DeviceTimeout(
            f"{self._name}: the gripper does not take commands: it is {'going' if status.going else 'stopped'}, its "
            f"position echo {status.position_echo} instead of {position}; is another program commanding it?"
        )

    def _holds(self, status: RobotiqStatus) -> bool:
        """Whether something is held; also while the force on it rises."""
        if status.may_hold or self._gripped_at is None:
            return status.may_hold
        return status.closing and abs(status.position - self._gripped_at) <= GIVE_COUNTS

    def _force_n(self, status: RobotiqStatus) -> float:
        """The force applied. A finished grip has at least the lowest force there is, one stopped half-way has not."""
        if self._applied is not None and (self._holds(status) or status.position_echo == CLOSED_COUNT):
            return registers.count_to_force(self._applied, self._model)
        return self._model.force_min_n if status.motion is FingerMotion.STOPPED_CLOSING and status.ready else 0.0
