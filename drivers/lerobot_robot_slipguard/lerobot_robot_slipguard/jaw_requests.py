"""What a gripper position in an action means for slipguard: a request, or none. Pure: no clock, no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

MOVED_MM = 1.0
"""A smaller change of the commanded width is not sent."""
MISSED_MM = 3.0
REPEAT_S = 0.5
"""Jaws that stand still this far from the commanded width, after this time, are commanded again."""
FORCE_STEP_N = 1.0
BUSY = ("closing", "released")
"""Phases in which slipguard moves the jaws by itself."""


@dataclass(frozen=True)
class JawRequest:
    """A request to slipguard: `gripper` or `release`, with its fields."""

    kind: str
    fields: dict[str, Any]


def is_held(state: dict[str, Any]) -> bool:
    """Return whether an object may be held, from the daemon's state."""
    gripper = state["gripper"]
    return state["phase"] not in ("idle", *BUSY) or bool(gripper and gripper["holding"])


class JawRequests:
    """Turns a sequence of jaw openings into requests.

    While nothing is held, the jaws follow the opening; an object that they meet is guarded. A held object is released
    only if the opening is above `release_above` for `release_after_s`, and was below it before since the object is
    held and no fault is latched: a policy that commands open jaws all the time does not drop what another client
    gripped, nor what is still held when a person has cleared a fault.

    Args:
        stroke_mm: Width of an opening of 1.
        release_above: Between 0 and 1.
    """

    def __init__(self, stroke_mm: float, release_above: float, release_after_s: float) -> None:
        self._stroke_mm, self._release_above, self._release_after_s = stroke_mm, release_above, release_after_s
        self._may_release = False
        self._open_since_s: float | None = None
        self._sent_mm: float | None = None
        self._sent_s = 0.0

    def next(self, opening: float, force_n: float | None, state: dict[str, Any], now_s: float) -> JawRequest | None:
        """Return the request for one action; None if there is nothing to change.

        Args:
            opening: 0 closed, 1 open.
            force_n: Requested force per finger; None for the configured one. A held object is never loosened.
            state: The daemon's state.
        """
        if state["fault"] or not state["gripper"] or state["phase"] in BUSY:
            self._may_release, self._open_since_s = False, None
            return None
        if is_held(state):
            self._sent_mm = None
            return self._for_held(opening, force_n, state, now_s)
        self._may_release, self._open_since_s = False, None
        return self._for_empty(opening, force_n, state["gripper"], now_s)

    def _for_held(
        self, opening: float, force_n: float | None, state: dict[str, Any], now_s: float
    ) -> JawRequest | None:
        if opening <= self._release_above:
            self._may_release, self._open_since_s = True, None
            floor_n = max(state["target_force_n"], state["gripper"]["force_n"])
            if force_n is not None and force_n > floor_n + FORCE_STEP_N:
                return JawRequest("gripper", {"force_n": min(force_n, state["limits"]["force_max_n"])})
            return None
        if self._open_since_s is None:
            self._open_since_s = now_s
        if not self._may_release or now_s - self._open_since_s < self._release_after_s:
            return None
        self._may_release = False
        return JawRequest("release", {"confirm": True, "width_mm": opening * self._stroke_mm})

    def _for_empty(
        self, opening: float, force_n: float | None, gripper: dict[str, Any], now_s: float
    ) -> JawRequest | None:
        wanted_mm = opening * self._stroke_mm
        missed = abs(wanted_mm - gripper["width_mm"]) > MISSED_MM and not gripper["moving"]
        if gripper["closed_on_nothing"] and wanted_mm <= gripper["width_mm"]:
            missed = False
        changed = self._sent_mm is None or abs(wanted_mm - self._sent_mm) > MOVED_MM
        if not changed and not (missed and now_s - self._sent_s > REPEAT_S):
            return None
        self._sent_mm, self._sent_s = wanted_mm, now_s
        fields = {"width_mm": wanted_mm} | ({} if force_n is None else {"force_n": force_n})
        return JawRequest("gripper", fields)
