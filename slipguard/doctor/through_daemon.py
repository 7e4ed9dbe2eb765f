"""Check a running daemon and its devices, from two of its states some time apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

from slipguard import __version__
from slipguard.daemon.api.state import State, StoredBackgrounds
from slipguard.daemon.loop.gel_condition import GelStatus
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.doctor import gripper, sensor

OBSERVE_S = 2.0
LATE_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class DaemonSamples:
    """Two states, `apart_s` seconds apart, and the stored background images by finger."""

    before: State
    after: State
    apart_s: float
    backgrounds: Mapping[str, StoredBackgrounds] = field(default_factory=dict)

    def increase(self, finger: str, count: str) -> int:
        """Return by how much a count of a finger has risen."""
        before, after = (getattr(one.fingers[finger].counts, count) for one in (self.before, self.after))
        return int(after - before)


def check_daemon(samples: DaemonSamples) -> Iterator[CheckResult]:
    """Check version, faults and timing of the daemon."""
    now = samples.after
    if now.version != __version__:
        yield note("daemon", f"runs version {now.version}, installed is {__version__}", "restart it when convenient")
    else:
        yield ok("daemon", f"running, mode {now.mode!r}, {now.phase.value}; no device was opened for this check")
    if now.fault is not None:
        yield problem("fault", f"{now.fault.code}: {now.fault.observed}", now.fault.what_to_do)
    if now.config_problem:
        yield problem("configuration", now.config_problem, "correct the file, then `systemctl reload slipguard`")
    late = now.deadlines_missed - samples.before.deadlines_missed
    if late:
        yield note("loop", f"{late} cycles late in {samples.apart_s:.0f} s", "see the check of the processor")


def check_finger(name: str, samples: DaemonSamples, settings: Any) -> Iterator[CheckResult]:
    """Check one fingertip camera."""
    finger = samples.after.fingers[name]
    yield check_health("sensor", name, samples, f"in use by the daemon, serial {finger.serial}")
    for remark in finger.remarks:
        yield note("remark", remark)
    received = samples.increase(name, "frames")
    if not received:
        return
    yield sensor.check_rate(received / samples.apart_s, getattr(settings, "fps", None))
    count = {one: samples.increase(name, one) for one in ("missed", "corrupt", "frozen", "stalled", "late")}
    yield sensor.check_losses(received, count["missed"], count["corrupt"], count["frozen"] + count["stalled"])
    yield sensor.check_torn(finger.counts.torn, finger.counts.frames)
    if count["late"] > LATE_SHARE * received:
        observed = f"{count['late']} of {received} not processed in time (limit {LATE_SHARE:.0%})"
        yield note("late frames", observed, "see the check of the processor")
    if finger.serial:
        versions = samples.backgrounds[name].versions if name in samples.backgrounds else []
        taken_at = versions[-1].created_at if versions else None
        yield sensor.check_background_age(finger.serial, taken_at, datetime.now(UTC))
    gel = finger.gel
    if gel is not None:
        yield ok("gel", gel.observed) if gel.status is GelStatus.OK else note("gel", gel.observed, gel.action)


def check_actuator(name: str, samples: DaemonSamples) -> Iterator[CheckResult]:
    """Check the gripper or the arm."""
    yield check_health(name, name, samples, "in use by the daemon")
    now = samples.after
    trips = now.round_trips.gripper
    if name == "gripper" and trips is not None:
        observed = f"p50 {trips.p50_ms:.1f} ms, p99 {trips.p99_ms:.1f} ms of {trips.count}"
        slow = trips.p50_ms > gripper.SLOW_MS
        yield note("round trip", observed, gripper.SLOW_ACTION) if slow else ok("round trip", observed)
    if name == "gripper" and now.gripper is not None:
        yield from gripper.check_state(now.gripper)
    if name == "arm" and now.arm is not None:
        yield check_stops(now.arm.protective_stop, now.arm.emergency_stop)


def check_stops(protective: bool, emergency: bool) -> CheckResult:
    """Check the stops of the arm that only a person can clear."""
    if emergency:
        return problem("stops", "emergency stop", "release the button, then start the robot at its panel")
    if protective:
        return problem("stops", "protective stop", "find the cause, then unlock it at the panel")
    return ok("stops", "none active")


def check_health(check: str, name: str, samples: DaemonSamples, observed: str) -> CheckResult:
    """Check the health that the daemon reports for a device."""
    health = samples.after.devices[name]
    if health.ready:
        return ok(check, observed)
    found = problem_from_error(check, health.reason or health.state, name, "check its cable and power")
    return replace(found, observed=f"{health.state}: {found.observed}")
