"""Driver `text_gripper`: a gripper on a TCP socket that understands lines of text.

state                -> ok WIDTH_MM FORCE_N MOVING HOLDING CLOSED_ON_NOTHING
grip FORCE_N         -> ok APPLIED_N    close; while holding, only ever tighten
move WIDTH_MM FORCE_N, open WIDTH_MM, halt -> ok
"""

import asyncio
import math

from pydantic import BaseModel, ConfigDict

from example_drivers.text_link import TextLink
from slipguard.devices import DriverContext, Gripper, GripperState
from slipguard.errors import CommandRefused

FORCE_MIN_N, FORCE_MAX_N, STROKE_MM = 10.0, 100.0, 85.0


class TextGripper(Gripper):
    class Settings(BaseModel):  # the table [gripper.text_gripper] of config.toml
        model_config = ConfigDict(frozen=True, extra="forbid")
        host: str
        port: int = 5001
        timeout_ms: float = 200.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:  # opens nothing
        self._name = context.name
        self._link = TextLink(context.name, settings.host, settings.port, settings.timeout_ms)
        self._one_command = asyncio.Lock()  # no other command between the check and the motion
        self._goal_mm = 0.0  # after a restart the fingers may be closing

    @property
    def force_limits_n(self) -> tuple[float, float]:
        return FORCE_MIN_N, FORCE_MAX_N

    async def open(self) -> None:  # moves nothing: an object may be held
        await self._link.open()

    async def state(self) -> GripperState:
        width_mm, force_n, moving, holding, on_nothing = map(float, await self._link.ask("state"))
        return GripperState(
            active=True, moving=bool(moving), holding=bool(holding), closed_on_nothing=bool(on_nothing),
            width_mm=width_mm, force_n=force_n, fault=None, measured_at_s=asyncio.get_running_loop().time(),
        )  # fmt: skip

    async def hold(self, force_n: float) -> float:
        applied_n = min(max(self._checked(force_n), FORCE_MIN_N), FORCE_MAX_N)
        async with self._one_command:
            self._goal_mm = 0.0
            return float((await self._link.ask(f"grip {applied_n}"))[0])

    async def move(self, width_mm: float, force_n: float) -> float:
        goal_mm, force_n = min(self._checked(width_mm), STROKE_MM), self._checked(force_n)
        async with self._one_command:
            state = await self.state()
            if state.holding:
                raise CommandRefused(f"{self._name}: an object is held and would fall; support it, then use release")
            if state.moving and self._goal_mm < min(goal_mm, state.width_mm):
                raise CommandRefused(f"{self._name}: the fingers are closing; wait until they stop")
            self._goal_mm = goal_mm
            await self._link.ask(f"move {goal_mm} {force_n}")
        return goal_mm

    async def halt(self) -> None:
        await self._link.ask("halt")

    async def release(self, width_mm: float) -> None:
        async with self._one_command:
            self._goal_mm = min(max(self._checked(width_mm), (await self.state()).width_mm + 5.0), STROKE_MM)
            await self._link.ask(f"open {self._goal_mm}")

    async def close(self) -> None:  # the grip stays
        self._link.close()

    def _checked(self, value: float) -> float:
        if not (math.isfinite(value) and value >= 0.0):
            raise CommandRefused(f"{self._name}: {value} is not valid; it must be a number of at least 0")
        return value
