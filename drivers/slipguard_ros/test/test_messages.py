"""Building messages from readings, without a node."""

from __future__ import annotations

import array
import time
from collections.abc import Callable
from typing import Any

from slipguard_ros.messages import image_message
from slipguard_ros.readings import GelImage
from std_msgs.msg import Header

WIDTH_PX, HEIGHT_PX = 240, 320


def cpu_s(work: Callable[[], Any], times: int = 20) -> float:
    """Return the processor time of one call, the shortest of five series."""
    spent_s = []
    for _ in range(5):
        began_s = time.process_time()
        for _ in range(times):
            work()
        spent_s.append((time.process_time() - began_s) / times)
    return min(spent_s)


def test_an_image_is_copied_as_a_whole() -> None:
    """Two cameras deliver 120 images per second: taking each byte by itself used a whole core."""
    received = bytearray(range(256)) * (3 * WIDTH_PX * HEIGHT_PX // 256)
    image = GelImage(WIDTH_PX, HEIGHT_PX, 0.0, 1, memoryview(received))
    message = image_message(image, Header())
    assert (message.height, message.width, message.step) == (HEIGHT_PX, WIDTH_PX, 3 * WIDTH_PX)
    assert bytes(message.data) == received
    byte_by_byte_s = cpu_s(lambda: array.array("B", image.pixels), 2)
    assert cpu_s(lambda: image_message(image, Header())) < 0.2 * byte_by_byte_s
