"""A state directory that outlives the daemon, but not the process."""

from __future__ import annotations

import numpy as np

from slipguard.daemon.store.calibration import BackgroundImage
from slipguard.daemon.store.state_dir import LastGrasp
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX


class MemoryState:
    """The last grasp, and a no-contact image of every sensor."""

    def __init__(self) -> None:
        self._last: LastGrasp | None = None
        blank = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), np.uint8)
        self._image = BackgroundImage(blank, (2.0, 2.0, 2.0), 30)

    def load_background(self, serial: str) -> BackgroundImage | None:
        """The same for every sensor."""
        return self._image

    def save_background(self, serial: str, taken: BackgroundImage) -> None:
        """Nothing is calibrated here."""

    def save_last_grasp(self, last: LastGrasp) -> None:
        """Keep it."""
        self._last = last

    def load_last_grasp(self) -> LastGrasp | None:
        """The one kept."""
        return self._last

    def forget_last_grasp(self) -> None:
        """Keep none."""
        self._last = None
