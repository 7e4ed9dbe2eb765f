"""What a running daemon says of itself and its devices: two looks at its state, a while apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from slipguard import __version__
from slipguard.daemon.loop.gel_monitor import GelStatus
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import GripperState
from slipguard.diagnosis import CheckResult, note, ok, problem
from slipguard.doctor import gripper, sensor

LOOK_S = 2.0
LATE_SHARE = 0.05

State = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Looks:
    """Two answers of `GET /state`, `apart_s` seconds apart."""

    before: State
    after: State
    apart_s: float

    def counted(self, finger: str, check: str) -> int:
        """How much a count of a finger has risen."""
        old, new = (one["fingers"][finger]["counts"].get(check, 0) for one in (self.before, self.after))
        return int(new - old)


def daemon(looks: Looks) -> Iterator[CheckResult]:
    """The daemon itself."""
    now = looks.after
    if now["version"] != __version__:
        yield note("daemon", f"runs version {now['version']}, installed is {__version__}", "restart it when convenient")
    else:
        yield ok("daemon", f"running, mode {now['mode']!r}, {now['phase']}; it was asked, no device was opened")
    fault = now.get("fault")
    if fault is not None:
        yield problem("fault", f"{fault['code']}: {fault['observed']}", fault["what_to_do"])
    late = now["deadlines_missed"] - looks.before["deadlines_missed"]
    if late:
        yield note("loop", f"{late} beats late in {looks.apart_s:.0f} s", "the processor is busy; see the line above")


def finger(name: str, looks: Looks, settings: Any, store: StateDir) -> Iterator[CheckResult]:
    """One fingertip camera, as the daemon has seen it."""
    serial = looks.after["fingers"][name]["serial"]
    yield found("sensor", name, looks, f"in use by the daemon, serial {serial}")
    for remark in looks.after["fingers"][name].get("remarks", ()):
        yield note("remark", remark)
    came = looks.counted(name, "frames")
    if not came:
        return
    yield sensor.rate(came / looks.apart_s, getattr(settings, "fps", None))
    count = {check: looks.counted(name, check) for check in ("missed", "corrupt", "frozen", "stalled", "late")}
    yield sensor.losses(came, count["missed"], count["corrupt"], count["frozen"] + count["stalled"])
    if count["late"] > LATE_SHARE * came:
        yield note("pictures", f"{count['late']} of {came} not looked at: too slow", "see the line on the processor")
    if serial:
        yield sensor.no_contact(serial, store, datetime.now(UTC))
    known = looks.after["fingers"][name].get("gel")
    if known is not None:
        yield gel(known)


def gel(known: Mapping[str, Any]) -> CheckResult:
    """How the gel is when nothing touches it."""
    if known["status"] == GelStatus.OK:
        return ok("gel", known["observed"])
    return note("gel", known["observed"], known["action"])


def actuator(name: str, looks: Looks) -> Iterator[CheckResult]:
    """Gripper or arm, as the daemon has seen it."""
    yield found(name, name, looks, "in use by the daemon")
    state, trips = looks.after.get(name), looks.after.get("round_trips", {}).get(name)
    if name == "gripper" and trips is not None:
        observed = f"p50 {trips['p50_ms']:.1f} ms, p99 {trips['p99_ms']:.1f} ms of {trips['answered']}"
        if trips["p50_ms"] > gripper.SLOW_MS:
            yield note("round trip", observed, gripper.SLOW_DO)
        else:
            yield ok("round trip", observed)
    if state is None:
        return
    if name == "gripper":
        yield from gripper.condition(GripperState(**state))
    else:
        yield arm_condition(bool(state["protective_stop"]), bool(state["emergency_stop"]))


def arm_condition(protective: bool, emergency: bool) -> CheckResult:
    """The stops that are for a person to clear."""
    if emergency:
        return problem("stops", "emergency stop", "release the button, then start the robot at its panel")
    if protective:
        return problem("stops", "protective stop", "look why, then unlock it at the panel")
    return ok("stops", "none active")


def found(check: str, name: str, looks: Looks, observed: str) -> CheckResult:
    """How the daemon finds a device."""
    health = looks.after["devices"][name]
    if health["state"] == "ready":
        return ok(check, observed)
    why = str(health.get("reason") or health["state"]).removeprefix(f"{name}: ")
    reason, split, action = why.rpartition("; ")
    return problem(
        check, f"{health['state']}: {reason if split else why}", action if split else "check its cable and power"
    )
