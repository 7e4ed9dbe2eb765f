"""A UR controller on three TCP ports, with faults on demand: RTDE (30004), dashboard (29999), script (30003).

It keeps the handshake of ur-rtde's control script instead of interpreting URScript, and moves a point in straight
lines. So it proves a driver against ur-rtde's real client, not against a controller's kinematics or safety.
Never run it in the process that builds ur-rtde's interfaces: their constructors keep the interpreter to themselves.
"""

from __future__ import annotations

import asyncio
import struct
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from slipguard.cancellation import cancel_and_wait
from slipguard.emulator import Report
from slipguard.errors import InputError
from slipguard_emulators.base import ControlledEmulator, EmulatorCommand
from slipguard_emulators.ur5.controller import PAUSED, PLAYING, EmulatedController
from slipguard_emulators.ur5.dashboard import GREETING, DashboardServer
from slipguard_emulators.ur5.rtde import message
from slipguard_emulators.ur5.rtde_session import RtdeSession
from slipguard_emulators.ur5.tool import StraightTool, ToolPlant

SERIES = {"e": ((5, 17, 3, 0), 500.0), "cb3": ((3, 15, 8, 0), 125.0)}
"""Software version and cycles a second."""
RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
"""A real controller's, and the only ones that ur-rtde knows."""
FAULTS = {
    "freeze": "RTDE data cease, connections stay; with a probability: single packets are lost",
    "silence": "connections are accepted and nothing is answered",
    "late": "data and answers come late_ms late",
    "garbage": "nonsense in place of a packet or an answer",
    "half": "half a packet or answer, and never the rest",
    "drop": "all connections are cut; until cleared: each new one too",
    "kill": "the controller is gone, its arm stands",
    "protective_stop": "the arm stops itself; clear unlocks it",
    "emergency_stop": "the emergency stop is pressed; clear releases it and powers the arm on",
    "local": "local control: no orders by dashboard, no scripts",
    "fieldbus": "a fieldbus adapter holds all RTDE inputs: IN_USE",
}
Write = Callable[[bytes], None]
Serve = Callable[[asyncio.StreamReader, Write], Awaitable[None]]


class UrEmulator(ControlledEmulator):
    """A UR controller: RTDE, dashboard and script port. Example: `slipguard emulate ur --series cb3`."""

    class Settings(BaseModel):
        """The ports are a real controller's: give each emulator a loopback address of its own."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        host: str = Field("127.0.0.1", description="Address of this machine to listen on.")
        series: Literal["e", "cb3"] = Field("e", description="e: 500 Hz, 5.17; cb3: 125 Hz, 3.15.")
        late_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = Field(100.0, description="How late `late` is.")
        script_start_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = Field(
            20.0, description="From a script's upload to its start."
        )

    def __init__(self, settings: Settings, report: Report | None = None, *, tool: ToolPlant | None = None) -> None:
        super().__init__(FAULTS, report=report)
        self.settings = settings
        self.tool: ToolPlant = tool or StraightTool()
        self.controller = EmulatedController(self.tool, self.note)
        self._version, self._rate_hz = SERIES[settings.series]
        self._servers: list[asyncio.Server] = []
        self._clients: set[asyncio.StreamWriter] = set()
        self._serving: set[asyncio.Task[None]] = set()
        self._sessions: dict[Write, RtdeSession] = {}
        self._running: asyncio.Task[None] | None = None

    @property
    def address(self) -> str:
        """Host of the three ports."""
        return self.settings.host

    async def start(self) -> None:
        """Be reachable. Idempotent."""
        if self._running is None:
            await self._listen()
            self._running = asyncio.create_task(self._run(), name="controller")

    async def stop(self) -> None:
        """Vanish with all connections. Idempotent."""
        self._hang_up()
        running, self._running = self._running, None
        await cancel_and_wait(running)
        self._hang_up()
        if self._serving:
            await asyncio.wait(self._serving)

    def state(self) -> Mapping[str, object]:
        """The truth now."""
        now_s = _now_s()
        robot = self.controller
        return {
            "pose": [round(value, 4) for value in self.tool.pose(now_s)],
            "speed_m_s": round(sum(value**2 for value in self.tool.velocity(now_s)[:3]) ** 0.5, 4),
            "program": robot.program.name if robot.program is not None else None,
            "runtime": {PLAYING: "playing", PAUSED: "paused"}.get(robot.runtime, "stopped"),
            "safety": robot.safety.lower().replace("_", " "),
            "control": "remote" if robot.remote else "local",
            "outputs": robot.output_bits,
            "rtde_clients": len(self._sessions),
            "faults": self.faults.active,
        }

    def words(self) -> dict[str, EmulatorCommand]:
        """Somebody's program, and the arm's place."""
        orders: dict[str, Callable[[], object]] = {
            "play": lambda: self.controller.play(_now_s()),
            "pause": lambda: self.controller.pause(_now_s(), "a hand at the panel"),
            "stop": lambda: self.controller.end("a hand at the panel", _now_s()),
        }

        def panel(rest: list[str]) -> str:
            if len(rest) != 1 or rest[0] not in orders:
                return "panel play|pause|stop"
            orders[rest[0]]()
            return str(self.state()["runtime"])

        return {
            "panel": (panel, "panel play|pause|stop: a hand at the panel, with a program that shuttles up and down")
        }

    def fault_changed(self) -> None:
        """Stops and local control begin and end at once, a vanished or cut connection with the next cycle."""
        robot, active = self.controller, self.faults.active
        emergency, protective = "emergency_stop" in active, "protective_stop" in active
        state = "ROBOT_EMERGENCY_STOP" if emergency else "PROTECTIVE_STOP" if protective else "NORMAL"
        robot.set_safety(state, _now_s())
        robot.remote = "local" not in active
        robot.fieldbus = "fieldbus" in active

    async def _run(self) -> None:
        """The controller's cycles, by absolute deadlines; late ones are left out."""
        loop = asyncio.get_running_loop()
        count, due_s, moving = 0, loop.time(), False
        while True:
            count, due_s = count + 1, max(due_s + 1 / self._rate_hz, loop.time())
            await asyncio.sleep(due_s - loop.time())
            if self.tool.under_way(loop.time()) != moving:
                moving = not moving
                self.note("moves" if moving else "stands", z_m=round(self.tool.pose(loop.time())[2], 4))
            if "kill" in self.faults.active:
                if self._servers:
                    self._hang_up()
                    self.controller.end("the controller is gone", loop.time())
                continue
            if not self._servers:
                await self._listen()
            if self.faults.strikes("drop"):
                self._cut()
            self.controller.cycle(loop.time())
            told = self.controller.outputs(loop.time())
            for write, session in list(self._sessions.items()):
                if session.due(count) and not self.faults.strikes("freeze"):
                    write(session.packet(told))

    async def _listen(self) -> None:
        ports: tuple[tuple[int, Serve], ...] = (
            (RTDE_PORT, self._rtde),
            (DASHBOARD_PORT, self._dashboard),
            (SCRIPT_PORT, self._script),
        )
        for port, serve in ports:
            try:
                self._servers.append(await asyncio.start_server(self._client(serve), self.settings.host, port))
            except OSError as error:
                self._hang_up()
                raise InputError(
                    f"{self.settings.host}:{port} cannot be listened on: {error.strerror or error}; give another "
                    "address of this machine, such as 127.0.0.2"
                ) from None

    def _hang_up(self) -> None:
        for server in self._servers:
            server.close()
        self._servers.clear()
        self._cut()

    def _cut(self) -> None:
        for writer in list(self._clients):
            writer.transport.abort()

    def _client(self, serve: Serve) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]:
        async def run(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            self._serving.add(task)
            self._clients.add(writer)
            try:
                await serve(reader, self._writer(writer))
            except (asyncio.IncompleteReadError, OSError, ValueError, IndexError, struct.error):
                pass  # the client is gone, or speaks nonsense: the connection ends
            finally:
                self._clients.discard(writer)
                self._serving.discard(task)
                writer.close()

        return run

    def _writer(self, stream: asyncio.StreamWriter) -> Write:
        """How one connection is written to, with whatever goes wrong on the way."""

        loop = asyncio.get_running_loop()
        waiting: deque[bytes] = deque()

        def send_next() -> None:
            _write(stream, waiting.popleft())

        def write(data: bytes) -> None:
            if stream.transport.is_closing() or self.faults.strikes("silence"):
                return
            if self.faults.strikes("half"):
                data = data[: len(data) // 2]
            if self.faults.strikes("garbage"):
                data = bytes(byte ^ 0xA5 for byte in data)
            late = self.faults.strikes("late")
            if late or waiting:  # what follows something late waits behind it, as in every stream
                waiting.append(data)
                loop.call_later(self.settings.late_ms / 1000.0, send_next)
            else:
                _write(stream, data)

        return write

    async def _dashboard(self, reader: asyncio.StreamReader, write: Write) -> None:
        write(GREETING.encode() + b"\n")
        dashboard = DashboardServer(self.controller, self._version)
        while line := await reader.readline():
            answer = dashboard.answer(line.decode(), _now_s())
            self.note("dashboard", asked=line.decode().strip(), answered=answer)
            if answer == "Pausing program":
                await self._at_rest()  # only then does a real one answer
            write(answer.encode() + b"\n")

    async def _at_rest(self) -> None:
        for _ in range(1000):
            if not self.tool.under_way(_now_s()):
                return
            await asyncio.sleep(1 / self._rate_hz)

    async def _script(self, reader: asyncio.StreamReader, write: Write) -> None:
        text = b""
        while data := await reader.read(65536):
            text += data
            if text.startswith(b"def ") and text.rstrip().endswith(b"end"):
                await asyncio.sleep(self.settings.script_start_ms / 1000.0)
                if not self.faults.lasts("silence"):
                    self.controller.upload(text.decode(), _now_s())
                text = b""

    async def _rtde(self, reader: asyncio.StreamReader, write: Write) -> None:
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
