"""What lies between a daemon and its devices, and can be cut: a killed daemon says nothing more, not even good-bye."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any


class CuttableLink:
    """cut: the daemon at this end is dead; whatever it still awaits never comes."""

    def __init__(self) -> None:
        self.cut = False

    async def passes(self) -> None:
        """Return at once, or never."""
        if self.cut:
            await asyncio.Event().wait()


class LinkedDevice:
    """A device at the other end of a wire; has all that the device has.

    `close` does nothing once the wire is cut. told: called with the name of each method before it reaches the device.
    """

    def __init__(self, device: Any, wire: CuttableLink, told: Callable[[str], None] = lambda name: None) -> None:
        self._device, self._wire, self._told = device, wire, told
        self._calls: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._device, name)
        if not inspect.iscoroutinefunction(found):
            return found
        if name not in self._calls:
            self._calls[name] = self._wired(name, found)
        return self._calls[name]

    def _wired(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        wire, told = self._wire, self._told

        @wraps(method)
        async def call(*args: Any, **kwargs: Any) -> Any:
            if name == "close" and wire.cut:
                return None
            await wire.passes()
            told(name)
            answer = await method(*args, **kwargs)
            if name != "close":
                await wire.passes()
            return answer

        return call
