"""Tests that need what is not here are deselected, and the closing lines say so."""

from __future__ import annotations

import pytest


def left_out(config: pytest.Config, items: list[pytest.Item], marker: str) -> int:
    """Deselect what carries the marker; how many."""
    marked = [item for item in items if item.get_closest_marker(marker)]
    if marked:
        config.hook.pytest_deselected(items=marked)
        items[:] = [item for item in items if item not in marked]
    return len(marked)
