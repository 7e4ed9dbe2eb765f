"""A fingertip camera through its port: does it come, how fast, what is lost, and is its no-contact image there."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import TactileSensor
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.doctor.figures import spread
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen, InputError

LOOK_S = 2.0
FIRST_S = 4.0
"""A stream that has begun by then has begun."""
SETTLE_S = 0.5
"""What a camera delivers first is no measure of its rate."""
RATE_SHARE = 0.95
LOST_NOTE, LOST_WRONG = 0.02, 0.05
"""Shares of frames. A healthy USB camera loses 0.1-1 %; at 5 % slip is seen frames later."""
OLD_DAYS = 30
"""Gels wear and lights age; a no-contact image older than this is worth taking anew."""
MORE_BANDWIDTH = (
    "plug the two sensors into ports of different USB controllers, without a hub, or ask for 30 fps; "
    "a busy processor loses frames as well"
)


@dataclass(slots=True)
class Watched:
    """What came in a while. Times in seconds of the monotonic clock."""

    captured_s: list[float] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)
    corrupt: int = 0
    frozen: int = 0
    stalled: int = 0
    lost_why: str | None = None

    @property
    def rate_hz(self) -> float:
        """Frames that came, a second."""
        if len(self.captured_s) < 2 or self.captured_s[-1] <= self.captured_s[0]:
            return 0.0
        return (len(self.captured_s) - 1) / (self.captured_s[-1] - self.captured_s[0])

    @property
    def lost(self) -> int:
        """Frames that the camera counted and that never came."""
        return max(0, self.sequences[-1] - self.sequences[0] + 1 - len(self.sequences)) if self.sequences else 0


async def look(name: str, sensor: TactileSensor, settings: Any, store: StateDir) -> AsyncIterator[CheckResult]:
    """Open the sensor, watch it for two seconds, close it."""
    try:
        await sensor.open()
    except DeviceError as error:
        yield problem_from_error("sensor", error, name, "check its cable")
        return
    try:
        yield ok("sensor", f"found, serial {sensor.serial}")
        watched = await watch(sensor, LOOK_S)
        asked_hz = getattr(settings, "fps", None) or getattr(sensor, "fps", None)
        for result in frames(watched, asked_hz):
            yield result
        for remark in getattr(sensor, "remarks", ()):
            yield note("remark", remark)
        yield no_contact(sensor.serial, store, datetime.now(UTC))
    finally:
        await sensor.close()


async def watch(sensor: TactileSensor, for_s: float) -> Watched:
    """Take frames for a while after the first; what goes wrong is counted."""
    observed = Watched()
    loop = asyncio.get_running_loop()
    begins_s: float | None = None
    ends_s = loop.time() + FIRST_S
    while (now_s := loop.time()) < ends_s:
        try:
            frame = await sensor.next_frame()
        except DeviceLost as error:
            observed.lost_why = str(error)
            return observed
        except DeviceError as error:
            if begins_s is None and isinstance(error, DeviceTimeout):
                continue
            observed.corrupt += isinstance(error, FrameCorrupt)
            observed.frozen += isinstance(error, FrameFrozen)
            observed.stalled += isinstance(error, DeviceTimeout)
            continue
        if begins_s is None:
            begins_s, ends_s = now_s + SETTLE_S, now_s + SETTLE_S + for_s
        if now_s >= begins_s:
            observed.captured_s.append(frame.captured_at_s)
            observed.ages_s.append(loop.time() - frame.captured_at_s)
            observed.sequences.append(frame.sequence)
    return observed


def frames(observed: Watched, asked_hz: float | None) -> Iterator[CheckResult]:
    """Rate, losses and age of what came."""
    if observed.lost_why is not None:
        yield problem(
            "frames", f"it went away while it was watched: {observed.lost_why}", "check its cable and the USB port"
        )
        return
    if observed.frozen and observed.rate_hz < 1.0:
        yield problem("frames", "the same picture again and again", "unplug the sensor and plug it in again")
        return
    if observed.corrupt and observed.rate_hz < 1.0:
        yield problem("frames", f"all {observed.corrupt} frames damaged", "try another cable or port, without a hub")
        return
    if not observed.captured_s:
        yield problem("frames", f"none came in {FIRST_S:g} s", "unplug the sensor and plug it in again")
        return
    yield rate(observed.rate_hz, asked_hz)
    yield losses(len(observed.sequences), observed.lost, observed.corrupt, observed.frozen + observed.stalled)
    yield ok("frame age", f"{spread(observed.ages_s)} from the time stamp until it is here")


def rate(rate_hz: float, asked_hz: float | None) -> CheckResult:
    """The real rate beside the asked one."""
    if asked_hz is None:
        return ok("frame rate", f"{rate_hz:.1f} fps")
    observed = f"{rate_hz:.1f} fps of {asked_hz:g} asked for"
    if rate_hz < RATE_SHARE * asked_hz:
        return problem("frame rate", observed, MORE_BANDWIDTH)
    return ok("frame rate", observed)


def losses(came: int, lost: int, damaged: int, interruptions: int) -> CheckResult:
    """What did not come, or not whole."""
    share = (lost + damaged) / max(came + lost + damaged, 1)
    observed = f"{lost} lost, {damaged} damaged of {came + lost + damaged} ({100 * share:.1f} %)"
    if interruptions:
        observed += f", {interruptions} times repeating or standing still"
    if share > LOST_WRONG or interruptions:
        return problem("lost frames", observed, MORE_BANDWIDTH)
    return note("lost frames", observed, MORE_BANDWIDTH) if share > LOST_NOTE else ok("lost frames", observed)


def no_contact(serial: str, store: StateDir, now: datetime) -> CheckResult:
    """The stored picture of the untouched gel, without which nothing is grasped."""
    again = "jaws open and empty: `slipguard calibrate`"
    try:
        taken_at = store.background_created_at(serial)
        if taken_at is not None:
            store.load_background(serial)
    except InputError as error:
        return problem("no-contact image", str(error), again)
    if taken_at is None:
        return problem("no-contact image", f"none of {serial} is stored", again)
    age = now - taken_at
    observed = f"{_age(age.total_seconds())} old"
    return note("no-contact image", observed, again) if age.days >= OLD_DAYS else ok("no-contact image", observed)


def _age(seconds: float) -> str:
    if seconds < 3600:
        return f"{max(seconds, 0) / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 2 * 86400 else f"{seconds / 86400:.0f} days"
