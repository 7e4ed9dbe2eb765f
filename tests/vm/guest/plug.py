"""Plugs emulated sensors into this kernel, as `usbip attach` would, and loads the camera drivers."""

from __future__ import annotations

import asyncio
import socket
import struct
import subprocess
from pathlib import Path

VHCI = Path("/sys/devices/platform/vhci_hcd.0")
VERSION, IMPORT = 0x0111, 0x8003
DEVICE_BYTES = 312
NUMBERS_AT = 288
"""Where bus number, device number and speed stand in the description of the device."""


def modprobe(*words: str) -> None:
    """Load a kernel module with its options."""
    subprocess.run(["modprobe", *words], check=True)


def settle() -> None:
    """Wait until udev has dealt with what came and went."""
    subprocess.run(["udevadm", "settle"], check=True)


async def attach(port: int, bus_id: str = "1-1", slot: int = 0) -> None:
    """Import a device of the server on this machine into one of the virtual hub's ports."""
    loop = asyncio.get_running_loop()
    with socket.create_connection(("127.0.0.1", port)) as link:
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await loop.sock_sendall(link, struct.pack(">HHI32s", VERSION, IMPORT, 0, bus_id.encode()))
        answer = b""
        while len(answer) < 8 + DEVICE_BYTES:
            piece = await loop.sock_recv(link, 8 + DEVICE_BYTES - len(answer))
            assert piece, f"{bus_id} was refused: {answer!r}"
            answer += piece
        bus, device, speed = struct.unpack_from(">III", answer, 8 + NUMBERS_AT)
        link.setblocking(True)
        (VHCI / "attach").write_text(f"{slot} {link.fileno()} {bus << 16 | device} {speed}")
