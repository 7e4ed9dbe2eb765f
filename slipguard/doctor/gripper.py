"""Check a gripper through its port: connection, response time, state. It is never moved."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator, Sequence

from slipguard.daemon.loop.driver_values import checked_gripper_state
from slipguard.devices import ACTIVATION_HINT, Gripper, GripperState
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout
from slipguard.tools.figures import percentiles_ms

READS = 100
LOST_SHARE = 0.01
SLOW_MS = 12.0
"""A round trip takes 4-8 ms; an FTDI adapter with its default latency timer takes 16 ms."""
SLOW_ACTION = (
    f"slow (limit {SLOW_MS:g} ms): a gripper that is connected through the robot, a busy processor, or an adapter "
    "whose latency timer is not 1 ms (`slipguard install` installs the udev rule)"
)
SLIP_DEG_S = (10.0, 37.0)
"""Rotation of a slipping object before a tightening acts: the loop's final slip grows by 1.5 to 5.5 degrees if its
latency grows from 100 to 250 ms, with a first force of 0.97 to 0.90 of the necessary one (simulated)."""


def describe_times(times_s: Sequence[float]) -> str:
    """Return p50 and p99 as text."""
    p50, p99 = percentiles_ms(times_s)
    return f"p50 {p50:.1f} ms, p99 {p99:.1f} ms"


async def check_gripper(name: str, gripper: Gripper) -> AsyncIterator[CheckResult]:
    """Connect, read the state a hundred times, disconnect. `open` of a gripper moves nothing."""
    try:
        await gripper.open()
    except DeviceError as error:
        yield problem_from_error("gripper", error, name, "check its power and its cable")
        await gripper.close()
        return
    try:
        low_n, high_n = gripper.force_limits_n
        yield ok("gripper", f"responds; {low_n:g} to {high_n:g} N per finger")
        trips_s: list[float] = []
        lost = 0
        state: GripperState | None = None
        loop = asyncio.get_running_loop()
        for _ in range(READS):
            asked_at_s = loop.time()
            try:
                state = checked_gripper_state(await gripper.state(), asked_at_s)
                trips_s.append(loop.time() - asked_at_s)
            except DeviceTimeout:
                lost += 1
                if lost > READS // 10 and not trips_s:
                    break
            except DeviceLost as error:
                yield problem_from_error("round trip", error, name, "check the cable and the adapter")
                return
        yield check_round_trips(trips_s, lost)
        if gripper.force_latency_s is not None:
            yield check_latency(gripper.force_latency_s)
        if state is not None:
            for result in check_state(state):
                yield result
    finally:
        await gripper.close()


def check_round_trips(trips_s: list[float], lost: int) -> CheckResult:
    """Check how long a response takes, and how many are lost."""
    if not trips_s:
        return problem("round trip", f"no response to {lost} requests", "check the gripper's power and cable")
    total = len(trips_s) + lost
    observed = f"{describe_times(trips_s)} of {total}, {lost} without a response"
    if lost > LOST_SHARE * total:
        return problem("round trip", observed, "check the RS-485 cable, its shield and its connectors")
    if percentiles_ms(trips_s)[0] > SLOW_MS:
        return note("round trip", observed, SLOW_ACTION)
    return ok("round trip", observed)


def check_latency(latency_s: float) -> CheckResult:
    """Say how long a tightening takes to act, and what that means for slip."""
    low_deg, high_deg = (rate * latency_s for rate in SLIP_DEG_S)
    observed = f"a tightening acts after about {latency_s * 1000.0:.0f} ms"
    return ok(
        "force latency", f"{observed}: an object that slips turns {low_deg:.1f} to {high_deg:.1f} degrees meanwhile"
    )


def check_state(state: GripperState) -> Iterator[CheckResult]:
    """Check the state that the gripper reports."""
    if state.fault is not None:
        yield problem("condition", f"fault: {state.fault}", ACTIVATION_HINT)
    elif not state.active:
        observed = "opened by an automatic release" if state.auto_released else "not activated"
        yield note("condition", observed, ACTIVATION_HINT)
    else:
        activity = "moving" if state.moving else "holding something" if state.holding else "at rest"
        if state.closed_on_nothing:
            activity = "closed on nothing"
        yield ok("condition", f"activated, {activity}, {state.width_mm:.0f} mm open")
