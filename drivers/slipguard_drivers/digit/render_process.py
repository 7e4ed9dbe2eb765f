"""Renders gel images: `python -m slipguard_drivers.digit.render_process SOCKET_FD MEMORY_FD UNIT_SEED`.

A request packet is `(slot, RenderRequest)`. The image is written to that slot of the shared memory, and the reply is
`(slot, None)` or `(slot, error)`. An end of file, also by the parent's death, ends the process.
"""

from __future__ import annotations

import mmap
import pickle
import signal
import socket
import sys

from slipguard.thread_priority import set_batch_priority
from slipguard_drivers.child_process import PACKET_BYTES

NICENESS = 2
"""Enough for the daemon to come first. With 10, four busy programs take all frames from the emulated cameras."""


def main() -> None:
    """Lower the priority before the imports, which take half a second; then render until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the parent
    set_batch_priority(NICENESS)
    import cv2

    from slipguard_drivers.digit.fake_renderer import IMAGE_BYTES, SLOTS, GelRenderer

    cv2.setNumThreads(1)
    link_fd, memory_fd, unit_seed = (int(text) for text in sys.argv[1:4])
    renderer = GelRenderer(unit_seed)
    with socket.socket(fileno=link_fd) as link, mmap.mmap(memory_fd, SLOTS * IMAGE_BYTES) as memory:
        link.send(b"ready")
        while packet := _receive(link):
            slot, request = pickle.loads(packet)
            error: str | None = None
            try:
                memory[slot * IMAGE_BYTES : (slot + 1) * IMAGE_BYTES] = renderer.render(request).tobytes()
            except Exception as failure:
                error = f"{type(failure).__name__}: {failure}"
            try:
                link.send(pickle.dumps((slot, error)))
            except (BrokenPipeError, ConnectionResetError):
                return


def _receive(link: socket.socket) -> bytes:
    try:
        return link.recv(PACKET_BYTES)
    except ConnectionResetError:  # the other end closed with an unread reply
        return b""


if __name__ == "__main__":
    main()
