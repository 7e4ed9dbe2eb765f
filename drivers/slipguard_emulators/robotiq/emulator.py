"""A Robotiq 2F on a pseudo terminal: Modbus RTU at the pace of a real wire, with faults on demand."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from slipguard.cancellation import TimerGroup
from slipguard.emulator import Report
from slipguard.errors import CommandRefused
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand
from slipguard_emulators.robotiq.jaws import JawsPlant, SimpleJaws
from slipguard_emulators.robotiq.modbus_frames import ModbusRequest, answer, crc16, frame_bytes, parse
from slipguard_emulators.robotiq.pseudo_terminal import EmulatedPort
from slipguard_emulators.robotiq.registers import FIGURES, RACT, ActivationStage, GripperRegisters

BITS_PER_BYTE = 10
FORGET_S = 0.02
"""Bytes that are no whole request are forgotten after a silence; the standard says 3.5 characters."""
FAULTS = {
    "silence": "a request is obeyed, but not answered",
    "deaf": "a request is not heard at all",
    "late": "an answer, and all behind it, comes late_ms later",
    "bad_crc": "an answer has a wrong checksum",
    "half": "only the first half of an answer comes",
    "garbage": "noise comes before an answer",
    "noise": "noise comes instead of an answer",
    "split": "an answer comes in two pieces",
    "double": "an answer comes twice, back to back",
    "wrong_function": "an answer has another function code; its checksum is right",
    "wrong_length": "an answer has a register less or more; its checksum is right",
    "wrong_echo": "an answer to a write tells another address; its checksum is right",
    "wrong_slave": "an answer comes from another slave; its checksum is right",
    "ignore": "a write is acknowledged, but not carried out",
    "freeze": "the controller hangs for outage_ms: hears nothing, goes on afterwards",
    "power": "the gripper loses power for outage_ms: everything but the screw is reset",
    "unplug": "the serial port vanishes for outage_ms",
}


class RobotiqEmulator(ControlledEmulator):
    """Emulate a 2F gripper on a serial port: registers, moving jaws, an object, faults on demand.

    Control words of its own: `object MM|none`, `gflt CODE`.

    Example: `slipguard emulate robotiq --link /tmp/ttyGR --object-width-mm 40 --fault late:0.01`
    """

    class Settings(BaseModel):
        """The command's options."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        link: Annotated[Path | None, Field(description="Name of the port; default: the pseudo terminal's own.")] = None
        model: Annotated[Literal["2F-85", "2F-140"], Field(description="Which gripper.")] = "2F-85"
        slave_id: Annotated[int, Field(ge=1, le=247, description="Its Modbus address.")] = 9
        object_width_mm: Annotated[
            float | None, Field(gt=0.0, lt=140.0, description="Width of what is between the jaws; default: nothing.")
        ] = None
        activated: Annotated[bool, Field(description="Switched on and activated already.")] = False
        baud: Annotated[int, Field(ge=0, description="Pace of the wire in bits a second; 0: as fast as it goes.")] = (
            115200
        )
        response_ms: Annotated[float, Field(ge=0.0, le=1000.0, description="From a request to its answer.")] = 1.0
        latency_timer_ms: Annotated[
            float, Field(ge=0.0, le=255.0, description="How long the adapter keeps an answer; unset FTDI ones: 16.")
        ] = 1.0
        late_ms: Annotated[float, Field(ge=0.0, le=60000.0, description="How late the fault `late` is.")] = 120.0
        outage_ms: Annotated[
            float, Field(ge=0.0, le=60000.0, description="How long `freeze`, `power` and `unplug` last.")
        ] = 300.0
        quick: Annotated[float, Field(gt=0.0, le=100.0, description="Jaws so many times faster than real ones.")] = 1.0
        seed: Annotated[int, Field(ge=0, description="Seed of all that is random.")] = 0

    def __init__(self, settings: Settings, report: Report | None = None, jaws: JawsPlant | None = None) -> None:
        """jaws: the mechanics of a world of one's own; left out: plain jaws with at most one object."""
        super().__init__(FAULTS, settings.seed, report)
        self.settings = settings
        figures = FIGURES[settings.model]
        self.jaws = jaws if jaws is not None else SimpleJaws(figures.stroke_mm, settings.object_width_mm)
        self.registers = GripperRegisters(self.jaws, figures, self.note, settings.quick)
        self.requests = 0
        """Requests that were heard."""
        self._rng = random.Random(settings.seed + 1)
        self._port = EmulatedPort(settings.link, self._on_bytes)
        self._started = False
        self._buffer = b""
        self._last_byte_s = 0.0
        self._free_s = 0.0
        """When the last answer will have been sent; none overtakes another."""
        self._down_until_s = 0.0
        self._timers = TimerGroup()

    @property
    def address(self) -> str:
        """The port's path."""
        return self._port.path

    async def start(self) -> None:
        """Appear. Raises InputError where the link cannot be made."""
        if self.settings.activated:
            self.registers.outputs, self.registers.stage = [RACT << 8, 0, 0], ActivationStage.READY
        self._port.plug()
        self._started = True

    async def stop(self) -> None:
        """Vanish."""
        self._timers.cancel_all()
        self._started = False
        self._port.unplug()

    def state(self) -> dict[str, object]:
        """The truth now."""
        now_s = asyncio.get_running_loop().time()
        view = self.registers.tick(now_s)
        return {
            "stage": self.registers.stage.value,
            "width_mm": round(view.width_mm, 2),
            "force_n": round(view.force_n, 2),
            "moving": view.moving,
            "holds": view.holds,
            "activations": self.registers.activations,
            "outputs": " ".join(f"{word:04X}" for word in self.registers.outputs),
            "requests": self.requests,
            "plugged": self._port.plugged,
            "faults": self.faults.active,
        }

    def words(self) -> dict[str, EmulatorCommand]:
        """`object`, `gflt`."""
        return {
            "object": (self._object, "object MM|none: what is between the jaws"),
            "gflt": (self._gflt, "gflt CODE: the fault that the gripper reports, such as 0x0E; 0 for none"),
        }

    def fault_changed(self) -> None:
        """Unplug and power act at once where they were set until cleared."""
        if self.faults.lasts("unplug"):
            self._port.unplug()
        elif self._started and not self._port.plugged and self._down_until_s <= asyncio.get_running_loop().time():
            self._port.plug()
        if self.faults.lasts("power"):
            self.registers.lose_power(asyncio.get_running_loop().time())

    def _object(self, rest: list[str]) -> str:
        if not isinstance(self.jaws, SimpleJaws):
            raise CommandRefused("what is between the jaws is the world's business here")
        if rest != ["none"]:
            try:
                (width_mm,) = (float(word) for word in rest)
            except ValueError:
                raise CommandRefused("write `object MM` or `object none`") from None
            if not 0.0 < width_mm < self.jaws.stroke_mm:
                raise CommandRefused(f"{width_mm} mm is not between 0 and {self.jaws.stroke_mm:g} mm")
            self.jaws.object_mm = width_mm
            return f"an object of {width_mm:g} mm"
        self.jaws.object_mm = None
        return "nothing between the jaws"

    def _gflt(self, rest: list[str]) -> str:
        try:
            (code,) = (int(word, 0) for word in rest)
        except ValueError:
            raise CommandRefused("write `gflt CODE`, such as `gflt 0x0E`") from None
        if not 0 <= code <= 0x0F:
            raise CommandRefused(f"{code} is not a code of 0 to 0x0F")
        self.registers.fault = code
        return f"reports fault 0x{code:02X}"

    # The wire.

    def _on_bytes(self, data: bytes) -> None:
        now_s = asyncio.get_running_loop().time()
        if now_s - self._last_byte_s > FORGET_S:
            self._buffer = b""
        self._last_byte_s = now_s
        self._buffer += data
        while (size := frame_bytes(self._buffer)) is not None and len(self._buffer) >= size:
            frame, self._buffer = self._buffer[:size], self._buffer[size:]
            if size == 0:
                self._buffer = b""
                return
            arrived_s = now_s + self._on_the_wire_s(size)
            self._at(arrived_s, partial(self._hear, frame, arrived_s))

    def _hear(self, frame: bytes, arrived_s: float) -> None:
        """The last byte of a request has come in."""
        request = parse(frame)
        if request is None or request.slave != self.settings.slave_id or not request.makes_sense:
            return  # the manual: exception answers are not supported
        now_s = max(arrived_s, asyncio.get_running_loop().time())
        if self._is_down(now_s) or self._strikes("deaf"):
            return
        self.requests += 1
        if request.values and not self._strikes("ignore"):
            due_s = self.registers.write(now_s, request.write_at, request.values)
            self.note("write", registers=[f"{word:04X}" for word in request.values], last_byte_s=round(arrived_s, 6))
            self._at(due_s, lambda: self.registers.tick(asyncio.get_running_loop().time()))
        plain = answer(request, lambda: self.registers.read(now_s))
        self.registers.heard(now_s)
        if not self._strikes("silence"):
            self._send(request, plain, now_s)

    def _is_down(self, now_s: float) -> bool:
        """Whether freeze, power or unplug keeps it from hearing; each request is an opportunity to begin."""
        if now_s < self._down_until_s:
            return True
        begin = {name for name in ("freeze", "power", "unplug") if self._strikes(name)}
        if not begin:
            return False
        self._down_until_s = now_s + self.settings.outage_ms / 1000.0
        if "power" in begin and not self.faults.lasts("power"):
            self.registers.lose_power(now_s)
        if "unplug" in begin:
            self._port.unplug()
            self._at(self._down_until_s, self._plug_again)
        return True

    def _send(self, request: ModbusRequest, plain: bytes, now_s: float) -> None:
        """Answer at the pace of the wire, spoilt as the faults say."""
        frame = self._spoilt(request, plain)
        late_s = self.settings.late_ms / 1000.0 if self._strikes("late") else 0.0
        begins_s = max(now_s + self.settings.response_ms / 1000.0 + late_s, self._free_s)
        self._free_s = begins_s + self._on_the_wire_s(len(frame))
        due_s = self._free_s + (self.settings.latency_timer_ms / 1000.0 if self.settings.baud else 0.0)
        if self._strikes("split"):
            first, frame = frame[:3], frame[3:]
            self._at(due_s, partial(self._port.send, first, self._port.plugs))
            due_s += 0.004
        self._at(due_s, partial(self._port.send, frame, self._port.plugs))

    def _spoilt(self, request: ModbusRequest, plain: bytes) -> bytes:
        if self._strikes("wrong_function"):
            plain = plain[:1] + bytes([{3: 4, 4: 3, 16: 6}.get(request.function, 16)]) + plain[2:]
        if self._strikes("wrong_slave"):
            plain = bytes([plain[0] + 1]) + plain[1:]
        if request.count and self._strikes("wrong_length"):
            plain = plain[:2] + bytes([plain[2] - 2]) + plain[3:-2]
        if request.echo and self._strikes("wrong_echo"):
            plain = plain[:3] + bytes([plain[3] ^ 0x01]) + plain[4:]
        frame = plain + crc16(plain)
        if self._strikes("bad_crc"):
            frame = frame[:-1] + bytes([frame[-1] ^ 0x55])
        if self._strikes("garbage"):
            frame = self._rng.randbytes(self._rng.randrange(1, 6)) + frame
        if self._strikes("noise"):
            frame = self._rng.randbytes(len(frame))
        if self._strikes("half"):
            frame = frame[: len(frame) // 2]
        if self._strikes("double"):
            frame += frame
        return frame

    def _plug_again(self) -> None:
        if not self.faults.lasts("unplug"):
            self._port.plug()

    def _on_the_wire_s(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.settings.baud if self.settings.baud else 0.0

    def _strikes(self, fault: str) -> bool:
        struck = self.faults.strikes(fault)
        if struck:
            self.note("fault", kind=fault)
        return struck

    def _at(self, due_s: float, act: Callable[[], object]) -> None:
        """Do it then, or at once where that has passed."""
        if due_s <= asyncio.get_running_loop().time():
            act()
        else:
            self._timers.call_at(due_s, act)
