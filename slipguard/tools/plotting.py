"""Matplotlib without a screen and without a trace in the user's home."""

from __future__ import annotations

import atexit
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slipguard.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure(width_in: float, height_in: float) -> Figure:
    """A new figure to draw on; save it with `save`."""
    if "MPLCONFIGDIR" not in os.environ:
        # Without it matplotlib keeps its font cache under the user's home.
        folder = tempfile.TemporaryDirectory(prefix="slipguard-mpl-")
        atexit.register(folder.cleanup)
        os.environ["MPLCONFIGDIR"] = folder.name
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=110, layout="constrained")


def save(drawing: Figure, path: Path, **options: Any) -> None:
    """Write the figure; the format follows the ending. Raises InputError when it cannot be written."""
    try:
        drawing.savefig(path, **options)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: the picture cannot be written: {error}") from error
