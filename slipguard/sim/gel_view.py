"""The pose of an object in one fingertip image, and an image that carries this pose as numbers.

The encoded image replaces a rendered one in virtual-time tests: a perception model reads the pose at the moment of
exposure from it, however late the image arrives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.gel_effects import GelEffects


@dataclass(frozen=True, slots=True)
class GelView:
    """Pose and motion of the object's imprint in one finger's image: the link between mechanics and renderer.

    Attributes:
        object_name: "" if there is no object.
        x_mm, y_mm: object origin (on the grasp axis) from the image center, right and up.
        angle_deg: object angle, counter-clockwise in the image.
        depth_mm: overlap of the object's highest point with the undeformed gel; <= 0 without contact.
        vx_mm_s, vy_mm_s, rate_deg_s: motion in the image, for motion blur.
        effects: tilt of the object and deformation of the imprint; None for neither. Encoded images do not carry it.
    """

    object_name: str
    x_mm: float = 0.0
    y_mm: float = 0.0
    angle_deg: float = 0.0
    depth_mm: float = 0.0
    vx_mm_s: float = 0.0
    vy_mm_s: float = 0.0
    rate_deg_s: float = 0.0
    effects: GelEffects | None = None

    def center_shift_mm(self, since: GelView) -> tuple[float, float]:
        """Return how far the object's point at the image center has moved since another view, right and up."""
        rotation = math.radians(self.angle_deg - since.angle_deg)
        c, s = math.cos(rotation), math.sin(rotation)
        x, y = since.x_mm, since.y_mm
        return self.x_mm - c * x + s * y, self.y_mm - s * x - c * y


_ENCODED_FIELDS = tuple(field.name for field in fields(GelView) if field.name not in ("object_name", "effects"))
DECODED_NAME = "object"
"""Name of a decoded object; encoding keeps only whether there is one."""


def encode_view(view: GelView, light_bgr: tuple[float, float, float], number: int) -> NDArray[np.uint8]:
    """Return an image, (320, 240, 3) uint8, that carries view and light; `number` makes each image different."""
    pose = [getattr(view, name) for name in _ENCODED_FIELDS]
    values = np.array([number, view.object_name != "", *light_bgr, *pose], np.float64)
    row = np.zeros(FRAME_WIDTH_PX * 3, np.uint8)
    row[: values.nbytes] = values.view(np.uint8)
    return np.broadcast_to(row.reshape(FRAME_WIDTH_PX, 3), (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3))


def decode_view(image: NDArray[np.uint8]) -> tuple[GelView, tuple[float, float, float]]:
    values = np.frombuffer(image[0].tobytes()[: 8 * (len(_ENCODED_FIELDS) + 5)], np.float64)
    _, present, blue, green, red, *pose = (float(value) for value in values)
    x_mm, y_mm, angle_deg, depth_mm, vx_mm_s, vy_mm_s, rate_deg_s = pose
    name = DECODED_NAME if present else ""
    return GelView(name, x_mm, y_mm, angle_deg, depth_mm, vx_mm_s, vy_mm_s, rate_deg_s), (blue, green, red)
