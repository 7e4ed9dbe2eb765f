"""The figures of the error model, by object: printed by `python -m slipguard.lab.grip.fit`."""

from __future__ import annotations

from slipguard.lab.grip.sight import SightError

ERRORS: dict[str, SightError] = {}
