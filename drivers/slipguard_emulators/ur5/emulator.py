"""A UR controller on three TCP ports, with faults on demand: RTDE (30004), dashboard (29999), script (30003).

It implements the handshake of ur-rtde's control script instead of interpreting URScript, and moves a point in straight
lines. So it tests a driver with ur-rtde's real client, but not with a controller's kinematics or safety system.
Never run it in the process that creates ur-rtde's interfaces: their constructors block the interpreter.
"""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from slipguard.cancellation import cancel_and_wait
from slipguard.emulator import Report
from slipguard.errors import InputError
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand
from slipguard_emulators.stream_server import Client, StreamServer
from slipguard_emulators.ur5.controller import PAUSED, PLAYING, POWER_OFF, RUNNING, EmulatedController
from slipguard_emulators.ur5.dashboard import GREETING, DashboardServer
from slipguard_emulators.ur5.faults import FAULTS, STOPS
from slipguard_emulators.ur5.rtde import message
from slipguard_emulators.ur5.rtde_session import RtdeSession
from slipguard_emulators.ur5.tool import StraightTool, ToolPlant

SERIES = {"e": ((5, 17, 3, 0), 500.0), "cb3": ((3, 15, 8, 0), 125.0)}
"""Software version and cycles per second."""
RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
"""Those of a real controller; ur-rtde supports no others."""
WriteBytes = Callable[[bytes], None]
Serve = Callable[[asyncio.StreamReader, WriteBytes], Coroutine[None, None, None]]


class UrEmulator(ControlledEmulator):
    """A UR controller: RTDE, dashboard and script port. Example: `slipguard emulate ur --series cb3`."""

    class Settings(BaseModel):
        """Settings. The ports are fixed, so give each emulator a loopback address of its own."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        host: str = Field("127.0.0.1", description="Address of this machine to listen on.")
        series: Literal["e", "cb3"] = Field("e", description="e: 500 Hz, 5.17; cb3: 125 Hz, 3.15.")
        ready: bool = Field(
            False,
            description="Start switched on, brakes released, in remote control; a real robot starts switched off.",
        )
        mounting_deg: Annotated[float, Field(ge=0.0, le=180.0)] = Field(
            0.0, description="Tilt of the arm's base: 0 upright, 90 on a wall, 180 on the ceiling."
        )
        payload_kg: Annotated[float, Field(ge=0.0, le=20.0)] = Field(1.2, description="Payload set at the panel.")
        late_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = Field(100.0, description="Delay of the fault `late`.")
        script_start_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = Field(
            20.0, description="Time from a script's upload to its start."
        )

    def __init__(self, settings: Settings, report: Report | None = None, *, tool: ToolPlant | None = None) -> None:
        super().__init__(FAULTS, report=report)
        self.settings = settings
        self.tool: ToolPlant = tool or StraightTool()
        self.controller = EmulatedController(
            self.tool,
            self.note,
            ready=settings.ready,
            mounting_deg=settings.mounting_deg,
            payload_kg=settings.payload_kg,
        )
        self.controller.remote |= settings.series == "cb3"  # which knows no local control
        self._stop, self._local = "NORMAL", False
        self._version, self._rate_hz = SERIES[settings.series]
        ports = ((RTDE_PORT, self._rtde), (DASHBOARD_PORT, self._dashboard), (SCRIPT_PORT, self._script))
        self._servers = [StreamServer((settings.host, port), self._client(serve)) for port, serve in ports]
        self._sessions: dict[WriteBytes, RtdeSession] = {}
        self._running: asyncio.Task[None] | None = None

    @property
    def address(self) -> str:
        """Host of the three ports."""
        return self.settings.host

    async def start(self) -> None:
        """Listen on the ports. Idempotent."""
        if self._running is None:
            self._listen()
            self._running = asyncio.create_task(self._run(), name="controller")

    async def stop(self) -> None:
        """Close the ports and all connections. Idempotent."""
        running, self._running = self._running, None
        await cancel_and_wait(running)
        for server in self._servers:
            await server.close()

    def state(self) -> Mapping[str, object]:
        """Return the true state."""
        now_s = _now_s()
        robot = self.controller
        return {
            "pose": [round(value, 4) for value in self.tool.pose(now_s)],
            "speed_m_s": round(sum(value**2 for value in self.tool.velocity(now_s)[:3]) ** 0.5, 4),
            "program": robot.program.name if robot.program is not None else None,
            "runtime": {PLAYING: "playing", PAUSED: "paused"}.get(robot.runtime, "stopped"),
            "power": {POWER_OFF: "off", RUNNING: "on"}.get(robot.mode, "on, brakes engaged"),
            "safety": robot.safety.lower().replace("_", " "),
            "control": "remote" if robot.remote else "local",
            "outputs": robot.output_bits,
            "rtde_clients": len(self._sessions),
            "faults": self.faults.active,
        }

    def commands(self) -> dict[str, EmulatorCommand]:
        """Return the command `panel`."""
        robot = self.controller
        orders: dict[str, Callable[[], object]] = {
            "play": lambda: robot.play(_now_s()),
            "pause": lambda: robot.pause(_now_s(), "pressed at the panel"),
            "stop": lambda: robot.end("pressed at the panel", _now_s()),
            "unlock": lambda: robot.unlock(_now_s()),
            "on": lambda: robot.power(RUNNING, _now_s()),
            "off": lambda: robot.power(POWER_OFF, _now_s()),
            "remote": lambda: self._set_remote(remote=True),
            "local": lambda: self._set_remote(remote=False),
        }
        usage = f"panel {'|'.join(orders)}"

        def panel(rest: list[str]) -> str:
            if len(rest) != 1 or rest[0] not in orders:
                return usage
            orders[rest[0]]()
            state = self.state()
            return f"power {state['power']}, {state['control']} control, {state['safety']}, program {state['runtime']}"

        return {"panel": (panel, f"{usage}: press a button at the panel; the program moves up and down")}

    def _set_remote(self, *, remote: bool) -> None:
        self.controller.remote = remote

    def fault_changed(self) -> None:
        """Start and end stops and local control at once; connection faults start with the next cycle."""
        robot, active = self.controller, self.faults.active
        stop = next((state for fault, state in STOPS.items() if fault in active), "NORMAL")
        if stop != self._stop:  # a stop that was unlocked since does not begin again
            if self._stop == "ROBOT_EMERGENCY_STOP":
                robot.set_safety("NORMAL", _now_s())
                robot.power(RUNNING, _now_s())
            self._stop = stop
            robot.set_safety(stop, _now_s())
        if self._local != ("local" in active):
            self._local = "local" in active
            robot.remote = not self._local
        robot.refuses_stop = "refuse_stop" in active
        robot.fieldbus = "fieldbus" in active

    async def _run(self) -> None:
        """Execute the controller's cycles with absolute deadlines; missed ones are skipped."""
        loop = asyncio.get_running_loop()
        count, due_s, moving, killed = 0, loop.time(), False, False
        while True:
            count, due_s = count + 1, max(due_s + 1 / self._rate_hz, loop.time())
            await asyncio.sleep(due_s - loop.time())
            if self.tool.under_way(loop.time()) != moving:
                moving = not moving
                self.note("moves" if moving else "stands", z_m=round(self.tool.pose(loop.time())[2], 4))
            if "kill" in self.faults.active:
                if not killed:
                    killed = True
                    self._hang_up()
                    self.controller.end("the controller is gone", loop.time())
                continue
            if killed:
                killed = False
                self._listen()
            if self.faults.occurs("drop"):
                for server in self._servers:
                    server.cut()
            self.controller.cycle(loop.time())
            values = self.controller.outputs(loop.time())
            for write, session in list(self._sessions.items()):
                if session.due(count) and not self.faults.occurs("freeze"):
                    write(session.packet(values))

    def _listen(self) -> None:
        try:
            for server in self._servers:
                server.plug()
        except InputError:
            self._hang_up()
            raise

    def _hang_up(self) -> None:
        for server in self._servers:
            server.unplug()

    def _client(self, serve: Serve) -> Callable[[Client], Coroutine[None, None, None]]:
        return lambda client: serve(client[0], self._writer(client[1]))

    def _writer(self, stream: asyncio.StreamWriter) -> WriteBytes:
        """Return a function that writes to one connection, with faults."""

        loop = asyncio.get_running_loop()
        waiting: deque[bytes] = deque()

        def send_next() -> None:
            _write(stream, waiting.popleft())

        def write(data: bytes) -> None:
            if stream.transport.is_closing() or self.faults.occurs("silence"):
                return
            if self.faults.occurs("half"):
                data = data[: len(data) // 2]
            if self.faults.occurs("garbage"):
                data = bytes(byte ^ 0xA5 for byte in data)
            late = self.faults.occurs("late")
            if late or waiting:  # later data wait behind late data, as in every stream
                waiting.append(data)
                loop.call_later(self.settings.late_ms / 1000.0, send_next)
            else:
                _write(stream, data)

        return write

    async def _dashboard(self, reader: asyncio.StreamReader, write: WriteBytes) -> None:
        write(GREETING.encode() + b"\n")
        dashboard = DashboardServer(self.controller, self._version)
        while line := await reader.readline():
            answer = dashboard.answer(line.decode(), _now_s())
            self.note("dashboard", asked=line.decode().strip(), answered=answer)
            if answer == "Pausing program":
                await self._at_rest()  # a real controller answers only then
            write(answer.encode() + b"\n")

    async def _at_rest(self) -> None:
        for _ in range(1000):
            if not self.tool.under_way(_now_s()):
                return
            await asyncio.sleep(1 / self._rate_hz)

    async def _script(self, reader: asyncio.StreamReader, write: WriteBytes) -> None:
        text = b""
        while data := await reader.read(65536):
            text += data
            if text.startswith(b"def ") and text.rstrip().endswith(b"end"):
                await asyncio.sleep(self.settings.script_start_ms / 1000.0)
                if not self.faults.lasts("silence"):
                    self.controller.upload(text.decode(), _now_s())
                text = b""

    async def _rtde(self, reader: asyncio.StreamReader, write: WriteBytes) -> None:
        session = RtdeSession(self.controller, self._version, self._rate_hz)
        self._sessions[write] = session
        try:
            while True:
                size, kind = struct.unpack(">Hc", await reader.readexactly(3))
                payload = await reader.readexactly(size - 3)
                if self.faults.lasts("silence"):
                    continue
                answer = session.answer(kind.decode(), payload, _now_s())
                if answer is not None:
                    write(message(kind.decode(), answer))
        finally:
            del self._sessions[write]
            self.controller.release(session)


def _write(stream: asyncio.StreamWriter, data: bytes) -> None:
    if not stream.transport.is_closing():
        stream.write(data)


def _now_s() -> float:
    return asyncio.get_running_loop().time()
