"""Robotiq's URCap as clients of TCP port 63352 meet it. The URCap itself is not documented for this use.

Where each statement comes from. Script: what the URCap adds to each program of the panel (`rq_script`, as published in
cambel/robotiq, robotiq_urscript_set.ur). Example: ur_rtde's robotiq_gripper.py, after Robotiq's community page 1962.
UR: the URScript manual, socket_get_var and socket_set_var.

* Requests are lines, `SET NAME VALUE [NAME VALUE ...]` and `GET NAME` (example; UR for single values). A SET is
  answered by `ack`, three bytes without an end mark (script: it reads three), a GET by `NAME VALUE` (UR, example).
* ACT, GTO, ATR, ARD, FOR, SPE, POS are set; OBJ, STA, FLT, PRE and POS are the gripper's status (script, example). ARD
  is ADR in the example, so other names than ARD can be given here.
* `SET SID 9` selects the gripper with Modbus address 9 for the connection (script: rq_init_connection).
* Several clients are served; a program of the panel is one of them, on 127.0.0.1 (script).
* Assumed: the status is a copy that is refreshed periodically, and what was set is sent to the gripper with the next
  refresh, so that a stop and a go within one period cancel each other out; ACT, GTO, ATR, ARD, FOR and SPE are read as
  they were set. Values beyond 0 to 255 are limited, and acknowledged. Other requests are not answered. Values are `?`
  while the gripper does not respond. A restart of the URCap keeps the gripper's registers, and disconnects all clients.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from functools import partial

from slipguard.cancellation import TimerGroup
from slipguard_emulators.robotiq.registers import OUTPUTS, RACT, RARD, RATR, RGTO, GripperRegisters
from slipguard_emulators.stream_server import Client, StreamServer

STATUS = ("POS", "PRE", "OBJ", "STA", "FLT")
LINE_MAX = 1024


class UrcapPort(StreamServer):
    """The port and the variables behind it.

    occurs: returns whether a fault occurs now. answers: called with each request; returns whether the URCap answers.
    responds: returns whether the gripper responds to the URCap. refresh_s: period of the status. response_s, jitter_s:
    time to a response, and the largest random addition.
    """

    def __init__(
        self,
        host: str,
        port: int,
        registers: GripperRegisters,
        *,
        slave_id: int,
        refresh_s: float,
        response_s: float,
        jitter_s: float,
        late_s: float,
        occurs: Callable[[str], bool],
        answers: Callable[[float], bool],
        responds: Callable[[float], bool],
        note: Callable[..., None],
        seed: int,
    ) -> None:
        super().__init__((host, port), self._answer_lines)
        self._registers = registers
        self._slave_id = slave_id
        self._refresh_s, self._response_s, self._jitter_s, self._late_s = refresh_s, response_s, jitter_s, late_s
        self._occurs, self._answers, self._responds, self._note = occurs, answers, responds, note
        self._rng = random.Random(seed)
        self._timers = TimerGroup()
        self._status: dict[str, int] | None = None
        """The copy of the status; None while the gripper does not respond."""
        self._set: dict[str, int] = {}
        self._changed = False
        self.direction = "ARD"
        """Name of the direction of the automatic release."""

    def plug(self) -> None:
        """Start the URCap. Idempotent. Raises InputError if the port is in use."""
        if self.plugged:
            return
        super().plug()
        action, position, motion = self._registers.outputs
        bits = {"ACT": RACT, "GTO": RGTO, "ATR": RATR, self.direction: RARD}
        self._set = {name: int(bool(action >> 8 & bit)) for name, bit in bits.items()}
        self._set |= {"POS": position & 0xFF, "SPE": motion >> 8, "FOR": motion & 0xFF}
        self._refresh()

    def unplug(self) -> None:
        """Stop the URCap. Idempotent."""
        super().unplug()
        self._timers.cancel_all()

    def execute(self, line: str) -> str | None:
        """Execute a request of any client, such as a program of the panel; return the response, None for none."""
        verb, *words = line.split() or [""]
        if verb == "GET" and len(words) == 1:
            value = self._value(words[0])
            return None if value is None else f"{words[0]} {value}"
        if verb != "SET" or not words or len(words) % 2:
            return None
        try:
            values = {name: int(value) for name, value in zip(words[::2], words[1::2], strict=True)}
        except ValueError:
            return None
        if values.pop("SID", self._slave_id) != self._slave_id or not values.keys() <= self._set.keys():
            return None
        if not self._occurs("ignore"):
            self._set |= {name: min(max(value, 0), 255) for name, value in values.items()}
            self._changed = self._changed or bool(values)
        return "ack"

    def _value(self, name: str) -> int | str | None:
        if name in STATUS:
            return "?" if self._status is None else self._status[name]
        return self._set.get(name)

    def _refresh(self) -> None:
        """Send what was set, and copy the status."""
        now_s = asyncio.get_running_loop().time()
        self._timers.call_at(now_s + self._refresh_s, self._refresh)
        if not self._responds(now_s):
            self._status = None
            return
        if self._changed:
            self._changed = False
            bits = {"ACT": RACT, "GTO": RGTO, "ATR": RATR, self.direction: RARD}
            action = sum(bit for name, bit in bits.items() if self._set[name])
            words = [action << 8, self._set["POS"], self._set["SPE"] << 8 | self._set["FOR"]]
            due_s = self._registers.write(now_s, OUTPUTS[0], words)
            self._note("write", registers=[f"{word:04X}" for word in words], last_byte_s=round(now_s, 6))
            self._timers.call_at(due_s, lambda: self._registers.tick(asyncio.get_running_loop().time()))
        flags, fault_and_echo, position = self._registers.read(now_s)
        self._registers.request_received(now_s)
        self._status = {
            "STA": flags >> 12 & 3,
            "OBJ": flags >> 14 & 3,
            "FLT": fault_and_echo >> 8,
            "PRE": fault_and_echo & 0xFF,
            "POS": position >> 8,
        }

    async def _answer_lines(self, client: Client) -> None:
        reader, writer = client
        buffer, free_s = b"", 0.0
        while data := await reader.read(LINE_MAX):
            *lines, buffer = (buffer + data).split(b"\n")
            buffer = buffer[-LINE_MAX:]
            for line in lines:
                if not self._answers(asyncio.get_running_loop().time()) or self._occurs("deaf"):
                    continue
                response = self.execute(line.decode("ascii", "replace"))
                if response is not None and not self._occurs("silence"):
                    free_s = self._send(writer, response.encode(), free_s)

    def _send(self, writer: asyncio.StreamWriter, response: bytes, free_s: float) -> float:
        """Send a response after its delay and those before it; return when it will have been sent."""
        if self._occurs("garbage"):
            response = self._rng.randbytes(3) + response
        if self._occurs("half"):
            response = response[: len(response) // 2]
        if self._occurs("double"):
            response += response
        delay_s = self._response_s + self._rng.uniform(0.0, self._jitter_s)
        delay_s += self._late_s if self._occurs("late") else 0.0
        due_s = max(asyncio.get_running_loop().time() + delay_s, free_s)
        if self._occurs("split"):
            self._timers.call_at(due_s, partial(_write, writer, response[:-1]))
            response, due_s = response[-1:], due_s + 0.004
        self._timers.call_at(due_s, partial(_write, writer, response))
        return due_s


def _write(writer: asyncio.StreamWriter, data: bytes) -> None:
    if not writer.is_closing():
        writer.write(data)
