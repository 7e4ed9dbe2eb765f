"""Where the simulated sensor's images come from: rendered here or in a process of its own, repeated, or encoded."""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import os
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count, cycle
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_SHAPE
from slipguard.errors import DeviceLost, DeviceTimeout
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView, encode_view
from slipguard.sim.height_raster import height_raster_of
from slipguard.sim.sensor_unit import LightChange, random_unit
from slipguard_drivers.child_process import PACKET_BYTES, ChildProcess

Image = NDArray[np.uint8]
IMAGE_BYTES = 320 * 240 * 3
SLOTS = 4
PROCESS = "slipguard_drivers.digit.render_process"
BACKGROUND_IMAGES = 16
START_TIMEOUT_S = 30.0
"""Start of Python, numpy and OpenCV on a small busy machine; 0.5 s on an idle one."""


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """One image to render. light_drift_bgr: change of the gray levels since the background image was taken."""

    view: GelView
    light_drift_bgr: tuple[float, float, float]
    noise_seed: int


RenderFunction = Callable[[RenderRequest], Image]


class GelRenderer:
    """Renders the images of one sensor unit. A new noise seed restarts the noise, so a grasp can be repeated."""

    def __init__(self, unit_seed: int) -> None:
        self._camera = GelCamera(random_unit(np.random.default_rng(unit_seed)))
        self._noise_seed: int | None = None

    def render(self, request: RenderRequest) -> Image:
        """Return an image, (320, 240, 3) uint8 BGR."""
        if request.noise_seed != self._noise_seed:
            self._camera.reseed(request.noise_seed)
            self._noise_seed = request.noise_seed
        if request.view.object_name:
            height_raster_of(request.view.object_name)  # 20-90 ms for a new object, here before it touches the gel
        self._camera.set_light(LightChange(offset_bgr=request.light_drift_bgr))
        return self._camera.draw(request.view)


class Renderer(Protocol):
    """Renders a request to an image, now or later."""

    async def start(self) -> None:
        """Prepare. Raises DeviceTimeout or DeviceLost."""

    def render(self, request: RenderRequest, done: Callable[[Image], None]) -> None:
        """Render the image and call `done` with it, or leave it out if it is too busy."""
        ...

    def stop(self) -> None:
        """Release everything; `done` is not called any more."""
        return


class InlineRenderer(Renderer):
    """Renders before it returns, in the calling process: for virtual time, in which rendering takes no time.

    prepare: Returns the function that renders; called by `start`.
    """

    def __init__(self, prepare: Callable[[], RenderFunction]) -> None:
        self._prepare = prepare

    async def start(self) -> None:
        self._render_image = self._prepare()

    def render(self, request: RenderRequest, done: Callable[[Image], None]) -> None:
        done(self._render_image(request))


def repeat_background(unit_seed: int) -> RenderFunction:
    """Return a function that repeats a few images of the gel without contact, for hours of virtual time."""
    background = RenderRequest(GelView(""), (0.0, 0.0, 0.0), noise_seed=0)
    gel_renderer = GelRenderer(unit_seed)
    images = cycle([gel_renderer.render(background) for _ in range(BACKGROUND_IMAGES)])
    return lambda request: next(images)


def encode_views() -> RenderFunction:
    """Return a function that encodes the view as numbers (`slipguard.sim.gel_view.encode_view`)."""
    numbers = count(1)
    return lambda request: encode_view(request.view, request.light_drift_bgr, next(numbers))


class ProcessRenderer(Renderer):
    """Renders in a child process, so that rendering takes no time of the event loop.

    Requests go over a socket, images come back in shared memory. on_lost: called with the reason if the child ends.
    """

    def __init__(self, name: str, unit_seed: int, on_lost: Callable[[str], None]) -> None:
        self._name = name
        self._unit_seed = unit_seed
        self._on_lost = on_lost
        self._child: ChildProcess | None = None
        self._memory: mmap.mmap | None = None
        self._waiting: dict[int, Callable[[Image], None]] = {}
        self._free: list[int] = []

    async def start(self) -> None:
        """Start the child and wait until it can render."""
        self.stop()
        self._child = child = self._launch()
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(START_TIMEOUT_S):
                greeting = await loop.sock_recv(child.link, PACKET_BYTES)
        except TimeoutError:
            self.stop()
            raise DeviceTimeout(
                f"{self._name}: the rendering process is not ready after {START_TIMEOUT_S:.0f} s; end other programs"
            ) from None
        except BaseException:
            self.stop()
            raise
        if not greeting:
            self.stop()
            raise DeviceLost(f"{self._name}: the rendering process ended during its start; see its error message")
        self._free = list(range(SLOTS))
        loop.add_reader(child.link, self._on_reply)

    def _launch(self) -> ChildProcess:
        memory_fd = os.memfd_create(f"slipguard-{self._name}")  # has no name in any folder, so nothing is left behind
        try:
            os.ftruncate(memory_fd, SLOTS * IMAGE_BYTES)
            child = ChildProcess(PROCESS, str(memory_fd), str(self._unit_seed), keep_fds=(memory_fd,))
            self._memory = mmap.mmap(memory_fd, SLOTS * IMAGE_BYTES)
            return child
        finally:
            os.close(memory_fd)

    def render(self, request: RenderRequest, done: Callable[[Image], None]) -> None:
        """Send the request to the child, unless all slots are in use."""
        if not self._free or self._child is None:
            return
        slot = self._free.pop()
        try:
            self._child.link.send(pickle.dumps((slot, request)))
        except OSError:  # a dead child is noticed by its end of file
            self._free.append(slot)
            return
        self._waiting[slot] = done

    def stop(self) -> None:
        """End the child and free the memory. Idempotent."""
        self._waiting.clear()
        self._free.clear()
        if self._memory is not None:
            self._memory.close()
            self._memory = None
        if self._child is not None:
            with contextlib.suppress(RuntimeError):  # no loop runs any more, so none reads the link
                asyncio.get_running_loop().remove_reader(self._child.link)
            self._child.kill()
            self._child = None

    def _on_reply(self) -> None:
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
            self._on_lost("the rendering process ended; open the sensor again")
            return
        slot, error = pickle.loads(packet)
        done = self._waiting.pop(slot)
        if error is not None:
            self.stop()
            self._on_lost(f"the rendering process failed: {error}")
            return
        raw = self._memory[slot * IMAGE_BYTES : (slot + 1) * IMAGE_BYTES]
        self._free.append(slot)
        done(np.frombuffer(bytearray(raw), np.uint8).reshape(FRAME_SHAPE))
