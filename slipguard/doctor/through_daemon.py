"""Check a running daemon and its devices, from two of its states some time apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

from slipguard import __version__
from slipguard.daemon.loop.gel_monitor import GelStatus
from slipguard.devices import GripperState
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.doctor import gripper, sensor

OBSERVE_S = 2.0
LATE_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class DaemonSamples:
    """Two responses to `GET /state`, `apart_s` seconds apart, and the stored background images by finger."""

    before: Mapping[str, Any]
    after: Mapping[str, Any]
    apart_s: float
    backgrounds: Mapping[str, Any] = field(default_factory=dict)

    def increase(self, finger: str, count: str) -> int:
        """Return by how much a count of a finger has risen."""
        old, new = (one["fingers"][finger]["counts"].get(count, 0) for one in (self.before, self.after))
        return int(new - old)


def check_daemon(samples: DaemonSamples) -> Iterator[CheckResult]:
    """Check version, faults and timing of the daemon."""
    now = samples.after
    if now["version"] != __version__:
        yield note("daemon", f"runs version {now['version']}, installed is {__version__}", "restart it when convenient")
    else:
        yield ok("daemon", f"running, mode {now['mode']!r}, {now['phase']}; no device was opened for this check")
    fault = now.get("fault")
    if fault is not None:
        yield problem("fault", f"{fault['code']}: {fault['observed']}", fault["what_to_do"])
    if now.get("config_problem"):
        yield problem("configuration", now["config_problem"], "correct the file, then `systemctl reload slipguard`")
    late = now["deadlines_missed"] - samples.before["deadlines_missed"]
    if late:
        yield note("loop", f"{late} cycles late in {samples.apart_s:.0f} s", "see the check of the processor")


def check_finger(name: str, samples: DaemonSamples, settings: Any) -> Iterator[CheckResult]:
    """Check one fingertip camera."""
    finger = samples.after["fingers"][name]
    serial = finger["serial"]
    yield check_health("sensor", name, samples, f"in use by the daemon, serial {serial}")
    for remark in finger.get("remarks", ()):
        yield note("remark", remark)
    received = samples.increase(name, "frames")
    if not received:
        return
    yield sensor.check_rate(received / samples.apart_s, getattr(settings, "fps", None))
    count = {one: samples.increase(name, one) for one in ("missed", "corrupt", "frozen", "stalled", "late")}
    yield sensor.check_losses(received, count["missed"], count["corrupt"], count["frozen"] + count["stalled"])
    since_start = finger["counts"]
    yield sensor.check_torn(since_start.get("torn", 0), since_start.get("frames", received))
    if count["late"] > LATE_SHARE * received:
        observed = f"{count['late']} of {received} not processed in time (limit {LATE_SHARE:.0%})"
        yield note("late frames", observed, "see the check of the processor")
    if serial:
        versions = samples.backgrounds.get(name, {}).get("versions", [])
        taken_at = datetime.fromisoformat(versions[-1]["created_at"]) if versions else None
        yield sensor.check_background_age(serial, taken_at, datetime.now(UTC))
    if finger.get("gel") is not None:
        yield check_gel(finger["gel"])


def check_gel(gel: Mapping[str, Any]) -> CheckResult:
    """Check the condition of an untouched gel."""
    if gel["status"] == GelStatus.OK:
        return ok("gel", gel["observed"])
    return note("gel", gel["observed"], gel["action"])


def check_actuator(name: str, samples: DaemonSamples) -> Iterator[CheckResult]:
    """Check the gripper or the arm."""
    yield check_health(name, name, samples, "in use by the daemon")
    state, trips = samples.after.get(name), samples.after.get("round_trips", {}).get(name)
    if name == "gripper" and trips is not None:
        observed = f"p50 {trips['p50_ms']:.1f} ms, p99 {trips['p99_ms']:.1f} ms of {trips['count']}"
        slow = trips["p50_ms"] > gripper.SLOW_MS
        yield note("round trip", observed, gripper.SLOW_ACTION) if slow else ok("round trip", observed)
    if state is None:
        return
    if name == "gripper":
        yield from gripper.check_state(GripperState(**state))
    else:
        yield check_stops(bool(state["protective_stop"]), bool(state["emergency_stop"]))


def check_stops(protective: bool, emergency: bool) -> CheckResult:
    """Check the stops of the arm that only a person can clear."""
    if emergency:
        return problem("stops", "emergency stop", "release the button, then start the robot at its panel")
    if protective:
        return problem("stops", "protective stop", "find the cause, then unlock it at the panel")
    return ok("stops", "none active")


def check_health(check: str, name: str, samples: DaemonSamples, observed: str) -> CheckResult:
    """Check the health that the daemon reports for a device."""
    health = samples.after["devices"][name]
    if health["state"] == "ready":
        return ok(check, observed)
    found = problem_from_error(check, health.get("reason") or health["state"], name, "check its cable and power")
    return replace(found, observed=f"{health['state']}: {found.observed}")
