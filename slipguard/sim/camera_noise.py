"""Camera noise: one large array of correlated noise; each frame is a window of it at a random place."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.raster import Field, blurred
from slipguard.sim.sensor_unit import Triple

_CORRELATION_PX = 0.79
"""Blur of white noise that gives the measured lag-1 correlation of 0.65, exp(-1 / (4 s^2)), rounding included."""
_STRIPE_PX = 1.5
"""Neighboring columns drift together."""
_ARRAYS = 4


class CameraNoise:
    """Noise of one camera; the sequence of frames depends on the seed only."""

    def __init__(self, std_bgr: Triple, stripe_bgr: Triple, seed: int) -> None:
        noise, stripes = _noise_arrays(seed % _ARRAYS)
        self._array = noise * np.asarray(std_bgr, np.float32) + stripes * np.asarray(stripe_bgr, np.float32)
        self._rng = np.random.default_rng(seed)

    def reseed(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def next(self) -> Field:
        """Return the next frame of noise, (320, 240, 3) float32 gray levels; read-only by convention."""
        height, width = self._array.shape[:2]
        top = int(self._rng.integers(height - FRAME_HEIGHT_PX + 1))
        left = int(self._rng.integers(width - FRAME_WIDTH_PX + 1))
        return self._array[top : top + FRAME_HEIGHT_PX, left : left + FRAME_WIDTH_PX]


@lru_cache(maxsize=_ARRAYS)
def _noise_arrays(index: int) -> tuple[Field, Field]:
    """Return pixel noise (640, 480, 3) and column noise (1, 480, 3), both of standard deviation 1."""
    rng = np.random.default_rng([20479, index])
    white = rng.standard_normal((2 * FRAME_HEIGHT_PX, 2 * FRAME_WIDTH_PX, 3), dtype=np.float32)
    noise = blurred(white, _CORRELATION_PX)
    noise /= noise.std(axis=(0, 1))
    white = rng.standard_normal((1, 2 * FRAME_WIDTH_PX, 3), dtype=np.float32)
    stripes = blurred(white, _STRIPE_PX)
    stripes /= stripes.std(axis=(0, 1))
    return noise, stripes
