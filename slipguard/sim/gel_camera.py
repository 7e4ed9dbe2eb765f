"""A rendered DIGIT fingertip camera: object -> gel -> light and shadow -> background image -> noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.sim.gel_effects import GelMemory
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.imprint import Imprint, Imprinter
from slipguard.sim.raster import Field, f32
from slipguard.sim.sensor_unit import CameraNoise, LightChange, SensorUnit, background_image

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class GelTruth:
    """One frame and its truth.

    Attributes:
        image: (320, 240, 3) uint8 BGR.
        contact: (320, 240) bool, where object and gel touch.
        displacement_mm: (320, 240) float32, gel towards the camera, >= 0.
        press_mm: indentation of the object's highest point, 0 without contact.
    """

    image: Image
    contact: NDArray[np.bool_]
    displacement_mm: Field
    press_mm: float


class GelCamera:
    """The camera of one sensor unit. Its images depend only on unit, seed and the sequence of calls.

    Args:
        background: background image (320, 240, 3) uint8 BGR instead of the unit's; InputError for another shape.
        memory: memory of the gel for past imprints; every image drawn is one frame later.
    """

    def __init__(
        self, unit: SensorUnit, background: Image | None = None, seed: int = 0, memory: GelMemory | None = None
    ) -> None:
        self.unit = unit
        self._background = background_image(unit) if background is None else background
        shape = (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3)
        if self._background.shape != shape or self._background.dtype != np.uint8:
            raise InputError(
                f"background image of shape {self._background.shape}, {self._background.dtype}; it must be {shape}, "
                "uint8 (240 wide, 320 high, BGR)"
            )
        self._imprinter = Imprinter(unit, self._background)
        self._noise = CameraNoise(unit.noise_bgr, unit.stripe_bgr, seed)
        self._last: tuple[GelView, float, HeightRaster | None, Imprint | None] | None = None
        self._memory = memory
        self._past = np.zeros(shape, np.float32)
        self._now: Field = self._past
        self._light = LightChange()
        self._lit_background = self._background.astype(np.float32)

    def no_contact(self) -> Image:
        """Return the unit's background image, without noise and without light changes."""
        return self._background.copy()

    def settle(self) -> None:
        """Let the gel's memory take on the last imprint, as after a long hold."""
        self._past = self._now.copy()

    def reseed(self, seed: int) -> None:
        """Restart the noise sequence with another seed, on the same noise array."""
        self._noise.reseed(seed)

    def set_light(self, light: LightChange) -> None:
        """Change the light from the next frame on; `no_contact` stays the same."""
        if light == self._light:
            return
        x = np.linspace(-1.0, 1.0, FRAME_WIDTH_PX, dtype=np.float32)[None, :, None]
        y = np.linspace(1.0, -1.0, FRAME_HEIGHT_PX, dtype=np.float32)[:, None, None]
        self._lit_background = self._background * np.float32(light.gain)
        self._lit_background += f32(light.offset_bgr) + x * f32(light.tilt_bgr)
        self._lit_background += y * f32(light.tilt_up_bgr)
        self._light = light

    def draw(self, view: GelView, exposure_s: float = 0.008, raster: HeightRaster | None = None) -> Image:
        """Return one frame, (320, 240, 3) uint8 BGR.

        Args:
            view: the pose in the middle of the exposure.
            raster: a surface instead of the named object's.

        Raises:
            InputError: unknown object, or a pose that is not finite.
        """
        last = self._last
        if last is None or last[:2] != (view, exposure_s) or last[2] is not raster:
            # The imprint of an object at rest is computed once: only the noise is new.
            last = self._last = (view, exposure_s, raster, self._imprinter.imprint(view, exposure_s, raster))
        return self._finish(last[3])

    def draw_with_truth(self, view: GelView, exposure_s: float = 0.008, raster: HeightRaster | None = None) -> GelTruth:
        """Return the frame that `draw` would return, with the truth in the middle of its exposure."""
        imprint = self._imprinter.imprint(view, exposure_s, raster)
        contact = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.bool_)
        gel_mm = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX), np.float32)
        if imprint is not None:
            contact[imprint.window] = imprint.contact
            gel_mm[imprint.window] = imprint.gel_mm
        return GelTruth(self._finish(imprint), contact, gel_mm, max(view.depth_mm, 0.0))

    def _finish(self, imprint: Imprint | None) -> Image:
        noise = self._noise.next()
        if self._memory is not None:
            remembered = self._remember(imprint, self._memory)
            return cast("Image", cv2.add(self._lit_background + remembered, noise, dtype=cv2.CV_8U))
        image = cv2.add(self._lit_background, noise, dtype=cv2.CV_8U)
        if imprint is not None:
            window = imprint.window
            change = imprint.change_bgr + self._lit_background[window]
            image[window] = cv2.add(change, noise[window], dtype=cv2.CV_8U)
        return cast("Image", image)

    def _remember(self, imprint: Imprint | None, memory: GelMemory) -> Field:
        """Return the change of the image by this imprint and the past ones, which it joins."""
        self._now = np.zeros_like(self._past)
        if imprint is not None:
            self._now[imprint.window] = imprint.change_bgr
        shown = np.float32(1.0 - memory.share) * self._now + np.float32(memory.share) * self._past
        self._past += np.float32(1.0 - math.exp(-memory.frame_s / memory.fade_s)) * (self._now - self._past)
        return f32(shown)
