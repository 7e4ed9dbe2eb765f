"""Matplotlib figures without a display and without files in the user's home."""

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
    """Return a new figure; write it with `save`."""
    if "MPLCONFIGDIR" not in os.environ:
        # Otherwise matplotlib stores its font cache in the user's home.
        folder = tempfile.TemporaryDirectory(prefix="slipguard-mpl-")
        atexit.register(folder.cleanup)
        os.environ["MPLCONFIGDIR"] = folder.name
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=110, layout="constrained")


def save(drawing: Figure, path: Path, **options: Any) -> None:
    """Write the figure in the format of the file name's ending. Raises InputError if it cannot be written."""
    try:
        drawing.savefig(path, **options)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot write the plot: {error}") from error
