"""Draws gel images, in a process of its own (`slipguard_drivers.digit.render_process`).

One packet in, `(slot, shot)`, is one image in that slot of the shared memory and one packet back, `(slot, None)` or
`(slot, complaint)`. An end of file, which the parent's death is too, ends the process.
"""

from __future__ import annotations

import mmap
import pickle
import socket
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import height_raster_of
from slipguard.sim.sensor_unit import LightChange, random_unit
from slipguard_drivers.child_process import PACKET_BYTES

IMAGE_BYTES = 320 * 240 * 3
SLOTS = 4


@dataclass(frozen=True, slots=True)
class RenderRequest:
    """All it takes to draw one image. light_drift_bgr: grey levels since the no-contact image was taken."""

    view: GelView
    light_drift_bgr: tuple[float, float, float]
    noise_seed: int


class GelRenderer:
    """Draws what one sensor unit sees. A new noise seed starts the noise anew, so a grasp can be repeated."""

    def __init__(self, unit_seed: int) -> None:
        self._camera = GelCamera(random_unit(np.random.default_rng(unit_seed)))
        self._noise_seed: int | None = None

    def draw(self, shot: RenderRequest) -> NDArray[np.uint8]:
        """One image: (320, 240, 3) uint8 BGR."""
        if shot.noise_seed != self._noise_seed:
            self._camera.reseed(shot.noise_seed)
            self._noise_seed = shot.noise_seed
        if shot.view.object_name:
            height_raster_of(shot.view.object_name)  # 20-90 ms for a new object: better before it touches the gel
        self._camera.set_light(LightChange(offset_bgr=shot.light_drift_bgr))
        return self._camera.draw(shot.view)


def serve(link: socket.socket, memory: mmap.mmap, gel_renderer: GelRenderer) -> None:
    """Answer requests until the other end closes."""
    link.send(b"ready")
    while packet := _receive(link):
        slot, shot = pickle.loads(packet)
        complaint: str | None = None
        try:
            image = gel_renderer.draw(shot)
            memory[slot * IMAGE_BYTES : (slot + 1) * IMAGE_BYTES] = image.tobytes()
        except Exception as error:
            complaint = f"{type(error).__name__}: {error}"
        try:
            link.send(pickle.dumps((slot, complaint)))
        except (BrokenPipeError, ConnectionResetError):
            return


def _receive(link: socket.socket) -> bytes:
    try:
        return link.recv(PACKET_BYTES)
    except ConnectionResetError:  # the other end closed with an answer still unread
        return b""


def serve_to_the_end(link_fd: int, memory_fd: int, unit_seed: int) -> None:
    """All of the process's work, on one thread."""
    cv2.setNumThreads(1)
    with (
        socket.socket(fileno=link_fd) as link,
        mmap.mmap(memory_fd, SLOTS * IMAGE_BYTES) as memory,
    ):
        serve(link, memory, GelRenderer(unit_seed))
