"""Where the fake sensor's images are drawn: here and now, or in a process of its own."""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import os
import pickle
from collections.abc import Callable
from itertools import cycle
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.errors import DeviceLost, DeviceTimeout
from slipguard.frame_stream import SHAPE
from slipguard.sim.gel_view import GelView, encode_view
from slipguard_drivers.child_process import PACKET_BYTES, ChildProcess
from slipguard_drivers.digit.render_worker import IMAGE_BYTES, SLOTS, GelRenderer, RenderRequest

Image = NDArray[np.uint8]
WORKER = "slipguard_drivers.digit.render_process"
BACKGROUND_IMAGES = 16
START_TIMEOUT_S = 30.0
"""Python, numpy and OpenCV starting on a loaded small machine; 0.5 s on an idle one."""


class Renderer(Protocol):
    """Turns a shot into an image, now or a little later."""

    async def start(self) -> None:
        """Get ready to draw. Raises DeviceTimeout or DeviceLost."""

    def render(self, shot: RenderRequest, done: Callable[[Image], None]) -> bool:
        """Draw `shot` and call `done` with the image; False where it is too busy to."""
        ...

    def stop(self) -> None:
        """Let go of everything; no `done` is called any more."""


class InlineRenderer:
    """Draws at once, in the calling process: for virtual time, where drawing takes no time."""

    def __init__(self, unit_seed: int) -> None:
        self._unit_seed = unit_seed

    async def start(self) -> None:
        """Make the sensor unit."""
        self._draughtsman = GelRenderer(self._unit_seed)

    def render(self, shot: RenderRequest, done: Callable[[Image], None]) -> bool:
        """Draw before returning."""
        done(self._draughtsman.draw(shot))
        return True

    def stop(self) -> None:
        """Nothing to let go of."""


class BackgroundRenderer:
    """Draws the untouched gel a few times and hands those pictures out in turn for ever, whatever is touched.

    For hours of virtual time, where what is touched is known in another way.
    """

    def __init__(self, unit_seed: int) -> None:
        self._unit_seed = unit_seed

    async def start(self) -> None:
        """Draw the pictures; they differ in their noise."""
        untouched = RenderRequest(GelView(""), (0.0, 0.0, 0.0), noise_seed=0)
        gel_renderer = GelRenderer(self._unit_seed)
        self._pictures = cycle([gel_renderer.draw(untouched) for _ in range(BACKGROUND_IMAGES)])

    def render(self, shot: RenderRequest, done: Callable[[Image], None]) -> bool:
        """Hand the next one out before returning."""
        done(next(self._pictures))
        return True

    def stop(self) -> None:
        """Nothing to let go of."""


class EncodingRenderer:
    """Writes down what would be on the picture instead of drawing it (`slipguard.sim.gel_view`)."""

    def __init__(self) -> None:
        self._count = 0

    async def start(self) -> None:
        """Nothing to get ready."""

    def render(self, shot: RenderRequest, done: Callable[[Image], None]) -> bool:
        """Write before returning."""
        self._count += 1
        done(encode_view(shot.view, shot.light_drift_bgr, self._count))
        return True

    def stop(self) -> None:
        """Nothing to let go of."""


class ProcessRenderer:
    """Draws in a child process, so that drawing does not take the loop's time.

    A few numbers go over a socket, images come back through shared memory.

    died: called with the reason when the child ends by itself.
    """

    def __init__(self, name: str, unit_seed: int, died: Callable[[str], None]) -> None:
        self._name = name
        self._unit_seed = unit_seed
        self._died = died
        self._child: ChildProcess | None = None
        self._memory: mmap.mmap | None = None
        self._waiting: dict[int, Callable[[Image], None]] = {}
        self._free: list[int] = []

    async def start(self) -> None:
        """Start the child and wait until it can draw."""
        self.stop()
        self._child = child = self._launch()
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(START_TIMEOUT_S):
                greeting = await loop.sock_recv(child.link, PACKET_BYTES)
        except TimeoutError:
            self.stop()
            raise DeviceTimeout(
                f"{self._name}: the drawing process was not ready after {START_TIMEOUT_S:.0f} s"
            ) from None
        except BaseException:
            self.stop()
            raise
        if not greeting:
            self.stop()
            raise DeviceLost(f"{self._name}: the drawing process ended before it drew anything")
        self._free = list(range(SLOTS))
        loop.add_reader(child.link, self._on_answer)

    def _launch(self) -> ChildProcess:
        memory_fd = os.memfd_create(f"slipguard-{self._name}")  # without a name in any folder: nothing is left behind
        try:
            os.ftruncate(memory_fd, SLOTS * IMAGE_BYTES)
            child = ChildProcess(WORKER, str(memory_fd), str(self._unit_seed), keep_fds=(memory_fd,))
            self._memory = mmap.mmap(memory_fd, SLOTS * IMAGE_BYTES)
            return child
        finally:
            os.close(memory_fd)

    def render(self, shot: RenderRequest, done: Callable[[Image], None]) -> bool:
        """Ask the child for an image; False while it has all the work it can hold."""
        if not self._free or self._child is None:
            return False
        slot = self._free.pop()
        try:
            self._child.link.send(pickle.dumps((slot, shot)))
        except OSError:
            self._free.append(slot)
            return False  # a dead child is told by its end of file
        self._waiting[slot] = done
        return True

    def _on_answer(self) -> None:
        assert self._child is not None
        assert self._memory is not None
        try:
            packet = self._child.link.recv(PACKET_BYTES)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self.stop()
            self._died("the drawing process ended; open the sensor again")
            return
        slot, complaint = pickle.loads(packet)
        done = self._waiting.pop(slot)
        if complaint is not None:
            self.stop()
            self._died(f"the drawing process cannot draw: {complaint}")
            return
        raw = self._memory[slot * IMAGE_BYTES : (slot + 1) * IMAGE_BYTES]
        self._free.append(slot)
        done(np.frombuffer(bytearray(raw), np.uint8).reshape(SHAPE))

    def stop(self) -> None:
        """End the child and free the memory. Idempotent."""
        self._waiting.clear()
        self._free.clear()
        if self._memory is not None:
            self._memory.close()
            self._memory = None
        if self._child is not None:
            with contextlib.suppress(RuntimeError):  # no loop any more: nothing reads it either
                asyncio.get_running_loop().remove_reader(self._child.link)
            self._child.kill()
            self._child = None
