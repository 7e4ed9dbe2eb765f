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

ENDINGS = (".png", ".pdf", ".svg")


def figure(width_in: float, height_in: float) -> Figure:
    """Return a new figure; write it with `save`."""
    if "MPLCONFIGDIR" not in os.environ:
        # Otherwise matplotlib stores its font cache in the user's home.
        folder = tempfile.TemporaryDirectory(prefix="slipguard-mpl-")
        atexit.register(folder.cleanup)
        os.environ["MPLCONFIGDIR"] = folder.name
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), dpi=110, layout="constrained")


def check_plot_path(path: Path | None) -> None:
    """Raise InputError if `save` could not write there, before the work whose results are plotted."""
    if path is None:
        return
    if path.suffix.lower() not in ENDINGS or path.is_dir():
        raise InputError(f"--plot {path}: not a name for a plot. Name a file that ends with {', '.join(ENDINGS)}")
    if not path.parent.is_dir():
        raise InputError(f"--plot {path}: the folder {path.parent} does not exist. Create it, or choose another one")


def save(drawing: Figure, path: Path, **options: Any) -> None:
    """Write the figure in the format of the file name's ending. Raises InputError if it cannot be written."""
    try:
        drawing.savefig(path, **options)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot write the plot: {error}") from error
