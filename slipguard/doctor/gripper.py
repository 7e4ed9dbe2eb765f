"""A gripper through its port: is it there, how fast does it answer, what does it say of itself. It is only asked."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator

from slipguard.devices import Gripper, GripperState
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.doctor.figures import percentiles_ms, spread
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout

QUESTIONS = 100
UNANSWERED_SHARE = 0.01
SLOW_MS = 12.0
"""A round trip takes 4-8 ms; an FTDI adapter left at its default takes 16 ms."""
SLOW_DO = (
    "slow: a busy processor, or an adapter whose latency timer is not 1 ms (`slipguard install` puts the rule in place)"
)


async def look(name: str, gripper: Gripper) -> AsyncIterator[CheckResult]:
    """Connect, ask a hundred times, disconnect. `open` of a gripper moves nothing."""
    try:
        await gripper.open()
    except DeviceError as error:
        yield problem_from_error("gripper", error, name, "check its power and its cable")
        await gripper.close()
        return
    try:
        low_n, high_n = gripper.force_limits_n
        yield ok("gripper", f"answers; {low_n:g} to {high_n:g} N per finger")
        trips_s: list[float] = []
        unanswered = 0
        state: GripperState | None = None
        loop = asyncio.get_running_loop()
        for _ in range(QUESTIONS):
            asked_at_s = loop.time()
            try:
                state = await gripper.state()
                trips_s.append(loop.time() - asked_at_s)
            except DeviceTimeout:
                unanswered += 1
                if unanswered > QUESTIONS // 10 and not trips_s:
                    break
            except DeviceLost as error:
                yield problem_from_error("round trip", error, name, "check the cable and the adapter")
                return
        yield round_trip(trips_s, unanswered)
        if state is not None:
            for result in condition(state):
                yield result
    finally:
        await gripper.close()


def round_trip(trips_s: list[float], unanswered: int) -> CheckResult:
    """How long an answer takes, and how often none came."""
    if not trips_s:
        return problem("round trip", f"none of {unanswered} questions answered", "check the gripper's power and cable")
    total = len(trips_s) + unanswered
    observed = f"{spread(trips_s)} of {total}, {unanswered} unanswered"
    if unanswered > UNANSWERED_SHARE * total:
        return problem("round trip", observed, "check the RS-485 cable, its shield and its connectors")
    if percentiles_ms(trips_s)[0] > SLOW_MS:
        return note("round trip", observed, SLOW_DO)
    return ok("round trip", observed)


def condition(state: GripperState) -> Iterator[CheckResult]:
    """What it says of itself."""
    if state.fault is not None:
        yield problem("condition", f"fault: {state.fault}", "take hold of the object, then `slipguard ctl release`")
    elif not state.active:
        yield note(
            "condition",
            "not activated",
            "empty the jaws, then `slipguard ctl release`: the fingers open and close fully",
        )
    else:
        doing = "moving" if state.moving else "holding something" if state.holding else "at rest"
        if state.closed_on_nothing:
            doing = "closed on nothing"
        yield ok("condition", f"activated, {doing}, {state.width_mm:.0f} mm open")
