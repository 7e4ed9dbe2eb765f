"""Tests that need what is not here are deselected, and the closing lines say so, also those of several processes."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

_LINES = pytest.StashKey[list[str]]()
_SENT = "what was left out"


def leave_out(config: pytest.Config, items: list[pytest.Item], marker: str, why: str) -> None:
    """Deselect what carries the marker; why: the rest of a closing line that begins with how many tests there were."""
    marked = [item for item in items if item.get_closest_marker(marker)]
    if marked:
        config.hook.pytest_deselected(items=marked)
        items[:] = [item for item in items if item not in marked]
        _remember(config, [f"{len(marked)} tests {why}"])


def closing_lines(config: pytest.Config) -> list[str]:
    """What was left out, in words."""
    return config.stash.get(_LINES, [])


def send(config: pytest.Config) -> None:
    """At the end of a worker process of pytest-xdist: its lines, to the process that prints."""
    if hasattr(config, "workeroutput"):
        config.workeroutput[_SENT] = closing_lines(config)


def receive(config: pytest.Config, output: dict[str, list[str]]) -> None:
    """From a worker; each of them looks at all tests and tells the same."""
    _remember(config, output.get(_SENT, []))


def _remember(config: pytest.Config, lines: Iterable[str]) -> None:
    known = config.stash.setdefault(_LINES, [])
    known.extend(line for line in lines if line not in known)
