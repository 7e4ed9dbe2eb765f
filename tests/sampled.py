"""Parameters of which a plain `python -m pytest` takes a part, so that it stays short; `.ci/run` takes all."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def sampled(values: Iterable[Any], every: int = 3) -> list[Any]:
    """Return pytest parameters: one of `every` values without, the others with the marker `campaign`."""
    return [
        pytest.param(
            *(value if isinstance(value, tuple) else (value,)), marks=[pytest.mark.campaign] if number % every else []
        )
        for number, value in enumerate(values)
    ]
