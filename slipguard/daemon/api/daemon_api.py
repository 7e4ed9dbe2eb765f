"""What the local API may ask of the daemon: the one door between the web room and the guard.

Answers are plain values that can cross to another process: JSON text, pictures, one line.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.loop.event_log import Event
from slipguard.devices import Frame
from slipguard.perception.contact.patch import ClippedSides


@dataclass(frozen=True, slots=True, eq=False)
class ContactOverlay:
    """The contact found in a picture: the part of `slipguard.perception.contact.patch.Patch` that can be drawn.

    mask: (h, w) uint8, 0 or 1, a crop of the network's picture. left_px, top_px: its first column and row there.
    image_size: (width, height) of the network's picture. axis_deg: in the picture, axial, counter-clockwise as a
    viewer sees it; None where it has none.
    """

    mask: NDArray[np.uint8]
    left_px: int
    top_px: int
    image_size: tuple[int, int]
    clipped: ClippedSides
    axis_deg: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FingerFrame:
    """A finger's newest judged frame and the contact in it; None: there is none."""

    serial: str
    frame: Frame
    contact: ContactOverlay | None = None


class DaemonApi(Protocol):
    """Commands answer with one line and raise CommandRefused with the reason."""

    @abstractmethod
    async def state(self) -> bytes:
        """Everything there is to know now, as a JSON object."""

    @abstractmethod
    async def trouble(self) -> str | None:
        """Why the daemon is not well, in one line; None if it is."""

    @abstractmethod
    async def tallies(self) -> bytes:
        """What was counted and timed since the start, as a JSON object: see `slipguard.daemon.loop.loop_metrics`."""

    @abstractmethod
    async def frame(self, finger: str) -> FingerFrame:
        """A finger's newest frame, as it came; raises CommandRefused where there is none."""

    @abstractmethod
    async def view(self, finger: str) -> FingerFrame:
        """A finger's newest judged frame with what was found in it; raises CommandRefused where there is none."""

    @abstractmethod
    async def grasp(self, force_n: float | None = None) -> str: ...

    @abstractmethod
    async def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str: ...

    @abstractmethod
    async def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> str: ...

    @abstractmethod
    async def guard(self, on: bool) -> str: ...

    @abstractmethod
    async def gripper(self, width_mm: float | None = None, force_n: float | None = None) -> str: ...

    @abstractmethod
    async def release(self, width_mm: float | None = None) -> str: ...

    @abstractmethod
    async def clear(self) -> str: ...

    @abstractmethod
    async def calibrate(self, force: bool = False, new_gel: bool = False) -> Mapping[str, object]:
        """Take both no-contact images; `said`, and by finger what they are like."""

    @abstractmethod
    async def go_back(self, finger: str, number: int) -> str:
        """Put an older no-contact image of a finger's sensor to use again."""

    @abstractmethod
    async def no_contacts(self) -> bytes:
        """What is stored of each finger's sensor, as a JSON object: see `slipguard.daemon.store.background_history`."""

    @abstractmethod
    async def no_contact(self, finger: str, number: int | None = None) -> FingerFrame:
        """A stored no-contact image, the newest if not told which; its number is the frame's `sequence`."""

    @abstractmethod
    def listen(self, hear: Callable[[Event], None]) -> Callable[[], None]:
        """Tell `hear` the newest events, oldest first, then each as it happens, until what is returned is called."""
