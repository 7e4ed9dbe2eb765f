"""One RTDE connection to the emulated controller: handshake, recipes, data."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence

from slipguard_emulators.ur5.controller import EmulatedController
from slipguard_emulators.ur5.rtde import InputRecipe, OutputRecipe, names_in, type_of


class RtdeSession:
    """The recipes of one client. rate_hz: the controller's cycles per second."""

    def __init__(self, controller: EmulatedController, version: tuple[int, ...], rate_hz: float) -> None:
        self._controller = controller
        self._version = version
        self._rate_hz = rate_hz
        self._inputs: list[InputRecipe] = []
        self._output: OutputRecipe | None = None
        self._started = False

    def due(self, cycle: int) -> bool:
        """Return whether the client receives data in this cycle."""
        return self._started and self._output is not None and cycle % self._output.every == 0

    def packet(self, values: Mapping[str, Sequence[float]]) -> bytes:
        """Return the data message of this cycle. Only if one is due."""
        assert self._output is not None
        return self._output.packet(values)

    def answer(self, kind: str, payload: bytes, now_s: float) -> bytes | None:
        """Execute a message; return the answer's payload, or None for data, which is not answered.

        Raises ValueError, IndexError or struct.error for an invalid message.
        """
        if kind == "V":
            return bytes([struct.unpack(">H", payload)[0] == 2])
        if kind == "v":
            return struct.pack(">4I", *self._version)
        if kind == "O":
            return self._take_outputs(struct.unpack(">d", payload[:8])[0], names_in(payload[8:]))
        if kind == "I":
            return self._take_inputs(names_in(payload))
        if kind in "SP":
            self._started = kind == "S" and self._output is not None  # without outputs a controller does not start
            return bytes([self._started or kind == "P"])
        if kind == "U":
            self._controller.take(self._inputs[payload[0] - 1].values(payload[1:]), now_s)
            return None
        raise ValueError(f"unknown message: {kind!r}")

    def _take_outputs(self, frequency_hz: float, names: list[str]) -> bytes:
        kinds = [type_of(name, "output") for name in names]
        known = "NOT_FOUND" not in kinds
        if known:
            self._output = OutputRecipe(names, max(1, round(self._rate_hz / max(1.0, frequency_hz))))
        return bytes([known]) + ",".join(kinds).encode()

    def _take_inputs(self, names: list[str]) -> bytes:
        kinds = self._controller.claim(self, names)
        free = not {"IN_USE", "NOT_FOUND"} & set(kinds)
        if free:
            self._inputs.append(InputRecipe(names))
        return bytes([len(self._inputs) if free else 0]) + ",".join(kinds).encode()
