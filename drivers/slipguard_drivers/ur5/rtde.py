"""RTDE version 2 as a client: one connection, its handshake, its recipes. Takes nothing from anybody that is not asked.

Small enough to own, so that no vendor library is needed where the arm is only watched: no constructor that holds the
interpreter, no script, no input registers, and every wait has a deadline.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
from collections.abc import Sequence

from slipguard.errors import CommandRefused, DeviceLost

PORT = 30004
CONNECT_S = 0.5
ANSWER_S = 0.4
"""Fifty cycles of a CB3 controller, on a cable."""
LARGEST_BYTES = 4096
"""No message that was asked for here is longer."""
KNOWN = b"VvOISPUM"


class RtdeConnection:
    """One TCP connection. Raises DeviceLost whenever the controller is gone, silent, or speaks nonsense."""

    def __init__(self, name: str, host: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._name, self._host = name, host
        self._reader, self._writer = reader, writer
        self.version = (0, 0, 0, 0)

    @classmethod
    async def connect(cls, name: str, host: str) -> RtdeConnection:
        """Connect and agree on the protocol's version; `version` then is that of the controller's software."""
        connection = cls(name, host, *await reach(name, host, PORT, "RTDE"))
        try:
            if await connection._request("V", struct.pack(">H", 2)) != b"\x01":
                raise DeviceLost(f"{name}: {host} does not speak RTDE version 2; PolyScope 3.5 or newer is needed")
            connection.version = struct.unpack(">4I", await connection._request("v", b""))
        except struct.error:
            connection.close()
            raise connection._nonsense() from None
        except BaseException:
            connection.close()
            raise
        return connection

    async def outputs(self, variables: Sequence[tuple[str, str]], rate_hz: float) -> None:
        """Ask for (name, type) pairs so often. Raises DeviceLost naming those that this controller has not."""
        names = ",".join(name for name, _ in variables)
        answer = await self._request("O", struct.pack(">d", rate_hz) + names.encode())
        kinds = answer[1:].decode("ascii", "replace").split(",")
        wrong = [f"{name} ({kind})" for (name, wanted), kind in zip(variables, kinds, strict=False) if kind != wanted]
        if wrong or len(kinds) != len(variables):
            missing = ", ".join(wrong) or "all variables"
            raise DeviceLost(f"{self._name}: {self._host} does not offer {missing}; its software is too old")

    async def inputs(self, names: Sequence[str]) -> int:
        """Take inputs for this connection alone, until it closes; returns the recipe's number for `send`.

        Raises CommandRefused where somebody else has them.
        """
        answer = await self._request("I", ",".join(names).encode())
        kinds = answer[1:].decode("ascii", "replace").split(",")
        taken = [name for name, kind in zip(names, kinds, strict=False) if kind == "IN_USE"]
        if taken:
            raise CommandRefused(
                f"{self._name}: another program holds {', '.join(taken)} of the robot; usual holders are a ROS driver, "
                "EtherNet/IP or PROFINET (switch them off in the installation), or a gripper's URCap"
            )
        if not answer or not answer[0]:
            raise DeviceLost(f"{self._name}: {self._host} does not take {', '.join(names)}: {answer[1:]!r}")
        return answer[0]

    async def start(self) -> None:
        """Let the data come."""
        if await self._request("S", b"") != b"\x01":
            raise DeviceLost(f"{self._name}: {self._host} does not start its RTDE data")

    def send(self, recipe: int, values: bytes) -> None:
        """Set the inputs of a recipe."""
        self._writer.write(struct.pack(">HBB", 4 + len(values), ord("U"), recipe) + values)

    async def data(self) -> bytes:
        """The next data, without its recipe's number. Waits as long as it takes."""
        while True:
            kind, payload = await self._message()
            if kind == "U":
                return payload[1:]

    def close(self) -> None:
        """Hang up at once; what this connection had taken is free again. Idempotent."""
        self._writer.transport.abort()

    async def _request(self, kind: str, payload: bytes) -> bytes:
        self._writer.write(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
        try:
            async with asyncio.timeout(ANSWER_S):
                while True:
                    answered, answer = await self._message()
                    if answered == kind:
                        return answer
        except TimeoutError:
            raise DeviceLost(
                f"{self._name}: {self._host}:{PORT} (RTDE) accepts a connection and does not answer; is the "
                "controller still starting?"
            ) from None

    async def _message(self) -> tuple[str, bytes]:
        try:
            size, kind = struct.unpack(">HB", await self._reader.readexactly(3))
            if not 3 <= size <= LARGEST_BYTES or kind not in KNOWN:
                raise self._nonsense()
            return chr(kind), await self._reader.readexactly(size - 3)
        except (asyncio.IncompleteReadError, OSError):
            raise DeviceLost(f"{self._name}: {self._host} has closed the RTDE connection; open it again") from None

    def _nonsense(self) -> DeviceLost:
        return DeviceLost(f"{self._name}: what {self._host}:{PORT} sends is no RTDE; is that the robot's address?")


async def reach(name: str, host: str, port: int, what: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A TCP connection, or DeviceLost in words."""
    try:
        async with asyncio.timeout(CONNECT_S):
            return await asyncio.open_connection(host, port)
    except TimeoutError:
        why = f"no answer within {CONNECT_S:g} s"
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else str(error)  # asyncio's own words are for programmers
    raise DeviceLost(
        f"{name}: no answer from {host}:{port} ({what}): {why}; check the robot's power, network cable and address, "
        f"and that {what} is enabled in its security settings"
    ) from None


async def check_port(name: str, host: str, port: int, what: str) -> None:
    """Whether something listens there; raises DeviceLost in words."""
    _, writer = await reach(name, host, port, what)
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
