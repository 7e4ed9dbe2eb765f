"""Read the complete state of a running service: the response of `GET /state`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from slipguard import __version__
from slipguard.daemon.api.state import FingerState, Latency, Limits, RecordingState, RoundTrips, State
from slipguard.daemon.loop.finger import Finger
from slipguard.daemon.loop.gel_condition import GelCondition
from slipguard.daemon.loop.service import Service

EVENTS_MAX = 20
NOT_RECORDING = RecordingState()


def snapshot(service: Service, gels: Mapping[str, GelCondition], recording: RecordingState = NOT_RECORDING) -> State:
    """Return the state of the grasp and of each device, and the newest events."""
    observation, state, guard = service.observation, service.state, service.config.guard
    arm, ground_mm = service.arm.newest, state.arm.ground_mm
    return State(
        version=__version__,
        now_s=observation.now_s if observation is not None else None,
        mode=guard.mode,
        config_problem=service.config_problem,
        phase=state.phase,
        guarding=state.guarding,
        slipping=state.held.slip is not None,
        putting_down=state.arm.putting_down,
        stopped_by_request=state.stop is not None,
        target_force_n=state.grip.target_n,
        load_over_capacity=state.load_over_capacity,
        limits=Limits(
            first_force_n=guard.first_force_n,
            force_max_n=guard.limited(state.grip.limit_n).force_max_n,
            rotation_max_deg=guard.tuning.rotation_max_deg,
            lift_height_mm=guard.lift_height_mm,
        ),
        no_rotation_reason=state.held.no_estimate,
        fault=state.fault,
        rotation=observation.fused if observation is not None else None,
        gripper=service.gripper.newest,
        arm=arm if service.config.arm.present else None,
        has_arm=service.config.arm.present,
        lifted_mm=arm.height_mm - ground_mm if arm is not None and ground_mm is not None else None,
        fingers={name: _finger_state(service, finger, gels.get(name)) for name, finger in service.fingers.items()},
        devices={name: device.health for name, device in service.devices.items()},
        round_trips=RoundTrips(
            gripper=_latency(service.gripper.round_trips_s), arm=_latency(service.arm.round_trips_s)
        ),
        latency=_latency(service.latency_stats.latencies_s),
        waiting_for=service.waiting_for,
        deadlines_missed=service.deadlines_missed,
        events=[event for event in service.event_log.events if event.level != "fault"][-EVENTS_MAX:],
        last_slip=service.event_log.last_slip,
        recording=recording,
    )


def _finger_state(service: Service, finger: Finger, gel: GelCondition | None) -> FingerState:
    age_s = getattr(service.observation, finger.name).age_s if service.observation is not None else math.inf
    return FingerState(
        serial=finger.serial,
        estimate=finger.newest.estimate if finger.newest is not None else None,
        frames_per_s=service.latency_stats.frames_per_s[finger.name],
        age_s=age_s if math.isfinite(age_s) else None,
        counts=finger.capture.counts,
        remarks=finger.capture.remarks,
        gel=gel,
    )


def health_problem(service: Service) -> str | None:
    """Return in one line why the service is not healthy; None if it is."""
    fault = service.state.fault
    if fault is not None:
        return str(fault)
    waiting = service.waiting_for
    return f"not ready: {'; '.join(waiting)}" if waiting else service.config_problem


def _latency(times_s: Sequence[float]) -> Latency | None:
    """Return median and 99th percentile of the newest times; None if there are none."""
    if not times_s:
        return None
    in_order = sorted(times_s)
    p50, p99 = (1e3 * in_order[round(share * (len(in_order) - 1))] for share in (0.5, 0.99))
    return Latency(p50_ms=round(p50, 3), p99_ms=round(p99, 3), count=len(in_order))
