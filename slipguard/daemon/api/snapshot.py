"""The complete state of a running service, as JSON-compatible values: the response of `GET /state`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from slipguard import __version__
from slipguard.daemon.loop.gel_monitor import GelCondition
from slipguard.daemon.loop.service import Service

EVENTS_MAX = 20


def snapshot(service: Service, gels: Mapping[str, GelCondition]) -> dict[str, object]:
    """Return the state of the grasp and of each device, and the newest events.

    Times are on the monotonic clock. now_s: start of the last cycle of the loop. limits: from the configuration.
    lifted_mm: height of the arm above where the lift began; None if that is not known.
    """
    observation, state, guard = service.observation, service.state, service.config.guard
    fault, arm, ground_mm = state.fault, service.arm.newest, state.arm.ground_mm
    return {
        "version": __version__,
        "now_s": observation.now_s if observation is not None else None,
        "mode": guard.mode,
        "config_problem": service.config_problem,
        "phase": state.phase.value,
        "guarding": state.guarding,
        "slipping": state.held.slip is not None,
        "putting_down": state.arm.putting_down,
        "stopped_by_request": state.stop is not None,
        "target_force_n": state.grip.target_n,
        "limits": {
            "first_force_n": guard.first_force_n,
            "force_max_n": guard.limited(state.grip.limit_n).force_max_n,
            "lift_height_mm": guard.lift_height_mm,
        },
        "no_rotation_reason": state.held.no_estimate,
        "fault": None
        if fault is None
        else {"code": fault.code.value, "observed": fault.observed, "what_to_do": fault.what_to_do},
        "rotation": _plain(observation.fused) if observation is not None else None,
        "gripper": _plain(service.gripper.newest),
        "arm": _plain(arm) if service.config.arm.present else None,
        "has_arm": service.config.arm.present,
        "lifted_mm": arm.height_mm - ground_mm if arm is not None and ground_mm is not None else None,
        "fingers": {
            name: {
                "serial": finger.serial,
                "estimate": _plain(finger.newest.estimate) if finger.newest is not None else None,
                "frames_per_s": service.latency_stats.frames_per_s[name],
                "age_s": _plain(getattr(observation, name).age_s) if observation is not None else None,
                "counts": _plain(finger.capture.counts),
                "remarks": finger.capture.remarks,
                "gel": _plain(gels.get(name)),
            }
            for name, finger in service.fingers.items()
        },
        "devices": {name: device.health.as_dict() for name, device in service.devices.items()},
        "round_trips": {
            "gripper": _latency(service.gripper.round_trips_s),
            "arm": _latency(service.arm.round_trips_s),
        },
        "latency": _latency(service.latency_stats.latencies_s),
        "waiting_for": service.waiting_for,
        "deadlines_missed": service.deadlines_missed,
        "events": _newest_events(service),
    }


def _newest_events(service: Service) -> list[dict[str, object]]:
    """Return infos and warnings; a fault is in `fault`, and was reported as a warning before."""
    events = [event for event in service.event_log.events if event.level != "fault"]
    return [{"at_s": event.at_s, "level": event.level, "text": event.text} for event in events[-EVENTS_MAX:]]


def health_problem(service: Service) -> str | None:
    """Return in one line why the service is not healthy; None if it is."""
    fault = service.state.fault
    if fault is not None:
        return str(fault)
    waiting = service.waiting_for
    return f"not ready: {'; '.join(waiting)}" if waiting else service.config_problem


def _latency(times_s: Sequence[float]) -> dict[str, float] | None:
    """Return median and 99th percentile of the newest times; None if there are none."""
    if not times_s:
        return None
    in_order = sorted(times_s)
    p50, p99 = (1e3 * in_order[round(share * (len(in_order) - 1))] for share in (0.5, 0.99))
    return {"p50_ms": round(p50, 3), "p99_ms": round(p99, 3), "count": len(in_order)}


def _plain(value: Any) -> Any:
    """Convert dataclasses to dicts, and infinite numbers and NaN to None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
