"""The devices that the example drivers need, simulated: `python example_devices.py OBJECT_MM` (0: no object).

A gripper and an arm on TCP ports of their own, printed as JSON; they run until standard input ends.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable, Coroutine

from slipguard_emulators.robotiq.jaws import JawsPlant, SimpleJaws
from slipguard_emulators.ur5.tool import StraightTool

HOST = "127.0.0.1"
SPEED_MM_S = 600.0
ACCELERATION_M_S2 = 2.0
Client = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[None, None, None]]


class TextGripperDevice:
    """Jaws that keep the force of a finished grip; a halted closing may have gripped something."""

    def __init__(self, jaws: JawsPlant) -> None:
        self._jaws = jaws
        self._applied_n = 0.0
        self._closing = self._halted = False

    def respond(self, now_s: float, command: str, values: list[float]) -> list[float]:
        view = self._jaws.state_at(now_s)
        if command == "state":
            maybe_held = view.holds or self._halted
            on_nothing = self._closing and not view.moving and not maybe_held
            applied_n = self._applied_n if view.holds or self._closing else 0.0
            return [view.width_mm, applied_n, view.moving, maybe_held, on_nothing]
        if command == "halt":
            if view.moving:
                self._halted, self._closing, self._applied_n = self._closing, False, 0.0
            self._jaws.halt(now_s)
            return []
        self._halted, self._closing = False, command == "grip"
        if command == "grip":
            self._applied_n = max(values[0], self._applied_n if view.holds else 0.0)
            self._jaws.drive(now_s, 0.0, SPEED_MM_S, self._applied_n)
            return [self._applied_n]
        self._applied_n = 0.0
        self._jaws.drive(now_s, values[0], SPEED_MM_S, values[1] if command == "move" else 0.0)
        return []


class TextArmDevice:
    """A tool on a vertical line."""

    def __init__(self) -> None:
        self._tool = StraightTool()

    def respond(self, now_s: float, command: str, values: list[float]) -> list[float]:
        pose = list(self._tool.pose(now_s))
        if command == "state":
            return [1000.0 * pose[2], 1000.0 * self._tool.velocity(now_s)[2], self._tool.under_way(now_s), 0, 0]
        if command == "lift":
            pose[2] += values[0] / 1000.0
            self._tool.move(now_s, pose, values[1] / 1000.0, ACCELERATION_M_S2)
        else:
            self._tool.stop(now_s, ACCELERATION_M_S2)
        return []


def serve(device: TextGripperDevice | TextArmDevice) -> Client:
    """Return the handler of one connection."""

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            number, command, *words = line.decode().split()
            response = device.respond(asyncio.get_running_loop().time(), command, [float(word) for word in words])
            writer.write(f"{number} ok {' '.join(f'{float(value):.6g}' for value in response)}\n".encode())
        writer.close()

    return handle


async def main(object_mm: float) -> None:
    devices: dict[str, TextGripperDevice | TextArmDevice] = {
        "gripper": TextGripperDevice(SimpleJaws(object_mm=object_mm or None)),
        "arm": TextArmDevice(),
    }
    servers = {name: await asyncio.start_server(serve(device), HOST, 0) for name, device in devices.items()}
    print(json.dumps({name: server.sockets[0].getsockname()[1] for name, server in servers.items()}), flush=True)
    await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(main(float(sys.argv[1])))
