"""The service: four devices, one pure law, and the loop that brings them together.

The loop wakes when a finger has an answer, and at every beat; it gathers what is known, asks the law, and hands
commands on. It never waits for a device: `Actuator` and `Finger` do that in tasks of their own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

import structlog

from slipguard.config import Config
from slipguard.control.fault import Fault
from slipguard.control.finger_fusion import fuse
from slipguard.control.messages import ArmLift, Command, Condition, ControlRequest, FingerHealth, Observation
from slipguard.control.params import GuardParams
from slipguard.control.state import GraspState, Phase, gripper_at_rest
from slipguard.control.step import ControlState, control_step
from slipguard.daemon.lifecycle import notify_systemd, watchdog_period_s
from slipguard.daemon.loop.actuator import Actuator
from slipguard.daemon.loop.async_tools import Ticker
from slipguard.daemon.loop.decision import Decision, LatencyStats
from slipguard.daemon.loop.device_health import DeviceAlerts, find_problems
from slipguard.daemon.loop.event_log import EventLog
from slipguard.daemon.loop.finger import Finger, PerceptionPipeline, TimedEstimate, Worker
from slipguard.daemon.store.background_images import BackgroundStore
from slipguard.devices import Arm, ArmState, Gripper, GripperState, TactileSensor
from slipguard.errors import CommandRefused
from slipguard.perception.estimate import Estimate

FINGERS = ("left", "right")
STALE_S = 0.15
"""A finger whose newest good frame is older than this does not speak for the present, nor one from the future.

At 30 fps one lost frame makes it 122 ms: two frames of 33 ms, 50 ms of latency, 6 ms of work.
"""
REQUEST_TIMEOUT_S = 2.0

Controller = Callable[[ControlState, Observation, GuardParams], tuple[ControlState, Command]]
log = structlog.get_logger()


class Service:
    """Runs fingers, gripper, arm and law until cancelled; then the grip stays as it is.

    controller: the pure tick; another may be given to see what happens without it. memory: what it knows from before.
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
        memory: ControlState | None = None,
    ) -> None:
        self.config = config
        self.store = store
        self.latency_stats = LatencyStats(FINGERS)
        self.observers: list[Callable[[Decision], None]] = [self.latency_stats.add_decision]
        self.hold_observers: list[Callable[[float], None]] = [self.latency_stats.add_hold]
        """Called as a hold goes to the gripper, with the seconds since the frame that caused it was handed over."""
        self.event_log = EventLog()
        self.deadlines_missed = 0
        self._guard = memory or ControlState()
        self.observation: Observation | None = None
        self._controller = controller
        self._gripper_device = gripper
        self._arm_device = arm
        self._wake = asyncio.Event()
        self._workers = {name: make_worker(name) for name in FINGERS}
        retry_s, poll_s = config.loop.retry_s, config.loop.poll_ms / 1e3
        self.fingers = {
            name: Finger(name, sensors[name], self._workers[name], make_pipeline[name], retry_s, self._wake.set)
            for name in FINGERS
        }
        if config.perception.skip_second_finger:
            left, right = (self.fingers[name] for name in FINGERS)
            left.skip_frames_after(right, config.perception.refresh_s)
            right.skip_frames_after(left, config.perception.refresh_s)
        self.gripper: Actuator[GripperState] = Actuator(
            "gripper", gripper, poll_s, retry_s, self._wake.set, self.event_log.warning
        )
        self.arm: Actuator[ArmState] = Actuator("arm", arm, poll_s, retry_s, self._wake.set, self.event_log.warning)
        self._requests: asyncio.Queue[tuple[ControlRequest, asyncio.Future[str]]] = asyncio.Queue()
        self._decided_on: dict[str, TimedEstimate | None] = dict.fromkeys(FINGERS)
        self._last_fault: Fault | None = None
        self._device_alerts = DeviceAlerts(self.event_log.info, self.event_log.warning)

    @property
    def state(self) -> GraspState:
        """What the law remembers."""
        return self._guard.grasp

    @property
    def phase(self) -> Phase:
        """Where the grasp is."""
        return self._guard.grasp.phase

    @property
    def firm(self) -> bool:
        """Held and calm, and the gripper has done what it was last told: fit to be lifted."""
        state, gripper = self._guard.grasp, self.gripper.newest
        return (
            state.phase is Phase.HOLDING
            and state.slip is None
            and gripper is not None
            and gripper_at_rest(state, gripper)
        )

    @property
    def devices(self) -> dict[str, Finger | Actuator[GripperState] | Actuator[ArmState]]:
        """All four, by name."""
        return {**self.fingers, "gripper": self.gripper, "arm": self.arm}

    @property
    def waiting_for(self) -> list[str]:
        """One line for each device that is not ready."""
        return [one.health.message for one in self.devices.values() if not one.health.ready]

    async def request(self, request: ControlRequest) -> str:
        """Hand a wish to the law; returns what it says to it. Raises CommandRefused with its reason."""
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._requests.put_nowait((request, answer))
        self._wake.set()
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                return await answer
        except TimeoutError:
            raise CommandRefused(f"{request.kind}: the loop did not answer within {REQUEST_TIMEOUT_S:g} s") from None

    def stop_arm(self, told: Callable[[], None]) -> None:
        """Have the arm stopped, whatever the law wants; for whoever is about to end the service.

        told: called when an arm that is there has heard it. One that is not there may still heed a stop, but nobody
        knows.
        """
        device = self._arm_device

        async def stop() -> None:
            await device.stop()
            told()

        self.arm.command(stop if self.arm.health.ready else device.stop)

    async def run(self) -> None:
        """Guard until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                for name, device in self.devices.items():
                    group.create_task(device.run(), name=name)
                group.create_task(self._decide(), name="decide")
        finally:
            notify_systemd("STOPPING=1")
            self.close()
            while (waiting := self._next_request()) is not None:
                waiting[1].set_exception(CommandRefused(f"{waiting[0].kind}: slipguard is stopping"))

    def close(self) -> None:
        """Let go of the workers' threads; `run` does so at its end."""
        for worker in self._workers.values():
            worker.close()

    async def _decide(self) -> None:
        loop = asyncio.get_running_loop()
        ticker = Ticker(self.config.loop.period_ms / 1e3)
        feed_every_s = watchdog_period_s()
        feed_at_s = loop.time()
        notify_systemd("READY=1")
        while True:
            await ticker.wait(self._wake)
            self._wake.clear()
            self.deadlines_missed = ticker.missed
            self._rotation(loop.time())
            if feed_every_s is not None and loop.time() >= feed_at_s:
                notify_systemd("WATCHDOG=1")
                feed_at_s = loop.time() + feed_every_s

    def _rotation(self, now_s: float) -> None:
        """Gather, ask the law, hand commands on, tell observers."""
        request, answer = self._next_request() or (ControlRequest(), None)
        fresh, observation = self._gather(now_s, request)
        before = self._guard
        self._guard, command = self._controller(before, observation, self.config.guard)
        self.observation = observation
        news = self._news()
        self._issue(command, max((one.received_at_s for one in news.values()), default=now_s))
        done_s = asyncio.get_running_loop().time()
        found_needless = tuple(done_s - one.received_at_s for one in news.values())
        decision = Decision(
            now_s,
            self.phase,
            observation,
            command,
            before,
            fresh,
            {name: one.estimate for name, one in news.items()},
            found_needless if command.hold_force_n is None else (),
        )
        self._tell(before.grasp.phase, command, answer)
        self._device_alerts.update(
            now_s, find_problems(observation, self.devices), self.phase, self.config.guard.tuning.cycle_timeout_s
        )
        for observer in self.observers:
            observer(decision)

    def _next_request(self) -> tuple[ControlRequest, asyncio.Future[str]] | None:
        """The oldest that somebody still waits for: a wish given up must not come true later."""
        while not self._requests.empty():
            request, answer = self._requests.get_nowait()
            if not answer.done():
                return request, answer
        return None

    def _gather(self, now_s: float, request: ControlRequest) -> tuple[dict[str, Estimate | None], Observation]:
        """What speaks for each finger, and all that the law is told."""
        fresh: dict[str, Estimate | None] = {}
        health = {}
        for name, finger in self.fingers.items():
            newest = finger.newest
            age_s = now_s - finger.captured_at_s if finger.captured_at_s is not None else float("inf")
            if finger.health.state == "disconnected":
                condition = Condition.LOST
            elif not -STALE_S <= age_s <= STALE_S:
                condition = Condition.STALE
            else:
                condition = Condition.FRESH
            fresh[name] = newest.estimate if newest is not None and condition is Condition.FRESH else None
            health[name] = FingerHealth(condition, age_s, finger.health.reason)
        return fresh, Observation(
            now_s=now_s,
            fused=fuse(fresh["left"], fresh["right"]),
            left=health["left"],
            right=health["right"],
            gripper=self.gripper.newest,
            arm=self.arm.newest,
            request=request,
            gripper_limits_n=self._gripper_device.force_limits_n,
        )

    def _news(self) -> dict[str, TimedEstimate]:
        """Answers that this turn of the loop was the first to use."""
        news = {}
        for name, finger in self.fingers.items():
            newest = finger.newest
            if newest is not None and newest is not self._decided_on[name]:
                news[name] = newest
            self._decided_on[name] = newest
        return news

    def _issue(self, command: Command, received_at_s: float) -> None:
        gripper, arm = self._gripper_device, self._arm_device

        async def hold(force_n: float) -> None:
            for observer in self.hold_observers:
                observer(asyncio.get_running_loop().time() - received_at_s)
            await gripper.hold(force_n)

        if command.release_width_mm is not None:
            width_mm = command.release_width_mm
            self.gripper.command(lambda: gripper.release(width_mm), firm=True)
        elif command.halt:
            self.gripper.command(gripper.halt)
        elif command.hold_force_n is not None:
            force_n = command.hold_force_n
            self.gripper.command(lambda: hold(force_n))
        elif command.move_width_mm is not None and command.move_force_n is not None:
            move_mm, with_n = command.move_width_mm, command.move_force_n
            self.gripper.command(lambda: gripper.move(move_mm, with_n))
        if command.arm == "stop":
            self.arm.command(arm.stop)
        elif isinstance(command.arm, ArmLift):
            way = command.arm
            self.arm.command(lambda: arm.lift(way.height_mm, way.speed_mm_s))
        if command.new_reference:
            for finger in self.fingers.values():
                finger.reset_reference()

    def _tell(self, before: Phase, command: Command, answer: asyncio.Future[str] | None) -> None:
        if command.say is not None:
            (self.event_log.warning if command.warn else self.event_log.info)(command.say)
        if command.fault is not None and command.fault != self._last_fault:
            self.event_log.fault(command.fault.code.value, command.fault.observed, command.fault.what_to_do)
        self._last_fault = command.fault
        if self.phase is not before:
            log.info("phase", now=self.phase.value, before=before.value)
            notify_systemd(f"STATUS={self.phase.value}")
        if answer is None or answer.done():
            return
        if command.refused is not None:
            answer.set_exception(CommandRefused(command.refused))
        else:
            answer.set_result(command.say or self.phase.value)
