"""Client of RTDE version 2: one connection, its handshake and its recipes.

It is small enough to own. A vendor library would block the interpreter in its constructors, upload a script and claim
input registers; here every wait has a time-out, and nothing is claimed without a request.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import struct
from collections.abc import Sequence

from slipguard.errors import CommandRefused, DeviceLost
from slipguard.host_lookup import resolve_host

PORT = 30004
RATE_HZ = 125.0
"""The full rate of a CB3 controller, a quarter of an e-Series controller's."""
CONNECT_TIMEOUT_S = 0.5
RESPONSE_TIMEOUT_S = 0.4
"""Fifty cycles of a CB3 controller, on a cable."""
MESSAGE_MAX_BYTES = 4096
"""No message that is requested here is longer."""
MESSAGE_TYPES = b"VvOISPUM"


class RtdeConnection:
    """One TCP connection. Raises DeviceLost if the controller is gone, silent, or does not speak RTDE."""

    def __init__(self, name: str, host: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._name, self._host = name, host
        self._reader, self._writer = reader, writer
        self.version = (0, 0, 0, 0)
        """Version of the controller's software; known after `connect`."""

    @classmethod
    async def connect(cls, name: str, host: str) -> RtdeConnection:
        """Connect, agree on the protocol's version, and read the version of the controller's software."""
        connection = cls(name, host, *await connect_tcp(name, host, PORT, "RTDE"))
        try:
            if await connection._request("V", struct.pack(">H", 2)) != b"\x01":
                raise DeviceLost(f"{name}: {host} does not speak RTDE version 2; PolyScope 3.5 or newer is needed")
            connection.version = struct.unpack(">4I", await connection._request("v", b""))
        except struct.error:
            connection.close()
            raise connection._not_rtde() from None
        except BaseException:
            connection.close()
            raise
        return connection

    async def request_outputs(self, variables: Sequence[tuple[str, str]]) -> None:
        """Request variables, given as (name, type). Raises DeviceLost naming those that the controller lacks."""
        names = ",".join(name for name, _ in variables)
        response = await self._request("O", struct.pack(">d", RATE_HZ) + names.encode())
        kinds = response[1:].decode("ascii", "replace").split(",")
        wrong = [f"{name} ({kind})" for (name, wanted), kind in zip(variables, kinds, strict=False) if kind != wanted]
        if wrong or len(kinds) != len(variables):
            missing = ", ".join(wrong) or "all variables"
            raise DeviceLost(f"{self._name}: {self._host} does not offer {missing}; update the controller's software")

    async def claim_inputs(self, names: Sequence[str]) -> int:
        """Claim inputs until this connection closes, and return the recipe's number for `send`.

        Raises CommandRefused if another client holds them.
        """
        response = await self._request("I", ",".join(names).encode())
        kinds = response[1:].decode("ascii", "replace").split(",")
        in_use = [name for name, kind in zip(names, kinds, strict=False) if kind == "IN_USE"]
        if in_use:
            raise CommandRefused(
                f"{self._name}: another program holds {', '.join(in_use)} of the robot; usual holders: a ROS driver, "
                "EtherNet/IP or PROFINET (disable them in the installation), or a gripper's URCap"
            )
        if not response or not response[0]:
            raise DeviceLost(f"{self._name}: {self._host} does not accept {', '.join(names)}: {response[1:]!r}")
        return response[0]

    async def start(self) -> None:
        """Start the data."""
        if await self._request("S", b"") != b"\x01":
            raise DeviceLost(f"{self._name}: {self._host} does not start its RTDE data; open it again")

    def send(self, recipe: int, values: bytes) -> None:
        """Set the inputs of a recipe. values: packed, big endian."""
        self._writer.write(struct.pack(">HBB", 4 + len(values), ord("U"), recipe) + values)

    async def receive(self) -> bytes:
        """Wait for the next data, without time-out; return them without the recipe's number."""
        while True:
            kind, payload = await self._message()
            if kind == "U":
                return payload[1:]

    def close(self) -> None:
        """Disconnect at once, which frees the claimed inputs. Idempotent."""
        self._writer.transport.abort()

    async def _request(self, kind: str, payload: bytes) -> bytes:
        self._writer.write(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)
        try:
            async with asyncio.timeout(RESPONSE_TIMEOUT_S):
                while True:
                    received, response = await self._message()
                    if received == kind:
                        return response
        except TimeoutError:
            raise DeviceLost(
                f"{self._name}: {self._host}:{PORT} (RTDE) accepts connections and does not answer within "
                f"{RESPONSE_TIMEOUT_S:g} s; wait until the controller has started"
            ) from None

    async def _message(self) -> tuple[str, bytes]:
        try:
            size, kind = struct.unpack(">HB", await self._reader.readexactly(3))
            if not 3 <= size <= MESSAGE_MAX_BYTES or kind not in MESSAGE_TYPES:
                raise self._not_rtde()
            return chr(kind), await self._reader.readexactly(size - 3)
        except (asyncio.IncompleteReadError, OSError):
            raise DeviceLost(f"{self._name}: {self._host} closed the RTDE connection; open it again") from None

    def _not_rtde(self) -> DeviceLost:
        return DeviceLost(f"{self._name}: {self._host}:{PORT} does not send RTDE; check the robot's address")


async def connect_tcp(
    name: str, host: str, port: int, service: str
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Open a TCP connection. Raises DeviceLost with the reason and what to check."""
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            return await asyncio.open_connection(await resolve_host(host), port)
    except TimeoutError:
        reason = f"no answer within {CONNECT_TIMEOUT_S:g} s"
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)  # asyncio's own text is for programmers
    raise DeviceLost(
        f"{name}: no answer from {host}:{port} ({service}): {reason}; check the robot's power, network cable and "
        f"address, and that {service} is enabled in its security settings"
    ) from None


async def check_port(name: str, host: str, port: int, service: str) -> None:
    """Raise DeviceLost if nothing listens at a port."""
    _, writer = await connect_tcp(name, host, port, service)
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
