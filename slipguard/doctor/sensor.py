"""Check a fingertip camera through its port: connection, frame rate, lost frames, background image."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from slipguard.daemon.loop.capture import FrameCounts
from slipguard.daemon.loop.driver_values import checked_frame
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import TactileSensor
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.doctor.gripper import describe_times
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, InputError
from slipguard.perception.image_quality import find_tear

OBSERVE_S = 2.0
FIRST_FRAME_S = 4.0
"""Time limit for the first frame."""
SETTLE_S = 0.5
"""The first frames of a camera do not show its rate."""
RATE_SHARE = 0.95
LOST_NOTE, LOST_PROBLEM = 0.02, 0.05
"""Shares of frames. A healthy USB camera loses 0.1-1 %; at 5 % slip is detected frames later."""
TORN_PROBLEM = 0.02
"""Share of torn frames: 0 on an idle machine, about 5 % with two DIGITs under load."""
OLD_DAYS = 30
"""Gels wear and lights age; an older background image should be taken again."""
MORE_BANDWIDTH = (
    "plug the two sensors into ports of different USB controllers, without a hub, or set 30 fps; "
    "a busy processor loses frames as well"
)
CALIBRATE = "open and empty the jaws and run `slipguard calibrate`"


@dataclass(slots=True)
class FrameStatistics:
    """The frames of an observation. Times in seconds of the monotonic clock."""

    captured_s: list[float] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    sequences: list[int] = field(default_factory=list)
    counts: FrameCounts = field(default_factory=FrameCounts)
    loss: str | None = None
    """Why the sensor was lost."""

    @property
    def rate_hz(self) -> float:
        """Received frames per second."""
        if len(self.captured_s) < 2 or self.captured_s[-1] <= self.captured_s[0]:
            return 0.0
        return (len(self.captured_s) - 1) / (self.captured_s[-1] - self.captured_s[0])

    @property
    def missed(self) -> int:
        """Frames that the camera counted but that were not received."""
        return max(0, self.sequences[-1] - self.sequences[0] + 1 - len(self.sequences)) if self.sequences else 0


async def check_sensor(name: str, sensor: TactileSensor, settings: Any, store: StateDir) -> AsyncIterator[CheckResult]:
    """Open the sensor, observe it for two seconds, close it."""
    try:
        await sensor.open()
    except DeviceError as error:
        yield problem_from_error("sensor", error, name, "check its cable")
        return
    try:
        yield ok("sensor", f"found, serial {sensor.serial}")
        statistics = await observe_frames(sensor, OBSERVE_S)
        configured_hz = getattr(settings, "fps", None) or getattr(sensor, "fps", None)
        for result in check_frames(statistics, configured_hz):
            yield result
        for remark in getattr(sensor, "remarks", ()):
            yield note("remark", remark)
        yield check_background(sensor.serial, store, datetime.now(UTC))
    finally:
        await sensor.close()


async def observe_frames(sensor: TactileSensor, for_s: float) -> FrameStatistics:
    """Receive frames for a time after the first one, and count errors."""
    statistics, last = FrameStatistics(), None
    loop = asyncio.get_running_loop()
    begin_s: float | None = None
    end_s = loop.time() + FIRST_FRAME_S
    while (now_s := loop.time()) < end_s:
        try:
            frame = checked_frame(await sensor.next_frame())
        except DeviceLost as error:
            statistics.loss = str(error)
            return statistics
        except DeviceError as error:
            if begin_s is None and isinstance(error, DeviceTimeout):
                continue
            statistics.counts.add_error(error)
            continue
        if begin_s is None:
            begin_s, end_s = now_s + SETTLE_S, now_s + SETTLE_S + for_s
        if now_s >= begin_s:
            statistics.captured_s.append(frame.captured_at_s)
            statistics.ages_s.append(loop.time() - frame.captured_at_s)
            statistics.sequences.append(frame.sequence)
            statistics.counts.torn += last is not None and find_tear(frame.image, last) is not None
            last = frame.image
    return statistics


def check_frames(statistics: FrameStatistics, configured_hz: float | None) -> Iterator[CheckResult]:
    """Check rate, losses and age of the frames."""
    counts, replug = statistics.counts, "unplug the sensor and plug it in again"
    if statistics.loss is not None:
        yield problem("frames", f"the sensor was lost: {statistics.loss}", "check its cable and the USB port")
    elif counts.frozen and statistics.rate_hz < 1.0:
        yield problem("frames", "the sensor repeats the same image", replug)
    elif counts.corrupt and statistics.rate_hz < 1.0:
        action = "try another cable or port, without a hub"
        yield problem("frames", f"all {counts.corrupt} frames damaged", action)
    elif not statistics.captured_s:
        yield problem("frames", f"no frame within {FIRST_FRAME_S:g} s", replug)
    else:
        yield check_rate(statistics.rate_hz, configured_hz)
        yield check_losses(len(statistics.sequences), statistics.missed, counts.corrupt, counts.frozen + counts.stalled)
        yield check_torn(counts.torn, len(statistics.sequences))
        yield ok("frame age", f"{describe_times(statistics.ages_s)} from the time stamp to reception")


def check_rate(rate_hz: float, configured_hz: float | None) -> CheckResult:
    """Compare the frame rate with the configured one."""
    if configured_hz is None:
        return ok("frame rate", f"{rate_hz:.1f} fps")
    observed = f"{rate_hz:.1f} fps ({configured_hz:g} configured)"
    if rate_hz < RATE_SHARE * configured_hz:
        return problem("frame rate", observed, MORE_BANDWIDTH)
    return ok("frame rate", observed)


def check_losses(received: int, missed: int, damaged: int, interruptions: int) -> CheckResult:
    """Check how many frames were lost or damaged."""
    total = received + missed + damaged
    share = (missed + damaged) / max(total, 1)
    observed = f"{missed} lost, {damaged} damaged of {total} ({100 * share:.1f} %)"
    if interruptions:
        observed += f", {interruptions} times repeated or stalled"
    if share > LOST_PROBLEM or interruptions:
        return problem("lost frames", observed, MORE_BANDWIDTH)
    return note("lost frames", observed, MORE_BANDWIDTH) if share > LOST_NOTE else ok("lost frames", observed)


def check_torn(torn: int, received: int) -> CheckResult:
    """Check how many frames have parts of two captures; both sensors stream meanwhile."""
    observed = f"{torn} of {received}"
    if torn == 0:
        return ok("torn frames", f"{observed}; only motion on the gel shows them")
    if torn > TORN_PROBLEM * received:
        return problem("torn frames", f"{observed} (limit {TORN_PROBLEM:.0%})", MORE_BANDWIDTH)
    return note("torn frames", observed, MORE_BANDWIDTH)


def check_background(serial: str, store: StateDir, now: datetime) -> CheckResult:
    """Check the stored background image, without which no object can be grasped."""
    try:
        taken_at = store.background_created_at(serial)
        if taken_at is not None:
            store.load_background(serial)
    except InputError as error:
        return problem("background image", str(error), CALIBRATE)
    return check_background_age(serial, taken_at, now)


def check_background_age(serial: str, taken_at: datetime | None, now: datetime) -> CheckResult:
    """Check when the newest background image was taken. taken_at: None if there is none."""
    if taken_at is None:
        return problem("background image", f"none stored for {serial}", CALIBRATE)
    age = now - taken_at
    observed = f"{_describe_age(age.total_seconds())} old"
    if age.days >= OLD_DAYS:
        return note("background image", f"{observed} (limit {OLD_DAYS} days)", CALIBRATE)
    return ok("background image", observed)


def _describe_age(seconds: float) -> str:
    if seconds < 3600:
        return f"{max(seconds, 0) / 60:.0f} min"
    return f"{seconds / 3600:.0f} h" if seconds < 2 * 86400 else f"{seconds / 86400:.0f} days"
