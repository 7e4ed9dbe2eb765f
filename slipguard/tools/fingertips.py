"""Measure where the gels of two fingertip sensors touch: `slipguard ctl fingertips`.

The empty jaws close step by step with the lowest force, until a finger sees contact or the gripper reports an object;
once with coarse steps, then with fine ones. The thickness of each sensor is half of that width.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from slipguard.daemon.api.requests import DaemonRequest, MoveJawsRequest, ReleaseRequest
from slipguard.devices import ACTIVATION_HINT
from slipguard.errors import CommandRefused, DeviceTimeout

State = Mapping[str, Any]

DEVICES = ("left", "right", "gripper")
FORCE_N = 1.0
"""Raised by the daemon to the lowest force of the gripper."""
COARSE_MM = 2.0
FINE_MM = 0.5
BACK_MM = 6.0
"""From the first contact back to where the fine steps begin; a 2F-85 releases by at least 5.6 mm."""
SEEN_S = 0.4
"""An image of the standing jaws has been measured after this time; an unchanged one is measured every 0.25 s."""
STEP_TIMEOUT_S = 5.0
POLL_S = 0.05


class FingertipMeasurement:
    """Closes the jaws of a running daemon until the gels touch.

    state: returns the response of `GET /state`. submit: submits a request. report: receives each width, in mm.
    """

    def __init__(
        self,
        state: Callable[[], Awaitable[State]],
        submit: Callable[[DaemonRequest], Awaitable[object]],
        report: Callable[[float], None],
    ) -> None:
        self._state, self._submit, self._report = state, submit, report

    async def run(self) -> float | None:
        """Return the width in mm at which the gels touch; None if they do not. The jaws are open afterwards.

        Raises CommandRefused if the cell is not ready, and DeviceTimeout if the jaws do not move.
        """
        check_ready(await self._state())
        try:
            near_mm = await self._close(COARSE_MM)
            if near_mm is None:
                return None
            await self._release(near_mm + BACK_MM)
            return await self._close(FINE_MM)
        finally:
            await self._release(None)

    async def _close(self, step_mm: float) -> float | None:
        """Close in steps; return the width before the first contact, or None at the limit of closing."""
        state = await self._standing()
        while not _touches(state):
            width_mm = float(state["gripper"]["width_mm"])
            self._report(width_mm)
            await self._submit(MoveJawsRequest(width_mm=max(width_mm - step_mm, 0.0), force_n=FORCE_N))
            state = await self._standing()
            if _touches(state):
                return width_mm
            if width_mm - state["gripper"]["width_mm"] < FINE_MM / 4:
                return None
        raise CommandRefused("a finger still sees contact with open jaws; clean the gels, calibrate, and try again")

    async def _release(self, width_mm: float | None) -> None:
        await self._submit(ReleaseRequest(confirm=True, width_mm=width_mm))
        await self._standing()

    async def _standing(self) -> State:
        """Wait until the jaws stand and have been seen; return the state."""
        loop = asyncio.get_running_loop()
        began_s = stood_s = loop.time()
        while True:
            await asyncio.sleep(POLL_S)
            state = await self._state()
            if (state["gripper"] or {}).get("moving", True) or state["phase"] == "released":
                stood_s = loop.time()
            if loop.time() - stood_s >= SEEN_S:
                return state
            if loop.time() - began_s > STEP_TIMEOUT_S:
                raise DeviceTimeout(
                    f"the jaws do not come to rest within {STEP_TIMEOUT_S:g} s; see `slipguard ctl state`"
                )


def check_ready(state: State) -> None:
    """Raise CommandRefused unless the jaws are open and empty, and both fingers see that."""
    if state["phase"] != "idle":
        raise CommandRefused(
            f"the jaws must be empty, and the phase is {state['phase']}; support what they hold, then release"
        )
    for name in DEVICES:
        if state["devices"][name]["state"] != "ready":
            raise CommandRefused(f"{name} is not ready: {state['devices'][name]['reason']}")
    if not state["gripper"]["active"]:
        raise CommandRefused(f"the gripper is not activated; {ACTIVATION_HINT}")
    if state["gripper"]["closed_on_nothing"] or _touches(state):
        raise CommandRefused(
            "the jaws are closed or a finger sees contact; open the jaws, and calibrate if they are open"
        )


def _touches(state: State) -> bool:
    estimates = [finger["estimate"] for finger in state["fingers"].values()]
    return bool(state["gripper"]["holding"]) or any(one is None or one["contact"] for one in estimates)


def describe(touch_mm: float | None) -> str:
    """Return the result as text, with the lines for the configuration."""
    if touch_mm is None:
        return (
            "the gels do not touch at the limit of closing: fingertip_mm is right, or too large by an unknown amount. "
            "There the gap between the gels must be about 1 mm, such as the edge of a coin. If it is wider, set "
            "fingertip_mm = 0, restart the daemon and measure again: the jaws then close further, as slowly, until the "
            "gels touch"
        )
    each_mm = touch_mm / 2.0
    return (
        f"the gels touch when the jaws are {touch_mm:.1f} mm apart: increase fingertip_mm by {each_mm:.1f}. "
        "If it was 0, these are the lines:\n\n"
        f"[gripper.robotiq]\nfingertip_mm = {each_mm:.1f}"
    )
