"""A USB/IP server: a Linux kernel with vhci-hcd attaches a device that is implemented in software.

Protocol: Documentation/usb/usbip_protocol.rst of the kernel, version 1.1.1. All numbers are big endian. A connection
starts with a handshake (list the devices; import one); then it carries the requests to the imported device's endpoints.
The client is `usbip attach -r HOST -b 1-1`. The end of the connection unplugs the device.
"""

from __future__ import annotations

import asyncio
import struct
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from slipguard_emulators.stream_server import Client

VERSION = 0x0111
LIST_REQUEST, LIST_REPLY, IMPORT_REQUEST, IMPORT_REPLY = 0x8005, 0x0005, 0x8003, 0x0003
SUBMIT, UNLINK, SUBMIT_REPLY, UNLINK_REPLY = 1, 2, 3, 4
HIGH_SPEED = 3
EPIPE, ECONNRESET = 32, 104
STARTED_BYTES = 48
OPERATION = struct.Struct(">HHI")
COMMAND = struct.Struct(">5I")
SUBMITTED = struct.Struct(">Iiiii8s")
RETURNED = struct.Struct(">5I5i8x")
UNLINKED = struct.Struct(">5Ii24x")
DEVICE = struct.Struct(">256s32sIIIHHHBBBBBB")
REQUEST_MAX_BYTES = 1 << 20


class BulkInEndpoint:
    """The host's pending reads on the device's streaming endpoint."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self._reads: deque[tuple[int, int]] = deque()
        self._wanted = asyncio.Event()
        self._withdrawn = 0

    @property
    def wanted(self) -> bool:
        """Whether the host has pending reads, as it has while it streams."""
        return bool(self._reads)

    async def until_wanted(self) -> None:
        """Wait until the host reads."""
        await self._wanted.wait()

    def ask(self, number: int, length: int) -> None:
        """Add a pending read of up to `length` bytes."""
        self._reads.append((number, length))
        self._wanted.set()

    def withdraw(self, number: int) -> bool:
        """Remove a pending read; return False if it was answered already."""
        kept = deque(read for read in self._reads if read[0] != number)
        found = len(kept) < len(self._reads)
        self._reads = kept
        self._withdrawn += 1
        if not kept:
            self._wanted.clear()
        return found

    async def send(self, payload: bytes, *, full: bool) -> None:
        """Answer as many reads as necessary; drop the rest if the host stops reading meanwhile.

        full: the payload has the negotiated size, so its end needs no short response.
        """
        sent, ended, withdrawn = 0, False, self._withdrawn
        while not ended:
            await self._wanted.wait()
            if withdrawn != self._withdrawn:
                return
            number, length = self._reads.popleft()
            if not self._reads:
                self._wanted.clear()
            piece = payload[sent : sent + length]
            sent += len(piece)
            ended = len(piece) < length or (full and sent == len(payload))
            self._writer.write(returned(number, 0, piece, len(piece)))


class EarlyUnlinks:
    """Requests that Linux unlinks before it has sent them, because its threads may overtake each other.

    The unlink is answered when the request arrives. If it were answered before, the kernel might end the connection
    because of an unexpected response, or wait for one forever.
    """

    def __init__(self) -> None:
        self._newest = 0
        self._kept: dict[int, int] = {}

    def keep(self, victim: int, number: int) -> bool:
        """Keep unlink `number` of request `victim` if that request has not arrived yet; numbers only rise."""
        if victim <= self._newest:
            return False
        self._kept[victim] = number
        return True

    def submitted(self, number: int) -> int | None:
        """Register a request; return the unlink that preceded it, if there is one."""
        self._newest = max(self._newest, number)
        return self._kept.pop(number, None)


class UsbDevice(Protocol):
    """A device that the server can export."""

    @property
    @abstractmethod
    def identity(self) -> tuple[int, int, int]:
        """Vendor, product and release number."""

    @property
    @abstractmethod
    def plugged(self) -> bool:
        """Whether it can be imported now."""

    @abstractmethod
    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """Execute a request on endpoint 0 and return its response; None is a stall."""

    @abstractmethod
    async def stream(self, bulk: BulkInEndpoint) -> None:
        """Feed the streaming endpoint until cancelled."""

    @abstractmethod
    def attached(self, connection: asyncio.StreamWriter | None) -> None:
        """React to the host's connection; None: the host has detached the device."""


def returned(number: int, status: int, data: bytes, length: int) -> bytes:
    """Return the response to request `number`."""
    return RETURNED.pack(SUBMIT_REPLY, number, 0, 0, 0, status, length, 0, 0, 0) + data


def unlinked(number: int, status: int) -> bytes:
    """Return the response to unlink `number`."""
    return UNLINKED.pack(UNLINK_REPLY, number, 0, 0, 0, status)


class UsbIpServer:
    """Serves devices by bus id ("1-1", "1-2", ...), each to one host at a time."""

    def __init__(self, devices: Mapping[str, UsbDevice]) -> None:
        self._devices = devices
        self._taken: set[str] = set()

    async def serve(self, client: Client) -> None:
        """Serve one connection."""
        reader, writer = client
        _, code, _ = OPERATION.unpack(await reader.readexactly(OPERATION.size))
        if code == LIST_REQUEST:
            there = [(bus_id, device) for bus_id, device in self._devices.items() if device.plugged]
            writer.write(OPERATION.pack(VERSION, LIST_REPLY, 0) + struct.pack(">I", len(there)))
            for bus_id, device in there:
                writer.write(_described(bus_id, device) + bytes.fromhex("0e010000 0e020000"))
            await writer.drain()
            return
        if code != IMPORT_REQUEST:
            return
        bus_id = (await reader.readexactly(32)).rstrip(b"\0").decode("ascii", "replace")
        wanted = self._devices.get(bus_id)
        if wanted is None or not wanted.plugged or bus_id in self._taken:
            writer.write(OPERATION.pack(VERSION, IMPORT_REPLY, 1))
            await writer.drain()
            return
        writer.write(OPERATION.pack(VERSION, IMPORT_REPLY, 0) + _described(bus_id, wanted))
        self._taken.add(bus_id)
        bulk, early = BulkInEndpoint(writer), EarlyUnlinks()
        streaming = asyncio.create_task(wanted.stream(bulk), name=f"{bus_id}: stream")
        wanted.attached(writer)
        try:
            while True:
                await _request(reader, writer, wanted, bulk, early)
        finally:
            self._taken.discard(bus_id)
            wanted.attached(None)
            streaming.cancel()
            await asyncio.gather(streaming, return_exceptions=True)


async def _request(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    device: UsbDevice,
    bulk: BulkInEndpoint,
    early: EarlyUnlinks,
) -> None:
    """Execute one request of the host to the imported device."""
    head = await reader.readexactly(STARTED_BYTES)
    command, number, _, is_read, endpoint = COMMAND.unpack_from(head)
    if command == UNLINK:
        (victim,) = struct.unpack_from(">I", head, COMMAND.size)
        if not early.keep(victim, number):
            writer.write(unlinked(number, -ECONNRESET if bulk.withdraw(victim) else 0))
        return
    _, length, _, _, _, setup = SUBMITTED.unpack_from(head, COMMAND.size)
    if command != SUBMIT or not 0 <= length <= REQUEST_MAX_BYTES:
        raise ConnectionError(f"command {command} of {length} bytes is not USB/IP")
    data = b"" if is_read else await reader.readexactly(length)
    if (unlink := early.submitted(number)) is not None:
        writer.write(unlinked(unlink, -ECONNRESET))
        return
    if endpoint != 0:
        bulk.ask(number, length)
        return
    answer = device.control(setup, data)
    if answer is None:
        writer.write(returned(number, -EPIPE, b"", 0))
    else:
        writer.write(returned(number, 0, answer, len(answer)) if is_read else returned(number, 0, b"", length))


def _described(bus_id: str, device: UsbDevice) -> bytes:
    """Return 312 bytes about one device. The kernel identifies it by bus and device number."""
    bus, _, port = bus_id.partition("-")
    vendor, product, release = device.identity
    path = f"/sys/devices/emulated/{bus_id}".encode()
    ids = (vendor, product, release, 0xEF, 2, 1, 1, 1, 2)
    return DEVICE.pack(path, bus_id.encode(), int(bus), int(port) + 1, HIGH_SPEED, *ids)
