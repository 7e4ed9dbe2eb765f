"""Driver `text_arm`: an arm on a TCP socket that understands lines of text.

    state                -> ok HEIGHT_MM SPEED_MM_S MOVING PROTECTIVE_STOP EMERGENCY_STOP
    lift BY_MM SPEED_MM_S, stop, pause -> ok    a new lift replaces the motion; pause stops another program

The controller stops the arm by itself if no request arrives for 0.5 s: slipguard reads the state 40 times per second.
"""

import asyncio
import contextlib
import math

from pydantic import BaseModel, ConfigDict

from example_drivers.text_link import TextLink
from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.errors import CommandRefused, DeviceError

SPEED_MAX_MM_S = 250.0


class TextArm(Arm):
    class Settings(BaseModel):  # the table [arm.text_arm] of config.toml
        model_config = ConfigDict(frozen=True, extra="forbid")
        host: str
        port: int = 5002
        timeout_ms: float = 200.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:  # opens nothing
        self._name, self._guard_mode = context.name, context.mode == "guard"
        self._link = TextLink(context.name, settings.host, settings.port, settings.timeout_ms)
        self._zero_mm: float | None = None  # heights are relative to where the arm is opened

    async def open(self) -> None:  # moves nothing
        await self._link.open()
        if self._zero_mm is None:
            self._zero_mm = (await self.state()).height_mm

    async def state(self) -> ArmState:
        height_mm, speed_mm_s, moving, protective, emergency = map(float, await self._link.ask("state"))
        return ArmState(
            height_mm=height_mm - (self._zero_mm or 0.0), speed_mm_s=speed_mm_s, moving=bool(moving),
            protective_stop=bool(protective), emergency_stop=bool(emergency),
            measured_at_s=asyncio.get_running_loop().time(),
        )  # fmt: skip

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:  # does not wait for the end of the motion
        if self._guard_mode:
            raise CommandRefused(f"{self._name}: in guard mode another program moves the arm")
        if not (math.isfinite(height_mm) and math.isfinite(speed_mm_s) and speed_mm_s > 0.0):
            raise CommandRefused(f"{self._name}: a lift by {height_mm} mm at {speed_mm_s} mm/s is not valid")
        state = await self.state()
        if state.protective_stop or state.emergency_stop:
            raise CommandRefused(f"{self._name}: a safety stop is active; clear it at the controller")
        speed_mm_s = min(speed_mm_s, SPEED_MAX_MM_S)
        await self._link.ask(f"lift {height_mm} {speed_mm_s}")
        return speed_mm_s

    async def stop(self) -> None:
        await self._link.ask("pause" if self._guard_mode else "stop")

    async def close(self) -> None:  # stops only what this driver has moved
        if self._link.connected and not self._guard_mode:
            with contextlib.suppress(DeviceError, CommandRefused):
                await self.stop()
        self._link.close()
        self._zero_mm = None
