"""A Robotiq 2F-85 on a pseudo terminal: Modbus RTU written from the manual, sharing no code with the driver.

It keeps the habits that matter: activation moves the fingers all the way, a new force acts only while they move, a
request it does not like is met with silence. `mute`, `delay_s`, `bad_crc`, `split` and `unplug()` spoil the line.
"""

from __future__ import annotations

import asyncio
import os
import pty
import struct
import tty
from pathlib import Path

SLAVE = 9
OUTPUTS = range(0x03E8, 0x03EB)
INPUTS = range(0x07D0, 0x07D3)
COUNTS_PER_S = 1500.0
DEAD_TIME_S = 0.02
ACTIVATION_S = 0.15
CLOSED_END = 230.0
OPEN_END = 3.0


def crc16(data: bytes) -> bytes:
    """Modbus CRC, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return struct.pack("<H", crc)


class Fingers:
    """The mechanics behind the registers. object_at: position count at which something stops them."""

    def __init__(self) -> None:
        self.position = OPEN_END
        self.object_at: float | None = None
        self.grip = 0
        """Force count that the motor last pressed with; 0 with nothing held."""
        self.fault = 0
        self.activations = 0
        self.writes: list[list[int]] = []
        self._registers = [0, 0, 0]
        self._active_at_s: float | None = None
        self._starts_at_s: float | None = None
        self._updated_at_s = 0.0
        self._object_flag = 0

    @property
    def going(self) -> bool:
        return bool(self._registers[0] >> 8 & 0x08)

    def write(self, registers: list[int], now_s: float) -> None:
        self.update(now_s)
        self.writes.append(registers)
        was_going, old_target = self.going, self._registers[1] & 0xFF
        self._registers = registers
        if not registers[0] >> 8 & 0x01:
            self._active_at_s, self._starts_at_s, self.fault, self._object_flag = None, None, 0, 0
            return
        if self._active_at_s is None:
            self.activations += 1
            self._active_at_s = now_s + ACTIVATION_S
            self.position, self.grip = OPEN_END, 0
        if not self.going:
            self._starts_at_s = None
        elif not was_going or old_target != registers[1] & 0xFF:
            self._starts_at_s = now_s + DEAD_TIME_S
            self._object_flag = 0

    def update(self, now_s: float) -> None:
        dt_s, self._updated_at_s = now_s - self._updated_at_s, now_s
        if self._starts_at_s is None or now_s < self._starts_at_s:
            return
        target = min(max(float(self._registers[1] & 0xFF), OPEN_END), CLOSED_END)
        step = min(COUNTS_PER_S * dt_s, abs(target - self.position))
        if target < self.position:
            self.position, self.grip = self.position - step, 0
        elif self.object_at is not None and self.position <= self.object_at < self.position + step + 1e-9:
            self.position, self._object_flag = self.object_at, 2
            self.grip = max(self.grip, self._registers[2] & 0xFF)
            self._starts_at_s = None
            return
        else:
            self.position += step
        if self.position == target:
            self._object_flag, self._starts_at_s = 3, None

    def status(self, now_s: float) -> list[int]:
        self.update(now_s)
        activated = self._active_at_s is not None
        state = 0 if self._active_at_s is None else 3 if now_s >= self._active_at_s else 1
        flags = activated | self.going << 3 | state << 4 | self._object_flag << 6
        current = 10 if self._starts_at_s is not None else 0
        return [flags << 8, self.fault << 8 | self._registers[1] & 0xFF, int(self.position) << 8 | current]


class RobotiqEmulator:
    """The gripper on a line: `path` is a stable name of its serial port, as udev's by-id names are."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.fingers = Fingers()
        self.mute = False
        self.bad_crc = False
        self.split = False
        self.delay_s = 0.0
        self.requests = 0
        self._buffer = b""
        self._master: int | None = None
        self.plug()

    def plug(self) -> None:
        """Appear as a serial port."""
        self._master, slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)
        asyncio.get_running_loop().add_reader(self._master, self._on_bytes)

    def unplug(self) -> None:
        """Vanish, as an adapter pulled out does. Idempotent."""
        if self._master is not None:
            asyncio.get_running_loop().remove_reader(self._master)
            os.close(self._master)
            self.path.unlink()
            self._master = None

    def _on_bytes(self) -> None:
        assert self._master is not None
        try:
            self._buffer += os.read(self._master, 4096)
        except OSError:  # nobody has the other end open
            return
        while len(self._buffer) >= 8:
            size = 9 + self._buffer[6] if self._buffer[1] == 16 else 8
            if len(self._buffer) < size:
                return
            request, self._buffer = self._buffer[:size], self._buffer[size:]
            if crc16(request[:-2]) == request[-2:] and request[0] == SLAVE:
                self.requests += 1
                if not self.mute:
                    asyncio.get_running_loop().call_later(self.delay_s, self._send, self._answer(request))

    def _answer(self, request: bytes) -> bytes:
        """What the gripper says, without CRC; empty for a request that it does not understand."""
        now_s = asyncio.get_running_loop().time()
        function, address, count = struct.unpack(">BHH", request[1:6])
        wanted = range(address, address + count)
        if function in (3, 4) and wanted and wanted[0] in INPUTS and wanted[-1] in INPUTS:
            values = self.fingers.status(now_s)[address - INPUTS[0] :][:count]
            return struct.pack(f">BBB{count}H", SLAVE, function, 2 * count, *values)
        if function == 16 and wanted == OUTPUTS:
            self.fingers.write(list(struct.unpack(">3H", request[7:13])), now_s)
            return request[:6]
        return b""

    def _send(self, answer: bytes) -> None:
        if self._master is None or not answer:
            return
        frame = answer + crc16(answer)
        if self.bad_crc:
            frame = frame[:-1] + bytes([frame[-1] ^ 0x55])
        cut = 3 if self.split else len(frame)
        os.write(self._master, frame[:cut])
        if self.split:
            asyncio.get_running_loop().call_later(0.004, os.write, self._master, frame[cut:])
