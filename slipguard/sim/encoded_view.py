"""A picture that carries the numbers of what would be on it: for pictures in virtual time that nobody has to look at.

No two are alike, as with a camera's; a reader gets the view of the moment of exposure, however late it comes.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.view import GelView

NUMBERS = tuple(one.name for one in fields(GelView) if one.name != "object_name")
SOMETHING = "something"
"""How an object is called whose name is not carried."""


def encode_view(view: GelView, light_bgr: tuple[float, float, float], number: int) -> NDArray[np.uint8]:
    """The picture, (320, 240, 3) uint8; number: of the picture, so that it differs from the last."""
    numbers = [getattr(view, name) for name in NUMBERS]
    values = np.array([number, view.object_name != "", *light_bgr, *numbers], np.float64)
    row = np.zeros(FRAME_WIDTH_PX * 3, np.uint8)
    row[: values.nbytes] = values.view(np.uint8)
    return np.broadcast_to(row.reshape(FRAME_WIDTH_PX, 3), (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3))


def decode_view(image: NDArray[np.uint8]) -> tuple[GelView, tuple[float, float, float]]:
    """What a picture by `told` carries: view and light."""
    values = np.frombuffer(image[0].tobytes()[: 8 * (len(NUMBERS) + 5)], np.float64)
    _, there, blue, green, red, *numbers = (float(value) for value in values)
    return GelView(SOMETHING if there else "", *numbers), (blue, green, red)
