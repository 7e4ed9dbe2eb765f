"""A UR controller on three TCP ports: RTDE (30004), dashboard (29999) and script port (30003).

It keeps the register handshake of ur-rtde's control script instead of interpreting URScript, and moves a point in
straight lines. So it proves the driver against ur-rtde's real client, not against the controller's kinematics.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import struct

RATE_HZ = 125.0
VERSION = (5, 17, 3, 0)
STOPPED, PLAYING = 1, 2
NORMAL, PROTECTIVE, EMERGENCY = 1, 1 << 2, 1 << 7
MOVE_L, STOP_L, WATCHDOG, STOP_SCRIPT = 3, 33, 35, 255

FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT8": "B"}
VECTORS = re.findall(
    r"\w+",
    """actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed actual_q actual_qd target_q
    target_qd target_qdd target_current target_moment actual_current joint_control_output joint_temperatures
    actual_joint_voltage ft_raw_wrench payload_inertia actual_current_as_torque""",
)
OUTPUTS = dict.fromkeys(VECTORS, "VECTOR6D") | {
    "runtime_state": "UINT32",
    "safety_status_bits": "UINT32",
    "robot_status_bits": "UINT32",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
}
INPUTS = {
    "external_force_torque": "VECTOR6D",
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
}


def output_type(name: str) -> str:
    """RTDE type of an output; doubles for what nobody looks at."""
    return OUTPUTS.get(name) or ("INT32" if "int_register" in name else "DOUBLE")


def input_type(name: str) -> str:
    """RTDE type of an input; masks and digital outputs are bytes."""
    return INPUTS.get(name) or ("INT32" if "int_register" in name else "DOUBLE" if "double" in name else "UINT8")


class Point:
    """The tool: its pose, and a straight move or a stop under way."""

    def __init__(self) -> None:
        self.pose = [-0.3, -0.2, 0.3, 0.0, math.pi, 0.0]
        self.speed_m_s = 0.0
        self.goal: list[float] | None = None
        self._direction = [0.0, 0.0, 0.0]
        self._limit_m_s = 0.0
        self._acceleration = 1.0

    def move(self, goal: list[float], speed_m_s: float, acceleration: float) -> None:
        self.goal, self._limit_m_s, self._acceleration = goal, speed_m_s, acceleration

    def stop(self, deceleration: float) -> None:
        self.goal, self._acceleration = None, deceleration

    def velocity(self) -> list[float]:
        return [self.speed_m_s * part for part in self._direction] + [0.0] * 3

    def step(self, dt_s: float) -> None:
        change = self._acceleration * dt_s
        if self.goal is None:
            self.speed_m_s = max(0.0, self.speed_m_s - change)
        else:
            way = [goal - here for goal, here in zip(self.goal[:3], self.pose[:3], strict=True)]
            left_m = math.hypot(*way)
            braking = math.sqrt(2 * self._acceleration * left_m)
            self.speed_m_s = min(self._limit_m_s, self.speed_m_s + change, braking)
            if left_m <= max(self.speed_m_s * dt_s, 1e-6):
                self.pose, self.speed_m_s, self.goal = list(self.goal), 0.0, None
                return
            self._direction = [part / left_m for part in way]
        self.pose[:3] = [p + v * dt_s for p, v in zip(self.pose, self.velocity()[:3], strict=False)]


class UrEmulator:
    """One controller at `host`, an address of this machine. `frozen` stops its packets; `kill()` its servers."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.point = Point()
        self.frozen = False
        self.commands: list[int] = []
        self.safety = NORMAL
        self._inputs: dict[str, float | tuple[float, ...]] = {}
        self._ready = 0  # output_int_register_0: 1 ready, 2 done
        self._busy = False
        self._moving_async = False
        self._async_count = 0
        self._async_number = 0
        self._playing = False
        self._watchdog_s: float | None = None
        self._heard_at_s = 0.0
        self._servers: list[asyncio.Server] = []
        self._clients: set[asyncio.StreamWriter] = set()
        self._serving: set[asyncio.Task[None]] = set()
        self._subscribers: dict[asyncio.StreamWriter, list[str]] = {}
        self._ticking: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Be reachable. Idempotent."""
        if self._servers:
            return
        for port, serve in ((30004, self._rtde), (29999, self._dashboard), (30003, self._script)):
            self._servers.append(await asyncio.start_server(self._client(serve), self.host, port))
        self._ticking = asyncio.create_task(self._tick(), name="controller")

    async def kill(self) -> None:
        """Vanish with all connections; the arm stops. Idempotent."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        for writer in list(self._clients):
            writer.transport.abort()
        if self._serving:
            await asyncio.wait(self._serving)
        if self._ticking is not None:
            self._ticking.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._ticking
        self._ticking = None
        self._stop_script()

    def safety_stop(self, bits: int) -> None:
        """A protective or emergency stop: the arm stops, the program ends. NORMAL unlocks it."""
        self.safety = bits
        if bits != NORMAL:
            self._stop_script()

    def _client(self, serve):  # type: ignore[no-untyped-def]
        async def run(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            self._serving.add(task)
            self._clients.add(writer)
            try:
                await serve(reader, writer)
            except (asyncio.IncompleteReadError, OSError):
                pass
            finally:
                self._subscribers.pop(writer, None)
                self._clients.discard(writer)
                self._serving.discard(task)
                writer.close()

        return run

    async def _dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        answers = {
            "polyscopeversion": "URSoftware " + ".".join(map(str, VERSION)),
            "get serial number": "20225500001",
            "is in remote control": "true",
            "robotmode": "Robotmode: RUNNING",
            "stop": "Stopped",
        }
        while line := (await reader.readline()).decode().strip().lower():
            if line == "stop":
                self._stop_script()
            writer.write(answers.get(line, "ok").encode() + b"\n")

    async def _script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        text = b""
        while data := await reader.read(65536):
            text += data
            if text.startswith(b"def rtde_control") and text.rstrip().endswith(b"end"):
                text = b""
                await asyncio.sleep(0.02)
                if self.safety == NORMAL:
                    self._playing, self._ready, self._busy, self._watchdog_s = True, 1, False, None
                    self._tell_progress(running=False)

    def _stop_script(self) -> None:
        self._playing, self._watchdog_s = False, None
        self.point.stop(2.5)

    async def _rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        recipes: list[list[str]] = []
        outputs: list[str] = []
        while True:
            size, kind = struct.unpack(">HB", await reader.readexactly(3))
            payload = await reader.readexactly(size - 3)
            answer = b"\x01"
            if kind == ord("v"):
                answer = struct.pack(">4I", *VERSION)
            elif kind == ord("O"):
                outputs = [name for name in payload[8:].decode().split(",") if name]
                answer += ",".join(map(output_type, outputs)).encode()
            elif kind == ord("I"):
                recipes.append([name for name in payload.decode().split(",") if name])
                answer = bytes([len(recipes)]) + ",".join(map(input_type, recipes[-1])).encode()
            elif kind == ord("S"):
                self._subscribers[writer] = outputs
            elif kind == ord("P"):
                self._subscribers.pop(writer, None)
            elif kind == ord("U"):
                self._take(recipes[payload[0] - 1], payload[1:])
                continue
            writer.write(struct.pack(">HB", 3 + len(answer), kind) + answer)

    def _take(self, names: list[str], payload: bytes) -> None:
        at = 0
        for name in names:
            layout = ">" + FORMATS[input_type(name)]
            values = struct.unpack_from(layout, payload, at)
            at += struct.calcsize(layout)
            self._inputs[name] = values[0] if len(values) == 1 else values
        if "input_int_register_0" in names:
            self._heard_at_s = asyncio.get_running_loop().time()

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            due_s = max(due_s + 1 / RATE_HZ, loop.time())
            await asyncio.sleep(due_s - loop.time())
            if self._watchdog_s is not None and loop.time() - self._heard_at_s > self._watchdog_s:
                self._stop_script()
            if self._playing:
                self._handshake()
            self.point.step(1 / RATE_HZ)
            if not self.frozen:
                for writer, names in self._subscribers.items():
                    packet = b"\x01" + b"".join(self._pack(name) for name in names)
                    writer.write(struct.pack(">HB", 3 + len(packet), ord("U")) + packet)

    def _handshake(self) -> None:
        """One cycle of the control script: see a command once, do it, say done, wait until it is taken back."""
        if self.point.goal is None and self._moving_async:
            self._tell_progress(running=False)
        command = int(self._number("input_int_register_0"))
        if command == 0:
            self._busy, self._ready = False, 1
            return
        if self._busy:
            if command != STOP_L or self.point.speed_m_s == 0.0:
                self._ready = 2
            return
        self._busy = True
        self.commands.append(command)
        arguments = [self._number(f"input_double_register_{index}") for index in range(8)]
        if command == MOVE_L:
            self.point.move(arguments[:6], arguments[6], arguments[7])
            self._tell_progress(running=True)
        elif command == STOP_L:
            self.point.stop(arguments[0])
        elif command == WATCHDOG:
            self._watchdog_s, self._heard_at_s = 1.0 / arguments[0], asyncio.get_running_loop().time()
        elif command == STOP_SCRIPT:
            self._stop_script()

    def _tell_progress(self, *, running: bool) -> None:
        self._moving_async = running
        self._async_count = (self._async_count + 1) % 128
        self._async_number = (self._async_number + running) % 128

    def _number(self, name: str) -> float:
        value = self._inputs.get(name, 0)
        assert not isinstance(value, tuple)
        return value

    def _pack(self, name: str) -> bytes:
        values: dict[str, object] = {
            "timestamp": asyncio.get_running_loop().time(),
            "actual_TCP_pose": self.point.pose,
            "actual_TCP_speed": self.point.velocity(),
            "runtime_state": PLAYING if self._playing else STOPPED,
            "safety_status_bits": self.safety,
            "robot_status_bits": 0b11 if self._playing else 0b01,
            "robot_mode": 7,
            "safety_mode": 1,
            "output_int_register_0": self._ready,
            "output_int_register_2": self._async_number << 24 | self._async_count << 16 | self._moving_async << 15,
        }
        layout = ">" + FORMATS[output_type(name)]
        value = values.get(name, [0.0] * 6 if layout == ">6d" else 0)
        return struct.pack(layout, *value) if isinstance(value, list) else struct.pack(layout, value)
