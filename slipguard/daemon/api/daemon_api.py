"""The interface between the web process and the daemon.

Its values can be sent to another process: JSON text, images, typed requests.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.api.requests import DaemonRequest
from slipguard.daemon.loop.event_log import Event
from slipguard.devices import Frame
from slipguard.perception.patch import ClippedSides

NEXT_FRAME_TIMEOUT_S = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ContactOverlay:
    """The contact found in a frame, as far as it is drawn: see `slipguard.perception.patch.Patch`.

    mask: (h, w) uint8, 0 or 1, a crop of the network's image. left_px, top_px: its first column and row there.
    image_size: (width, height) of the network's image. axis_deg: in the image, axial, counter-clockwise as a viewer
    sees it; None if the contact has no axis.
    """

    mask: NDArray[np.uint8]
    left_px: int
    top_px: int
    image_size: tuple[int, int]
    clipped: ClippedSides
    axis_deg: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FingerFrame:
    """A frame of one finger. contact: None if there is none, or if the frame was not processed."""

    serial: str
    frame: Frame
    contact: ContactOverlay | None = None


class DaemonApi(Protocol):
    """Methods raise CommandRefused with the reason if the daemon cannot do what is requested."""

    @abstractmethod
    async def state(self) -> bytes:
        """Return the complete state as a JSON object; see `slipguard.daemon.api.state.State`."""

    @abstractmethod
    async def health_problem(self) -> str | None:
        """Return in one line why the daemon is not healthy; None if it is."""

    @abstractmethod
    async def counters(self) -> bytes:
        """Return counts and times since the start as a JSON object; see `slipguard.daemon.loop.loop_metrics`."""

    @abstractmethod
    async def frame(self, finger: str, after: int | None = None) -> FingerFrame:
        """Return the newest frame of a finger, without a contact.

        after: while the newest frame has this sequence number, wait up to `NEXT_FRAME_TIMEOUT_S` for the next one.
        """

    @abstractmethod
    async def processed_frame(self, finger: str) -> FingerFrame:
        """Return the newest processed frame of a finger and the contact found in it."""

    @abstractmethod
    async def submit(self, request: DaemonRequest, deadline_s: float | None = None) -> Mapping[str, object]:
        """Execute a request; return its response, a JSON object with at least `message`.

        deadline_s: on the monotonic clock; the request does not begin later. Default: `EXECUTE_WITHIN_S` from now.
        """

    @abstractmethod
    async def backgrounds(self) -> bytes:
        """Return the stored background images as a JSON object: by finger, `serial` and `versions`, oldest first."""

    @abstractmethod
    async def background(self, finger: str, number: int | None = None) -> FingerFrame:
        """Return a stored background image, by default the newest; the frame's `sequence` is its number."""

    @abstractmethod
    def subscribe(self, on_event: Callable[[Event], None]) -> Callable[[], None]:
        """Pass the newest events to `on_event`, oldest first, then each new one; return a function that ends this."""

    @abstractmethod
    def subscribe_estimates(self, on_estimates: Callable[[bytes], None]) -> Callable[[], None]:
        """Pass each `slipguard.daemon.api.state.NewEstimates`, as JSON, to `on_estimates`; return what ends this."""
