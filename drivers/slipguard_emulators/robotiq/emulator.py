"""A Robotiq 2F or Hand-E: Modbus RTU with the timing of a real wire, or the robot's URCap, with faults on demand."""

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
from slipguard_emulators.robotiq.forwarder import ForwarderPort
from slipguard_emulators.robotiq.jaws import JawsPlant, SimpleJaws
from slipguard_emulators.robotiq.modbus_frames import ModbusRequest, answer, crc16, frame_bytes, parse
from slipguard_emulators.robotiq.pseudo_terminal import EmulatedPort
from slipguard_emulators.robotiq.registers import FIGURES, RACT, ActivationStage, GripperRegisters
from slipguard_emulators.robotiq.urcap import UrcapPort

BITS_PER_BYTE = 10
FORWARDER_PORT, URCAP_PORT = 54321, 63352
FORGET_S = 0.02
"""An incomplete request is discarded after this silence; the standard says 3.5 characters."""
FAULTS = {
    "silence": "a request is executed, but not answered",
    "deaf": "a request is ignored",
    "late": "an answer, and all that follow, are late_ms late",
    "bad_crc": "an answer has a wrong checksum",
    "half": "only the first half of an answer is sent",
    "garbage": "noise precedes an answer",
    "noise": "noise is sent instead of an answer",
    "split": "an answer is sent in two parts",
    "double": "an answer is sent twice, back to back",
    "wrong_function": "an answer has another function code; its checksum is right",
    "wrong_length": "an answer has one register too few; its checksum is right",
    "wrong_echo": "an answer to a write has another address; its checksum is right",
    "wrong_slave": "an answer is from another slave; its checksum is right",
    "ignore": "a write is acknowledged, but not executed",
    "freeze": "the controller hangs for outage_ms and continues afterwards",
    "power": "the gripper loses power for outage_ms: the screw keeps the grip, and it must be activated again",
    "unplug": "the serial port disappears for outage_ms",
}
URCAP_FAULTS = (
    "silence", "deaf", "late", "half", "garbage", "split", "double", "ignore", "freeze", "power", "unplug",
)  # fmt: skip
"""Those that a request to the URCap can meet."""


class RobotiqEmulator(ControlledEmulator):
    """Emulate a 2F or Hand-E gripper: registers, moving jaws, an object, faults on demand.

    It is on a serial port, or on a robot: behind the RS-485 forwarder or behind Robotiq's URCap. Further commands:
    `object MM|none`, `gflt CODE`; with the URCap also `panel LINE`, a command of a program at the panel.

    Example: `slipguard emulate robotiq --link /tmp/ttyGR --object-width-mm 40 --fault late:0.01`
    """

    class Settings(BaseModel):
        """The command's options."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        wiring: Annotated[
            Literal["usb", "forwarder", "urcap"],
            Field(description="Serial port, the robot's RS-485 forwarder, or Robotiq's URCap on the robot."),
        ] = "usb"
        host: Annotated[str, Field(description="forwarder, urcap: address of the robot.")] = "127.0.0.1"
        tcp_port: Annotated[
            int | None, Field(ge=0, le=65535, description="forwarder: 54321, urcap: 63352; 0: a free one.")
        ] = None
        relay_ms: Annotated[
            float,
            Field(ge=0.0, le=1000.0, description="forwarder: delay of bytes each way; urcap: time to a response."),
        ] = 3.0
        jitter_ms: Annotated[float, Field(ge=0.0, le=1000.0, description="Largest random addition to that.")] = 4.0
        refresh_ms: Annotated[
            float, Field(ge=1.0, le=1000.0, description="urcap: period in which it talks to the gripper.")
        ] = 16.0
        link: Annotated[Path | None, Field(description="Name of the port; default: the pseudo terminal's own.")] = None
        model: Annotated[Literal["2F-85", "2F-140", "Hand-E"], Field(description="Gripper model.")] = "2F-85"
        slave_id: Annotated[int, Field(ge=1, le=247, description="Modbus address.")] = 9
        object_width_mm: Annotated[
            float | None,
            Field(gt=0.0, lt=140.0, description="Width of the object between the jaws; default: no object."),
        ] = None
        fingertip_mm: Annotated[
            float, Field(ge=0.0, le=40.0, description="Thickness of a sensor on each finger: the gels meet that early.")
        ] = 0.0
        activated: Annotated[bool, Field(description="Already activated; default: as after power-on.")] = False
        baud: Annotated[int, Field(ge=0, description="Bits per second of the wire; 0: no delay.")] = 115200
        response_ms: Annotated[float, Field(ge=0.0, le=1000.0, description="Time from a request to its answer.")] = 1.0
        latency_timer_ms: Annotated[
            float, Field(ge=0.0, le=255.0, description="How long the adapter keeps an answer; FTDI default: 16.")
        ] = 1.0
        late_ms: Annotated[float, Field(ge=0.0, le=60000.0, description="Delay of the fault `late`.")] = 120.0
        outage_ms: Annotated[
            float, Field(ge=0.0, le=60000.0, description="Duration of `freeze`, `power` and `unplug`.")
        ] = 300.0
        quick: Annotated[float, Field(gt=0.0, le=100.0, description="Speed of the jaws relative to real ones.")] = 1.0
        seed: Annotated[int, Field(ge=0, description="Random seed.")] = 0

    def __init__(self, settings: Settings, report: Report | None = None, jaws: JawsPlant | None = None) -> None:
        """jaws: other mechanics; default: simple jaws with at most one object."""
        kinds = FAULTS if settings.wiring != "urcap" else {name: FAULTS[name] for name in URCAP_FAULTS}
        super().__init__(kinds, settings.seed, report)
        self.settings = settings
        figures = FIGURES[settings.model]
        self.jaws = (
            jaws if jaws is not None else SimpleJaws(figures.stroke_mm, settings.object_width_mm, settings.fingertip_mm)
        )
        self.registers = GripperRegisters(self.jaws, figures, self.note, settings.quick, settings.seed)
        self.requests = 0
        """Number of requests received."""
        self._rng = random.Random(settings.seed + 1)
        self._port = self._make_port()
        self._started = False
        self._buffer = b""
        self._last_byte_s = 0.0
        self._free_s = 0.0
        """When the last answer will have been sent; answers stay in order."""
        self._down_until_s = 0.0
        self._outage: set[str] = set()
        """Which of `freeze`, `power` and `unplug` began the present or newest outage."""
        self._timers = TimerGroup()

    @property
    def address(self) -> str:
        """The port as the driver `robotiq` has it: a path, `socket://HOST:PORT`, or the URCap's HOST:PORT."""
        return f"socket://{self._port.path}" if self.settings.wiring == "forwarder" else self._port.path

    @property
    def driver_settings(self) -> dict[str, str]:
        """The driver's keys for this connection."""
        return {"urcap" if self.settings.wiring == "urcap" else "port": self.address}

    async def start(self) -> None:
        """Create the port. Raises InputError if the link cannot be created."""
        if self.settings.activated:
            self.registers.outputs, self.registers.stage = [RACT << 8, 0, 0], ActivationStage.READY
        else:
            self.registers.power_up()
        self._port.plug()
        self._started = True

    async def stop(self) -> None:
        """Remove the port."""
        self._timers.cancel_all()
        self._started = False
        self._port.unplug()

    def state(self) -> dict[str, object]:
        """Return the true state."""
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

    def commands(self) -> dict[str, EmulatorCommand]:
        """Return the commands `object`, `gflt` and, with the URCap, `panel`."""
        panel = {"panel": (self._panel, "panel LINE: a program at the panel sends it, such as `panel SET POS 0 GTO 1`")}
        return {
            **(panel if isinstance(self._port, UrcapPort) else {}),
            "object": (self._object, "object MM|none: the object between the jaws"),
            "gflt": (self._gflt, "gflt CODE: fault code that the gripper reports, such as 0x0E; 0 for none"),
        }

    def fault_changed(self) -> None:
        """Start `unplug` and `power` at once if they were set until cleared."""
        if self.faults.lasts("unplug"):
            self._port.unplug()
        elif self._started and not self._port.plugged and self._down_until_s <= asyncio.get_running_loop().time():
            self._port.plug()
        if self.faults.lasts("power"):
            self.registers.lose_power(asyncio.get_running_loop().time())

    def _object(self, rest: list[str]) -> str:
        if not isinstance(self.jaws, SimpleJaws):
            raise CommandRefused("the simulated world controls the object here; use `place`")
        if rest != ["none"]:
            try:
                (width_mm,) = (float(text) for text in rest)
            except ValueError:
                raise CommandRefused("write `object MM` or `object none`") from None
            if not 0.0 < width_mm < self.jaws.stroke_mm:
                raise CommandRefused(f"{width_mm} mm is not between 0 and {self.jaws.stroke_mm:g} mm")
            self.jaws.object_mm = width_mm
            return f"an object of {width_mm:g} mm"
        self.jaws.object_mm = None
        return "no object between the jaws"

    def _gflt(self, rest: list[str]) -> str:
        try:
            (code,) = (int(text, 0) for text in rest)
        except ValueError:
            raise CommandRefused("write `gflt CODE`, such as `gflt 0x0E`") from None
        if not 0 <= code <= 0x0F:
            raise CommandRefused(f"{code} is not a code of 0 to 0x0F")
        self.registers.fault = code
        return f"reports fault 0x{code:02X}"

    def _panel(self, rest: list[str]) -> str:
        assert isinstance(self._port, UrcapPort)
        return self._port.execute(" ".join(rest)) or "not answered"

    # The wire.

    def _make_port(self) -> EmulatedPort | ForwarderPort | UrcapPort:
        settings = self.settings
        relay_s, jitter_s = settings.relay_ms / 1000.0, settings.jitter_ms / 1000.0
        if settings.wiring == "usb":
            return EmulatedPort(settings.link, self._on_bytes)
        port = settings.tcp_port
        if settings.wiring == "forwarder":
            number = FORWARDER_PORT if port is None else port
            return ForwarderPort(settings.host, number, self._on_bytes, relay_s, jitter_s, settings.seed)
        return UrcapPort(
            settings.host,
            URCAP_PORT if port is None else port,
            self.registers,
            slave_id=settings.slave_id,
            refresh_s=settings.refresh_ms / 1000.0,
            response_s=relay_s,
            jitter_s=jitter_s,
            late_s=settings.late_ms / 1000.0,
            occurs=self._occurs,
            answers=self._urcap_answers,
            responds=self._responds,
            note=self.note,
            seed=settings.seed,
        )

    def _urcap_answers(self, now_s: float) -> bool:
        """Return whether the URCap answers a request; it does so while the gripper has no power."""
        self.requests += 1
        return not self._is_down(now_s) or self._outage == {"power"}

    def _responds(self, now_s: float) -> bool:
        """Return whether the gripper responds to the URCap."""
        return now_s >= self._down_until_s and not self.faults.lasts("power")

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
            arrived_s = now_s + self._wire_time_s(size)
            self._at(arrived_s, partial(self._on_request, frame, arrived_s))

    def _on_request(self, frame: bytes, arrived_s: float) -> None:
        """Execute a request whose last byte has arrived."""
        request = parse(frame)
        if request is None or request.slave != self.settings.slave_id or not request.makes_sense:
            return  # the manual: exception answers are not supported
        now_s = max(arrived_s, asyncio.get_running_loop().time())
        if self._is_down(now_s) or self._occurs("deaf"):
            return
        self.requests += 1
        if request.values and not self._occurs("ignore"):
            due_s = self.registers.write(now_s, request.write_at, request.values)
            self.note("write", registers=[f"{word:04X}" for word in request.values], last_byte_s=round(arrived_s, 6))
            self._at(due_s, lambda: self.registers.tick(asyncio.get_running_loop().time()))
        plain = answer(request, lambda: self.registers.read(now_s))
        self.registers.request_received(now_s)
        if not self._occurs("silence"):
            self._send(request, plain, now_s)

    def _is_down(self, now_s: float) -> bool:
        """Return whether freeze, power or unplug is in effect; each request is an opportunity to start one."""
        if now_s < self._down_until_s:
            return True
        begin = {name for name in ("freeze", "power", "unplug") if self._occurs(name)}
        if not begin:
            return False
        self._down_until_s, self._outage = now_s + self.settings.outage_ms / 1000.0, begin
        if "power" in begin and not self.faults.lasts("power"):
            self.registers.lose_power(now_s)
        if "unplug" in begin:
            self._port.unplug()
            self._at(self._down_until_s, self._plug_again)
        return True

    def _send(self, request: ModbusRequest, plain: bytes, now_s: float) -> None:
        """Send the answer with the timing of the wire, with faults."""
        port = self._port
        assert not isinstance(port, UrcapPort)  # it answers by itself
        frame = self._with_faults(request, plain)
        late_s = self.settings.late_ms / 1000.0 if self._occurs("late") else 0.0
        begins_s = max(now_s + self.settings.response_ms / 1000.0 + late_s, self._free_s)
        self._free_s = begins_s + self._wire_time_s(len(frame))
        due_s = self._free_s + (self.settings.latency_timer_ms / 1000.0 if self.settings.baud else 0.0)
        if self._occurs("split"):
            first, frame = frame[:3], frame[3:]
            self._at(due_s, partial(port.send, first, port.plugs))
            due_s += 0.004
        self._at(due_s, partial(port.send, frame, port.plugs))

    def _with_faults(self, request: ModbusRequest, plain: bytes) -> bytes:
        if self._occurs("wrong_function"):
            plain = plain[:1] + bytes([{3: 4, 4: 3, 16: 6}.get(request.function, 16)]) + plain[2:]
        if self._occurs("wrong_slave"):
            plain = bytes([plain[0] + 1]) + plain[1:]
        if request.count and self._occurs("wrong_length"):
            plain = plain[:2] + bytes([plain[2] - 2]) + plain[3:-2]
        if request.echo and self._occurs("wrong_echo"):
            plain = plain[:3] + bytes([plain[3] ^ 0x01]) + plain[4:]
        frame = plain + crc16(plain)
        if self._occurs("bad_crc"):
            frame = frame[:-1] + bytes([frame[-1] ^ 0x55])
        if self._occurs("garbage"):
            frame = self._rng.randbytes(self._rng.randrange(1, 6)) + frame
        if self._occurs("noise"):
            frame = self._rng.randbytes(len(frame))
        if self._occurs("half"):
            frame = frame[: len(frame) // 2]
        if self._occurs("double"):
            frame += frame
        return frame

    def _plug_again(self) -> None:
        if not self.faults.lasts("unplug"):
            self._port.plug()

    def _wire_time_s(self, size: int) -> float:
        return size * BITS_PER_BYTE / self.settings.baud if self.settings.baud else 0.0

    def _occurs(self, fault: str) -> bool:
        occurred = self.faults.occurs(fault)
        if occurred:
            self.note("fault", kind=fault)
        return occurred

    def _at(self, due_s: float, act: Callable[[], object]) -> None:
        """Call `act` at a time, or at once if it has passed."""
        if due_s <= asyncio.get_running_loop().time():
            act()
        else:
            self._timers.call_at(due_s, act)
