"""Draws gel images in a process of its own.

Started as `python -m slipguard_drivers.digit.draw_worker SOCKET_FD MEMORY_FD UNIT_SEED`. One packet in,
`(slot, view)`, is one image in that slot of the shared memory and one packet back, `(slot, None)` or
`(slot, complaint)`. An end of file, which the parent's death is too, ends the process.
"""

from __future__ import annotations

import mmap
import os
import pickle
import signal
import socket
import sys
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from slipguard.sim.gel import GelCamera

IMAGE_BYTES = 320 * 240 * 3
SLOTS = 4
PACKET_BYTES = 4096
NICENESS = 10


def gel_camera(unit_seed: int) -> GelCamera:
    """The sensor unit of that seed; the same seed gives the same unit and the same noise."""
    from slipguard.sim.gel import GelCamera
    from slipguard.sim.unit import random_unit

    return GelCamera(random_unit(np.random.default_rng(unit_seed)), seed=unit_seed)


def serve(link: socket.socket, memory: mmap.mmap, camera: GelCamera) -> None:
    """Answer requests until the other end closes."""
    link.send(b"ready")
    while packet := _receive(link):
        slot, view = pickle.loads(packet)
        complaint: str | None = None
        try:
            image = np.ascontiguousarray(camera.draw(view))
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


def main() -> None:
    """Stay out of the loop's way: nice, on one thread, and deaf to its Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    import cv2

    cv2.setNumThreads(1)
    link_fd, memory_fd, unit_seed = (int(text) for text in sys.argv[1:4])
    with (
        socket.socket(fileno=link_fd) as link,
        mmap.mmap(memory_fd, SLOTS * IMAGE_BYTES) as memory,
    ):
        serve(link, memory, gel_camera(unit_seed))


if __name__ == "__main__":
    main()
