"""Thins a mask to its skeleton: Guo-Hall thinning on one Python integer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def thin(mask: NDArray[np.uint8] | NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Thin a mask to lines one pixel wide, keeping its connectivity.

    Pixel-exact with `cv2.ximgproc.thinning(mask, THINNING_GUOHALL)` and several times faster: the bounding box of the
    mask is packed into one Python integer, one bit per pixel, each row followed by an empty pad bit. The eight
    neighbors of all pixels are then eight shifts of that integer, and a sub-iteration is about forty bitwise
    operations. As in OpenCV the outermost rows and columns count as neighbors but are never removed: pad a crop by one
    pixel where its edge is not the edge of the image.

    Args:
        mask: (H, W) uint8 or bool, any size, non-zero is inside.

    Returns:
        (H, W) uint8, 0 or 1, a subset of the mask.

    Source: Z. Guo, R. W. Hall, "Parallel thinning with two-subiteration algorithms", CACM 32 (1989).
    """
    image_h, image_w = mask.shape
    skeleton = np.zeros((image_h, image_w), np.uint8)
    rows = np.flatnonzero(mask.any(axis=1))
    if rows.size == 0:
        return skeleton
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    columns = np.flatnonzero(mask[top:bottom].any(axis=0))
    left, right = int(columns[0]), int(columns[-1]) + 1
    height, width = bottom - top, right - left

    padded = np.zeros((height, width + 1), np.bool_)
    padded[:, :width] = mask[top:bottom, left:right]
    bits = _packed(padded)

    if top > 0 and left > 0 and bottom < image_h and right < image_w:
        bits = _thinned(bits, width + 1, None)
    else:
        padded[:] = True
        if top == 0:
            padded[0] = False
        if left == 0:
            padded[:, 0] = False
        if bottom == image_h:
            padded[-1] = False
        if right == image_w:
            padded[:, width - 1] = False
        bits = _thinned(bits, width + 1, _packed(padded))

    count = height * (width + 1)
    octets = np.frombuffer(bits.to_bytes((count + 7) // 8, "little"), np.uint8)
    unpacked = np.unpackbits(octets, count=count, bitorder="little").reshape(height, width + 1)
    skeleton[top:bottom, left:right] = unpacked[:, :width]
    return skeleton


def _packed(pixels: NDArray[np.bool_]) -> int:
    """Return pixels in reading order as bits, the first one lowest."""
    return int.from_bytes(np.packbits(pixels.ravel(), bitorder="little").tobytes(), "little")


def _thinned(x: int, stride: int, removable: int | None) -> int:
    """Repeat both sub-iterations until stable. removable: pixels that may be removed; None: all."""
    while True:
        before = x
        north, south, west, east = x << stride, x >> stride, x << 1, x >> 1
        removed = _deletable(x, north, north >> 1, east, south >> 1, south, south << 1, west, north << 1)
        x ^= removed if removable is None else removed & removable
        north, south, west, east = x << stride, x >> stride, x << 1, x >> 1
        # The second sub-iteration is the first one rotated by 180 degrees.
        removed = _deletable(x, south, south << 1, west, north << 1, north, north >> 1, east, south >> 1)
        x ^= removed if removable is None else removed & removable
        if x == before:
            return x


def _deletable(x: int, p2: int, p3: int, p4: int, p5: int, p6: int, p7: int, p8: int, p9: int) -> int:
    """Return the bits of x that one sub-iteration removes, given the neighbors clockwise from the north (p2).

    Guo and Hall remove a pixel if its neighbors form exactly one connected part, 2 <= min(N1, N2) <= 3, and
    (p6 or p7 or not p9) and p8 is false. Sorted by p8 and p4 these are the three cases below; the tests compare them
    over all 256 neighborhoods. `a & ~b` is written `a ^ (a & b)`: complements of Python integers are slow.
    """
    p29, p67, low = p2 & p9, p6 & p7, p6 | p7
    with_west = x & p8
    rest = x ^ with_west
    with_east = rest & p4
    neither = rest ^ with_east

    kept = with_east & (p2 | p6 | (p3 & p5))
    removed = kept ^ (kept & ((p9 ^ p29) | (p7 ^ p67) | (p7 & p9)))

    kept = neither & ((p29 & p3) | (p67 & p5))
    removed |= kept ^ (kept & ((p2 | p3 | p9) & (low | p5)))

    kept = with_west & p29
    removed |= kept ^ (kept & (low | ((p5 | p4) ^ p4)))
    return removed
