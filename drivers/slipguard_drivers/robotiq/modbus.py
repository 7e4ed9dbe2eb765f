"""Modbus RTU, through a serial adapter of this computer or the RS-485 forwarder on the robot.

The forwarder is a URCap by Universal Robots: bytes on TCP port 54321 are those of the tool connector. It relays them
with socat, which connects a second client, but keeps it waiting until the first has left (its daemon script:
`socat tcp-l:54321,reuseaddr,fork file:/dev/ttyTool,nonblock,raw,waitlock=/var/run/tty`).

Modbus RTU has no transaction number: after a time-out, a late response would be taken for the response to the next
request, and every response would stay one behind. Therefore:

* only one request is on the line at a time;
* only a response that begins as expected and has the expected size and checksum is accepted;
* after anything but a good response, and on a new connection, the line counts as out of sync. It must then be silent
  for a while, and a probe with a response of another size than the previous probe must be answered first. A slave
  answers in order, so by then every late response has arrived or never will.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle

import structlog

from slipguard.diagnosis import CheckResult, ok
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import registers, serial_port
from slipguard_drivers.robotiq.byte_line import BLOCKED_S, ByteLine, PortBlockedError, is_tcp
from slipguard_drivers.robotiq.registers import RobotiqCommand, RobotiqStatus
from slipguard_drivers.robotiq.transport import TIMEOUT_TRIPS, GripperTransport

REQUEST_PERIOD_S = 0.005
"""From one request to the next: the manual's minimum."""
PAUSE_S = 0.00175
"""From a response to the next request: 3.5 characters, never less than this by the standard."""
SILENCE_S = 0.1
"""After a time-out, or longer if the measured round trip needs it; the slowest adapter (16 ms latency timer) with the
slowest gripper answers well within it."""
log = structlog.get_logger()
READ, WRITE = 4, 16
CRC_BYTES = 2
BRIEF_USE_S = 0.05
"""A program that has the port open for a shorter time only inspects it, as udev and emulated grippers do."""


@dataclass(frozen=True, slots=True)
class ExpectedResponse:
    """The first bytes of a response and its size, checksum included; response: its bytes, once it is complete."""

    head: bytes
    size: int
    response: asyncio.Future[bytes]


class ModbusConnection(GripperTransport):
    """Reads and writes 16-bit registers of one slave.

    port: a device file, or `socket://HOST:PORT` of a forwarder.
    """

    def __init__(self, name: str, port: str, slave_id: int, timeout_s: float) -> None:
        super().__init__(timeout_s)
        self._name = name
        self._port = port
        self._slave_id = slave_id
        self._probe_sizes = cycle((1, 2))
        self._line = ByteLine(port, self._on_bytes, self._on_lost)
        self._exclusive = False
        """Whether no other program has the port open."""
        self._lock = asyncio.Lock()
        self._free_at_s = 0.0
        self._out_of_sync = False
        self._silent_since_s = 0.0
        """When the line went out of sync, or when the last byte after that arrived."""
        self._expected: ExpectedResponse | None = None
        self._received = b""
        """Bytes that have arrived since the current request."""

    @property
    def connected(self) -> bool:
        """Whether the port is open, and a serial one for this program alone; a silent gripper is `connected`, too."""
        return self._exclusive and self._line.is_open

    async def connect(self) -> None:
        """Open the port for exclusive use. Raises DeviceLost with the reason, or the program that holds it.

        Neither a lock nor exclusive use excludes a program that opened the port before without a lock, and two masters
        could open a grip. So other programs are searched before anything is sent; see `serial_port.other_holders`.
        """
        self.close()
        try:
            await self._line.open()
        except OSError as error:
            if is_tcp(self._port):
                raise self._no_forwarder(error) from None
            if isinstance(error, PortBlockedError):
                raise self._blocked() from None
            why = await asyncio.to_thread(serial_port.why_not_usable, self._port)
            raise DeviceLost(f"{self._name}: {self._port} cannot be opened: {why}") from None
        if not is_tcp(self._port):
            await self._check_holders()
            if slow := serial_port.slow_adapter(self._port):
                log.warning(f"{self._name}: {slow}")
        self._lose_sync()  # the previous user of the port may have left a request that is still to be answered
        self._exclusive = True

    async def _check_holders(self) -> None:
        """Close the port again if another program has it open."""
        try:
            if await asyncio.to_thread(serial_port.other_holders, self._port):
                await asyncio.sleep(BRIEF_USE_S)
                if holders := await asyncio.to_thread(serial_port.other_holders, self._port):
                    raise DeviceLost(f"{self._name}: {self._port} is not used: {serial_port.holders_text(holders)}")
        except BaseException:  # includes a cancelled search
            self._line.close()
            raise

    def close(self) -> None:
        """Begin to close the port. Idempotent."""
        self._exclusive = False
        self._line.close()

    async def closed(self) -> None:
        """Wait until the port is closed, but not for a wedged adapter."""
        await self._line.settled()

    async def read_status(self, deadline_s: float) -> RobotiqStatus:
        """Read the three input registers."""
        return registers.decode(await self.read(registers.INPUT_ADDRESS, registers.REGISTERS, deadline_s))

    async def write_command(self, command: RobotiqCommand, deadline_s: float) -> None:
        """Write the three output registers."""
        await self.write(registers.OUTPUT_ADDRESS, registers.encode(command), deadline_s)

    def diagnose(self) -> Iterator[CheckResult]:
        """Check the serial port, without opening it; a forwarder serves one client, so it is only named."""
        if not is_tcp(self._port):
            yield from serial_port.check_serial_port(self._port)
            return
        yield ok("port", f"{self._port}, the RS-485 forwarder on the robot; it must be slipguard's alone")

    async def read(self, address: int, count: int, deadline_s: float) -> list[int]:
        """Read input registers (function 4). Raises DeviceTimeout or DeviceLost."""
        async with self._lock:
            await self._prepare_request(deadline_s)
            return await self._read(address, count)

    async def write(self, address: int, values: list[int], deadline_s: float) -> None:
        """Write holding registers (function 16). After DeviceTimeout or DeviceLost, what was written is unknown."""
        async with self._lock:
            await self._prepare_request(deadline_s)
            head = struct.pack(">BBHH", self._slave_id, WRITE, address, len(values))
            content = struct.pack(f">B{len(values)}H", 2 * len(values), *values)
            try:
                await self._exchange(head + content, head, len(head) + CRC_BYTES)
            except DeviceError as error:
                raise type(error)(f"{error}; the gripper may have executed the command") from None

    def _blocked(self) -> DeviceLost:
        return DeviceLost(
            f"{self._name}: the adapter on {self._port} does not respond: opening or closing the port takes more "
            f"than {BLOCKED_S:g} s; unplug it and plug it in again"
        )

    def _no_forwarder(self, error: OSError) -> DeviceLost:
        return DeviceLost(
            f"{self._name}: {self._port} does not accept connections ({error.strerror or 'no answer'}); check the "
            "robot's address and power, and that the URCap rs485 (PolyScope X: tool-comm-forwarder) is installed and on"
        )

    async def _read(self, address: int, count: int) -> list[int]:
        request = struct.pack(">BBHH", self._slave_id, READ, address, count)
        head = bytes([self._slave_id, READ, 2 * count])
        response = await self._exchange(request, head, len(head) + 2 * count + CRC_BYTES)
        return list(struct.unpack_from(f">{count}H", response, len(head)))

    async def _prepare_request(self, deadline_s: float) -> None:
        """Keep the distance between requests, and synchronize the line if necessary."""
        await self._wait_until_free()
        self._line.receive()
        if self._out_of_sync:
            while (left_s := self._silence_left_s()) > 0.0:
                self._check_time(left_s + 2.0 * self.timeout_s, deadline_s)
                await asyncio.sleep(left_s)
            self._out_of_sync = False
            await self._read(registers.INPUT_ADDRESS, next(self._probe_sizes))
            await self._wait_until_free()
            self._line.receive()
            if self._out_of_sync:
                self._lose_sync()
                raise DeviceTimeout(f"{self._name}: more bytes arrived than were requested; check the cable")
        self._check_time(self.timeout_s, deadline_s)

    def _silence_left_s(self) -> float:
        """Return how long the line must still be silent."""
        self._line.receive()  # bytes that arrived during a late cycle of the loop
        return (
            self._silent_since_s
            + max(SILENCE_S, TIMEOUT_TRIPS * (self.read_s or 0.0))
            - asyncio.get_running_loop().time()
        )

    def _check_time(self, needed_s: float, deadline_s: float) -> None:
        if asyncio.get_running_loop().time() + needed_s > deadline_s:
            raise DeviceTimeout(
                f"{self._name}: {self._port} is too slow or never silent; check whether another master uses the line"
            )

    async def _wait_until_free(self) -> None:
        await asyncio.sleep(self._free_at_s - asyncio.get_running_loop().time())

    async def _exchange(self, request: bytes, head: bytes, size: int) -> bytes:
        """Send a request and return its response. head, size: of the response."""
        loop = asyncio.get_running_loop()
        if not self.connected:
            raise self._connection_lost()
        self._free_at_s = loop.time() + REQUEST_PERIOD_S
        self._received = b""
        response: asyncio.Future[bytes] = loop.create_future()
        self._expected = ExpectedResponse(head, size, response)
        try:
            self._line.write(request + crc(request))
            async with asyncio.timeout(self.timeout_s):
                return await response
        except TimeoutError:
            self._lose_sync()
            raise self._no_response(b"" if response.done() else self._received) from None
        except OSError:
            raise self._connection_lost() from None
        finally:
            self._expected = None
            self._free_at_s = max(self._free_at_s, loop.time() + PAUSE_S)

    def _on_bytes(self, data: bytes) -> None:
        """Accept the expected response as soon as it is complete. Any other byte puts the line out of sync."""
        expected = self._expected
        if expected is None:
            self._lose_sync()
            return
        self._received += data
        frame = self._received[: expected.size]
        begins_well = frame[: len(expected.head)] == expected.head[: len(frame)]
        if begins_well and len(frame) < expected.size:
            return
        if len(self._received) > expected.size or not begins_well or crc(frame[:-CRC_BYTES]) != frame[-CRC_BYTES:]:
            self._lose_sync()
        if begins_well and crc(frame[:-CRC_BYTES]) == frame[-CRC_BYTES:] and not expected.response.done():
            expected.response.set_result(frame)

    def _on_lost(self) -> None:
        if self._expected is not None and not self._expected.response.done():
            self._expected.response.set_exception(self._connection_lost())

    def _lose_sync(self) -> None:
        self._out_of_sync = True
        self._silent_since_s = asyncio.get_running_loop().time()

    def _no_response(self, received: bytes) -> DeviceTimeout:
        if received:
            return DeviceTimeout(
                f"{self._name}: {received[:16].hex(' ')} is not the expected response; check the cable"
            )
        return DeviceTimeout(
            f"{self._name}: no response within {self.timeout_s * 1000:.0f} ms from slave {self._slave_id} on "
            f"{self._port}; check the gripper's power and {self._to_check}"
        )

    @property
    def _to_check(self) -> str:
        if not is_tcp(self._port):
            return "the cable"
        return (
            "the robot's Tool I/O (controlled by User, 24 V, 115200 baud, no parity, one stop bit), and that no other "
            "program or URCap uses the tool's RS-485"
        )

    def _connection_lost(self) -> DeviceLost:
        self.close()
        return DeviceLost(f"{self._name}: the connection on {self._port} is gone; open it again")


def crc(data: bytes) -> bytes:
    """Return the checksum of a frame: CRC-16/MODBUS, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return struct.pack("<H", value)
