"""How much of a USB bus the cameras on it need, read from /sys.

A high-speed bus carries 7500 bytes per microframe of 125 us, of which isochronous transfers may take 80 % (USB 2.0
specification, 5.6.4). A camera does not reserve what its images need: it reserves one of the sizes that its descriptors
offer (its alternate settings). If nothing is left, its stream does not start (ENOSPC).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

MICROFRAMES_S = 8000
BUS_BYTES = 6000
"""Bytes of isochronous transfers per microframe."""
PAYLOAD_HEADER_BYTES = 12
INTERFACE, ENDPOINT = 4, 5
VIDEO_STREAMING = 0x0E, 0x02


def stream_sizes(descriptors: bytes) -> dict[int, int]:
    """Return bytes per microframe by alternate setting of the first video stream; empty if it is not isochronous.

    descriptors: the kernel's file of that name of a USB device.
    """
    sizes: dict[int, int] = {}
    stream, alternate, at = None, 0, 0
    while at + 2 <= len(descriptors) and (length := descriptors[at]) >= 2:
        one = descriptors[at : at + length].ljust(9, b"\0")
        at += length
        if one[1] == INTERFACE:
            number, alternate = one[2], one[3]
            is_video = (one[5], one[6]) == VIDEO_STREAMING
            stream = number if is_video and stream in (None, number) else stream
            if not is_video or number != stream:
                alternate = 0
        elif one[1] == ENDPOINT and alternate and one[2] & 0x80 and one[3] & 3 == 1:
            (packet,) = struct.unpack_from("<H", one, 4)
            sizes[alternate] = (packet & 0x7FF) * (1 + (packet >> 11 & 3)) >> max(one[6] - 1, 0)
    return sizes


def reserved_bytes(sizes: dict[int, int], needed_bytes_s: float) -> int:
    """Return the bytes per microframe that a stream reserves at least: the smallest size that carries it."""
    needed = needed_bytes_s / MICROFRAMES_S + PAYLOAD_HEADER_BYTES
    fitting = [size for size in sizes.values() if size >= needed]
    return min(fitting) if fitting else max(sizes.values(), default=0)


def cameras_on_bus(devices: Path, bus: str) -> Iterator[tuple[str, dict[int, int], int]]:
    """Yield port, sizes and present alternate setting of each isochronous camera. devices: /sys/bus/usb/devices."""
    for device in sorted(devices.glob(f"{bus}-*")):
        try:
            sizes = stream_sizes((device / "descriptors").read_bytes())
        except OSError:  # an interface, or unplugged at this moment
            continue
        if sizes:
            yield device.name, sizes, _alternate(device)


def _alternate(device: Path) -> int:
    for interface in device.glob(f"{device.name}:*"):
        try:
            if (interface / "bInterfaceClass").read_text().strip() == "0e":
                present = int((interface / "bAlternateSetting").read_text())
                if present:
                    return present
        except (OSError, ValueError):
            continue
    return 0
