"""A fingertip camera through its port: does it come, how fast, what is lost, and is its no-contact image there."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import TactileSensor
from slipguard.diagnosis import Finding, fine, from_error, note, wrong
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


async def look(name: str, sensor: TactileSensor, settings: Any, store: StateDir) -> AsyncIterator[Finding]:
    """Open the sensor, watch it for two seconds, close it."""
    try:
        await sensor.open()
    except DeviceError as error:
        yield from_error("sensor", error, name, "check its cable")
        return
    try:
        yield fine("sensor", f"found, serial {sensor.serial}")
        watched = await watch(sensor, LOOK_S)
        asked_hz = getattr(settings, "fps", None) or getattr(sensor, "fps", None)
        for finding in frames(watched, asked_hz):
            yield finding
        for remark in getattr(sensor, "remarks", ()):
            yield note("remark", remark)
        yield no_contact(sensor.serial, store, datetime.now(UTC))
    finally:
        await sensor.close()


async def watch(sensor: TactileSensor, for_s: float) -> Watched:
    """Take frames for a while after the first; what goes wrong is counted."""
    seen = Watched()
    loop = asyncio.get_running_loop()
    begins_s: float | None = None
    ends_s = loop.time() + FIRST_S
    while (now_s := loop.time()) < ends_s:
        try:
            frame = await sensor.next_frame()
        except DeviceLost as error:
            seen.lost_why = str(error)
            return seen
        except DeviceError as error:
            if begins_s is None and isinstance(error, DeviceTimeout):
                continue
            seen.corrupt += isinstance(error, FrameCorrupt)
            seen.frozen += isinstance(error, FrameFrozen)
            seen.stalled += isinstance(error, DeviceTimeout)
            continue
        if begins_s is None:
            begins_s, ends_s = now_s + SETTLE_S, now_s + SETTLE_S + for_s
        if now_s >= begins_s:
            seen.captured_s.append(frame.captured_at_s)
            seen.ages_s.append(loop.time() - frame.captured_at_s)
            seen.sequences.append(frame.sequence)
    return seen


def frames(seen: Watched, asked_hz: float | None) -> Iterator[Finding]:
    """Rate, losses and age of what came."""
    if seen.lost_why is not None:
        yield wrong("frames", f"it went away while it was watched: {seen.lost_why}", "check its cable and the USB port")
        return
    if seen.frozen and seen.rate_hz < 1.0:
        yield wrong("frames", "the same picture again and again", "unplug the sensor and plug it in again")
        return
    if seen.corrupt and seen.rate_hz < 1.0:
        yield wrong("frames", f"all {seen.corrupt} frames damaged", "try another cable or port, without a hub")
        return
    if not seen.captured_s:
        yield wrong("frames", f"none came in {FIRST_S:g} s", "unplug the sensor and plug it in again")
        return
    yield rate(seen.rate_hz, asked_hz)
    yield losses(len(seen.sequences), seen.lost, seen.corrupt, seen.frozen + seen.stalled)
    yield fine("frame age", f"{spread(seen.ages_s)} from the time stamp until it is here")


def rate(rate_hz: float, asked_hz: float | None) -> Finding:
    """The real rate beside the asked one."""
    if asked_hz is None:
        return fine("frame rate", f"{rate_hz:.1f} fps")
    seen = f"{rate_hz:.1f} fps of {asked_hz:g} asked for"
    if rate_hz < RATE_SHARE * asked_hz:
        return wrong("frame rate", seen, MORE_BANDWIDTH)
    return fine("frame rate", seen)


def losses(came: int, lost: int, damaged: int, interruptions: int) -> Finding:
    """What did not come, or not whole."""
    share = (lost + damaged) / max(came + lost + damaged, 1)
    seen = f"{lost} lost, {damaged} damaged of {came + lost + damaged} ({100 * share:.1f} %)"
    if interruptions:
        seen += f", {interruptions} times repeating or standing still"
    if share > LOST_WRONG or interruptions:
        return wrong("lost frames", seen, MORE_BANDWIDTH)
    return note("lost frames", seen, MORE_BANDWIDTH) if share > LOST_NOTE else fine("lost frames", seen)


def no_contact(serial: str, store: StateDir, now: datetime) -> Finding:
    """The stored picture of the untouched gel, without which nothing is grasped."""
    again = "jaws open and empty: `slipguard calibrate`"
    try:
        taken_at = store.background_created_at(serial)
        if taken_at is not None:
            store.load_background(serial)
    except InputError as error:
        return wrong("no-contact image", str(error), again)
    if taken_at is None:
        return wrong("no-contact image", f"none of {serial} is stored", again)
    age = now - taken_at
    seen = f"{_age(age.total_seconds())} old"
    return note("no-contact image", seen, again) if age.days >= OLD_DAYS else fine("no-contact image", seen)


def _age(seconds: float) -> str:
    if seconds < 3600:
        return f"{max(seconds, 0) / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 2 * 86400 else f"{seconds / 86400:.0f} days"
