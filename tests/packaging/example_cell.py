"""A cell for the example drivers of drivers/README.md: `python example_cell.py` simulates what a user would connect.

Two webcams (640x480, MJPEG over HTTP), a gripper on TCP that understands lines of text, and a wrench between its jaws.
Prints the addresses as JSON. `lift MM` on standard input moves the arm, as a robot's own program would; `truth` prints
the true state. It runs until standard input ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from dataclasses import asdict

import cv2
from example_devices import HOST, Client, TextGripperDevice, serve

from slipguard.devices import DriverContext, TactileSensor
from slipguard.errors import DeviceTimeout
from slipguard.registry import load_driver
from slipguard.sim.scenario import scenario
from slipguard_emulators.cell.emulator import CellWorld
from slipguard_emulators.cell.world_jaws import WorldJaws

FPS = 30.0
LIFT_SPEED_MM_S = 50.0
HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
PART = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n"


def webcam(sensor: TactileSensor) -> Client:
    """Return the handler of a client of a webcam that is mounted with its long side upright."""

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            await reader.readuntil(b"\r\n\r\n")
            writer.write(HEAD)
            while True:
                with contextlib.suppress(DeviceTimeout):
                    frame = await sensor.next_frame()
                    landscape = cv2.resize(cv2.rotate(frame.image, cv2.ROTATE_90_CLOCKWISE), (640, 480))
                    jpeg = cv2.imencode(".jpg", landscape, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
                    writer.write(PART % len(jpeg) + jpeg + b"\r\n")
                    await writer.drain()
        writer.close()

    return handle


async def main() -> None:
    loop = asyncio.get_running_loop()
    world = CellWorld(0, FPS)
    world.place(scenario("wrench", 0), loop.time())
    simulated = load_driver("slipguard.tactile", "fake")
    sensors = {name: simulated(simulated.Settings(), DriverContext(name, world)) for name in ("left", "right")}
    for sensor in sensors.values():
        await sensor.open()
    clients = {name: webcam(sensor) for name, sensor in sensors.items()}
    clients["gripper"] = serve(TextGripperDevice(WorldJaws(world)))
    servers = {name: await asyncio.start_server(client, HOST, 0) for name, client in clients.items()}
    print(json.dumps({name: server.sockets[0].getsockname()[1] for name, server in servers.items()}), flush=True)
    while words := (await asyncio.to_thread(sys.stdin.readline)).split():
        if words[0] == "lift":
            world.command_lift(loop.time(), float(words[1]), LIFT_SPEED_MM_S)
        print(json.dumps(asdict(world.truth(loop.time())), default=str), flush=True)
    for sensor in sensors.values():
        await sensor.close()


if __name__ == "__main__":
    asyncio.run(main())
