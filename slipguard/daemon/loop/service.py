"""The service: four devices, one pure controller, and the control loop that connects them.

The loop wakes on every new estimate and on every tick. One cycle gathers an observation, computes the control step,
issues the command and publishes the decision. It never waits for a device: `Actuator` and `Finger` do that in tasks
of their own.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial

import structlog

from slipguard.config import Config
from slipguard.control.control_step import ControlState, control_step
from slipguard.control.finger_fusion import fuse
from slipguard.control.messages import (
    ActivateGripper,
    Condition,
    ControlRequest,
    FingerHealth,
    HaltJaws,
    HoldForce,
    LiftArm,
    MoveJaws,
    Observation,
    ReleaseJaws,
    RequestKind,
    StepOutput,
    StopArm,
)
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault
from slipguard.control.state import GraspState, Phase, gripper_at_rest
from slipguard.daemon.lifecycle import notify_systemd, watchdog_period_s
from slipguard.daemon.loop.actuator import Actuator
from slipguard.daemon.loop.async_tools import Ticker
from slipguard.daemon.loop.capture import StreamRestarts
from slipguard.daemon.loop.decision import Decision, LatencyStats
from slipguard.daemon.loop.device_health import DeviceAlerts, find_problems
from slipguard.daemon.loop.driver_values import checked_arm_state, checked_gripper_state
from slipguard.daemon.loop.event_log import EventKind, EventLog
from slipguard.daemon.loop.finger import Finger, PerceptionPipeline, TimedEstimate
from slipguard.daemon.loop.observers import Observers
from slipguard.daemon.loop.request_queue import RequestQueue
from slipguard.daemon.loop.worker import Worker
from slipguard.daemon.store.background_images import BackgroundStore
from slipguard.devices import FINGERS, Arm, ArmState, Gripper, GripperState, TactileSensor
from slipguard.errors import CommandRefused
from slipguard.perception.estimate import Estimate

BUSY_WINDOW_S = 1.0
BUSY_S = 0.05
"""A loop that was late for this long may have read a response too late; a gripper has 50 ms to respond."""
SLIP_MESSAGES = ("tightening", "at_force_limit")
"""Messages of the controller (`slipguard.control.reports.Text`) about slip."""

Controller = Callable[[ControlState, Observation, GuardParams], tuple[ControlState, StepOutput]]
log = structlog.get_logger()


class Service:
    """Runs fingers, gripper, arm and controller until cancelled; then the grip stays as it is.

    Args:
        make_worker: Makes the worker of each finger.
        make_pipeline: By finger, makes the pipeline for a serial number.
        store: Where background images are stored.
        controller: The pure control step.
        control_state: The controller's state from before a restart.
    """

    def __init__(
        self,
        config: Config,
        *,
        sensors: Mapping[str, TactileSensor],
        gripper: Gripper,
        arm: Arm,
        make_worker: Callable[[str], Worker],
        make_pipeline: Mapping[str, Callable[[str], PerceptionPipeline]],
        store: BackgroundStore,
        controller: Controller = control_step,
        control_state: ControlState | None = None,
    ) -> None:
        self.config = config
        self.config_problem: str | None = None
        """Why the configuration file is not in use; until it is, nothing new is gripped or lifted."""
        self.store = store
        self.latency_stats = LatencyStats(FINGERS)
        self.event_log = EventLog()
        warning = self.event_log.warning
        self.observers: Observers[Decision] = Observers(self.latency_stats.add_decision, report=warning)
        self.hold_observers: Observers[float] = Observers(self.latency_stats.add_hold, report=warning)
        """Called when a force command is sent to the gripper, with the seconds since its frame was received."""
        self.deadlines_missed = 0
        self._late: deque[tuple[float, float]] = deque()
        """Loop time of each late cycle of the last `BUSY_WINDOW_S`, and by how much it was late."""
        self._control_state = control_state or ControlState()
        self.observation: Observation | None = None
        self._controller = controller
        self._gripper_device = gripper
        self._gripper_limits_n = gripper.force_limits_n
        self._arm_device = arm
        self._wake = asyncio.Event()
        self._workers = {name: make_worker(name) for name in FINGERS}
        retry_s, poll_s = config.loop.retry_s, config.loop.poll_ms / 1e3
        restarts, wake = StreamRestarts(self._may_restart), self._wake.set
        self.fingers = {
            name: Finger(name, sensors[name], self._workers[name], make_pipeline[name], retry_s, restarts, wake)
            for name in FINGERS
        }
        for finger in self.fingers.values():
            finger.observers.report = warning
        if config.perception.skip_second_finger:
            left, right = (self.fingers[name] for name in FINGERS)
            left.skip_frames_after(right, config.perception.refresh_s)
            right.skip_frames_after(left, config.perception.refresh_s)
        self.gripper: Actuator[GripperState] = Actuator(
            "gripper", gripper, poll_s, retry_s, wake, warning, checked_gripper_state, self._explain_silence
        )
        self.arm: Actuator[ArmState] = Actuator(
            "arm", arm, poll_s, retry_s, wake, warning, checked_arm_state, self._explain_silence
        )
        self._requests = RequestQueue()
        self._used: dict[str, TimedEstimate | None] = dict.fromkeys(FINGERS)
        self._last_fault: Fault | None = None
        self._device_alerts = DeviceAlerts(
            partial(self.event_log.info, kind="device"), partial(self.event_log.warning, kind="device")
        )

    @property
    def state(self) -> GraspState:
        """State of the grasp, as the controller remembers it."""
        return self._control_state.grasp

    @property
    def phase(self) -> Phase:
        """Phase of the grasp."""
        return self._control_state.grasp.phase

    @property
    def ready_to_lift(self) -> bool:
        """Whether an object is held without slip, and the gripper has carried out the last command."""
        state, gripper = self._control_state.grasp, self.gripper.newest
        return (
            state.phase is Phase.HOLDING
            and state.held.slip is None
            and gripper is not None
            and gripper_at_rest(state, gripper)
        )

    @property
    def devices(self) -> dict[str, Finger | Actuator[GripperState] | Actuator[ArmState]]:
        """All four devices, by name."""
        return {**self.fingers, "gripper": self.gripper, "arm": self.arm}

    @property
    def waiting_for(self) -> list[str]:
        """One line per device that is not ready."""
        return [one.health.message for one in self.devices.values() if not one.health.ready]

    @property
    def observer_errors(self) -> int:
        """Exceptions of all observers since the start."""
        errors = self.observers.errors + self.hold_observers.errors + self.event_log.listeners.errors
        return errors + sum(finger.observers.errors for finger in self.fingers.values())

    def apply_config(self, config: Config) -> None:
        """Use another configuration from the next cycle on (see `slipguard.daemon.reload`)."""
        self.config = config

    async def request(self, request: ControlRequest, deadline_s: float = math.inf) -> str:
        """Pass a request to the controller and return its message.

        Raises CommandRefused with the reason, also if no control step has taken it by `deadline_s` (loop time).
        """
        if request.kind in (RequestKind.LIFT, RequestKind.LOWER) and not self.config.arm.present:
            raise CommandRefused(f'cannot {request.kind}: there is no arm ([arm] driver = "none")')
        return await self._requests.submit(request, self._wake, deadline_s)

    def _may_restart(self, name: str) -> bool:
        """Return whether a finger can do without frames for a moment: the other one has some, and no slip is open.

        A finger without good frames has nothing to lose.
        """
        now_s = asyncio.get_running_loop().time()
        if self.fingers[name].observe(now_s)[0].condition is not Condition.FRESH:
            return True
        others = (finger for other, finger in self.fingers.items() if other != name)
        fresh = all(finger.observe(now_s)[0].condition is Condition.FRESH for finger in others)
        return fresh and self.state.held.slip is None

    def stop_arm(self, on_stopped: Callable[[], None]) -> None:
        """Stop the arm independently of the controller, before the service ends.

        on_stopped: Called when an arm that is ready has accepted the stop. An arm that is not ready may still accept
        it, but that is not reported.
        """
        device = self._arm_device

        async def stop() -> None:
            await device.stop()
            on_stopped()

        self.arm.command(stop if self.arm.health.ready else device.stop)

    async def run(self) -> None:
        """Guard until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                for name, device in self.devices.items():
                    group.create_task(device.run(), name=name)
                group.create_task(self._run_loop(), name="loop")
        finally:
            notify_systemd("STOPPING=1")
            self.close()
            self._requests.refuse_all("slipguard is stopping")

    def close(self) -> None:
        """End the workers' threads; `run` does so at its end."""
        for worker in self._workers.values():
            worker.close()

    async def _run_loop(self) -> None:
        loop = asyncio.get_running_loop()
        ticker = Ticker(self.config.loop.period_ms / 1e3)
        feed_every_s = watchdog_period_s()
        feed_at_s = loop.time()
        notify_systemd("READY=1")
        while True:
            await ticker.wait(self._wake)
            self._wake.clear()
            self.deadlines_missed = ticker.missed
            self._run_cycle(loop.time())
            if feed_every_s is not None and loop.time() >= feed_at_s:
                notify_systemd("WATCHDOG=1")
                feed_at_s = loop.time() + feed_every_s

    def _run_cycle(self, now_s: float) -> None:
        """Gather an observation, compute the control step, issue the command, publish the decision."""
        pending = self._requests.next(now_s)
        fresh, observation = self._gather(now_s, ControlRequest() if pending is None else pending.request)
        new = self._take_new_estimates()
        before = self._control_state
        self._control_state, output = self._controller(before, observation, self.config.guard)
        self.observation = observation
        self._issue(output, max((one.received_at_s for one in new.values()), default=now_s))
        if pending is not None and output.refusal is not None:
            pending.refuse(output.refusal.text)
        elif pending is not None:
            pending.respond(output.text or self.phase.value)
        self._publish(before, output, fresh, new)

    def _gather(self, now_s: float, request: ControlRequest) -> tuple[dict[str, Estimate | None], Observation]:
        """Return each finger's fresh estimate and the controller's observation."""
        health: dict[str, FingerHealth] = {}
        fresh: dict[str, Estimate | None] = {}
        for name, finger in self.fingers.items():
            health[name], fresh[name] = finger.observe(now_s)
        return fresh, Observation(
            now_s=now_s,
            fused=fuse(fresh["left"], fresh["right"]),
            left=health["left"],
            right=health["right"],
            gripper=self.gripper.newest,
            arm=self.arm.newest,
            request=request,
            busy_s=self._busy_s(now_s),
            gripper_limits_n=self._gripper_limits_n,
        )

    def _busy_s(self, now_s: float) -> float:
        """Return for how much of the last `BUSY_WINDOW_S` the loop was late."""
        period_s = self.config.loop.period_ms / 1e3
        late_s = now_s - self.observation.now_s - period_s if self.observation is not None else 0.0
        if late_s >= period_s:
            self._late.append((now_s, late_s))
        while self._late and now_s - self._late[0][0] >= BUSY_WINDOW_S:
            self._late.popleft()
        return min(sum(late_s for _, late_s in self._late), BUSY_WINDOW_S)

    def _explain_silence(self) -> str:
        """Return that this machine may be too busy, as the end of a line; nothing if the loop was on time."""
        busy_s = 0.0 if self.observation is None else self.observation.busy_s
        if busy_s < BUSY_S:
            return ""
        late = f"the control loop was late for {busy_s:.2f} s of the last second"
        return f". Or this machine is too busy ({late}): end other programs"

    def _take_new_estimates(self) -> dict[str, TimedEstimate]:
        """Return by finger the estimates that this cycle is the first to use."""
        new = {}
        for name, finger in self.fingers.items():
            newest = finger.newest
            if newest is not None and newest is not self._used[name]:
                new[name] = newest
            self._used[name] = newest
        return new

    def _issue(self, output: StepOutput, received_at_s: float) -> None:
        """Pass the commands to the devices' tasks, without waiting for any."""
        gripper, arm = self._gripper_device, self._arm_device

        async def hold(force_n: float) -> None:
            self.hold_observers.notify(asyncio.get_running_loop().time() - received_at_s)
            await gripper.hold(force_n)

        match output.gripper:
            case ReleaseJaws(width_mm=width_mm):
                self.gripper.command(lambda: gripper.release(width_mm), urgent=True)
            case HaltJaws():
                self.gripper.command(gripper.halt)
            case HoldForce(force_n=force_n):
                self.gripper.command(lambda: hold(force_n))
            case MoveJaws(width_mm=width_mm, force_n=force_n):
                self.gripper.command(lambda: gripper.move(width_mm, force_n))
            case ActivateGripper():
                self.gripper.command(gripper.activate)
        match output.arm:
            case StopArm():
                self.arm.command(arm.stop)
            case LiftArm(height_mm=height_mm, speed_mm_s=speed_mm_s):
                self.arm.command(lambda: arm.lift(height_mm, speed_mm_s))
        if output.new_reference:
            for finger in self.fingers.values():
                finger.reset_reference()

    def _publish(
        self,
        before: ControlState,
        output: StepOutput,
        fresh: Mapping[str, Estimate | None],
        new: Mapping[str, TimedEstimate],
    ) -> None:
        """Log what has changed, and pass the decision to the observers."""
        assert self.observation is not None
        now_s, done_s = self.observation.now_s, asyncio.get_running_loop().time()
        latencies_s = tuple(done_s - one.received_at_s for one in new.values())
        if output.text is not None:
            kind: EventKind = "slip" if any(one.name in SLIP_MESSAGES for one in output.messages) else "grasp"
            (self.event_log.warning if output.is_warning else self.event_log.info)(output.text, kind)
        if output.fault is not None and output.fault != self._last_fault:
            self.event_log.fault(output.fault.code.value, output.fault.observed, output.fault.what_to_do)
        self._last_fault = output.fault
        if self.phase is not before.grasp.phase:
            log.info("phase", now=self.phase.value, before=before.grasp.phase.value)
            notify_systemd(f"STATUS={self.phase.value}")
        problems = find_problems(self.observation, self.devices)
        self._device_alerts.update(now_s, problems, self.phase, self.config.guard.tuning.cycle_timeout_s)
        decision = Decision(
            now_s,
            self.phase,
            self.observation,
            output,
            before,
            fresh,
            {name: one.estimate for name, one in new.items()},
            latencies_s if output.hold_force_n is None else (),
        )
        self.observers.notify(decision)
