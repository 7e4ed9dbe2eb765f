"""Modbus RTU of the emulated gripper: decoding of requests, encoding of answers, checksum."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slipguard_emulators.robotiq.registers import INPUTS, OUTPUTS

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY, WRITE_AND_READ = 3, 4, 6, 16, 23


@dataclass(frozen=True, slots=True)
class ModbusRequest:
    """A decoded request: write `values` from `write_at` on, then read `count` registers.

    echo: the beginning of the answer to a write, without checksum.
    """

    slave: int
    function: int
    write_at: int = 0
    values: tuple[int, ...] = ()
    read_at: int = 0
    count: int = 0
    echo: bytes = b""

    @property
    def makes_sense(self) -> bool:
        """Whether the gripper has these registers; it does not answer other requests."""
        writes = range(self.write_at, self.write_at + len(self.values))
        reads = range(self.read_at, self.read_at + self.count)
        if self.values and not (writes[0] in OUTPUTS and writes[-1] in OUTPUTS):
            return False
        if self.count and not (reads[0] in INPUTS and reads[-1] in INPUTS):
            return False
        return bool(self.values or self.count)


def crc16(data: bytes) -> bytes:
    """Return the checksum of Modbus RTU, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return struct.pack("<H", crc)


def frame_bytes(data: bytes) -> int | None:
    """Return the size of the request at the start of `data`; None if too few bytes, 0 for an unknown function."""
    if len(data) < 2:
        return None
    function = data[1]
    if function in (READ_HOLDING, READ_INPUT, WRITE_ONE):
        return 8
    size_at = {WRITE_MANY: 6, WRITE_AND_READ: 10}.get(function)
    if size_at is None:
        return 0
    return None if len(data) <= size_at else size_at + 1 + data[size_at] + 2


def parse(frame: bytes) -> ModbusRequest | None:
    """Return the request; None if the checksum is wrong or the counts are inconsistent."""
    if crc16(frame[:-2]) != frame[-2:]:
        return None
    slave, function = frame[0], frame[1]
    if function in (READ_HOLDING, READ_INPUT):
        at, count = struct.unpack(">HH", frame[2:6])
        return ModbusRequest(slave, function, read_at=at, count=count)
    if function == WRITE_ONE:
        at, value = struct.unpack(">HH", frame[2:6])
        return ModbusRequest(slave, function, at, (value,), echo=frame[:6])
    if function == WRITE_MANY:
        at, count = struct.unpack(">HH", frame[2:6])
        return (
            None if frame[6] != 2 * count else ModbusRequest(slave, function, at, _words(frame[7:-2]), echo=frame[:6])
        )
    read_at, count, at, written = struct.unpack(">HHHH", frame[2:10])
    return (
        None if frame[10] != 2 * written else ModbusRequest(slave, function, at, _words(frame[11:-2]), read_at, count)
    )


def answer(request: ModbusRequest, read: Callable[[], Sequence[int]]) -> bytes:
    """Return the answer without checksum. read: returns the three input registers."""
    if not request.count:
        return request.echo
    first = request.read_at - INPUTS[0]
    values = read()[first : first + request.count]
    return struct.pack(f">BBB{len(values)}H", request.slave, request.function, 2 * len(values), *values)


def _words(data: bytes) -> tuple[int, ...]:
    return struct.unpack(f">{len(data) // 2}H", data)
