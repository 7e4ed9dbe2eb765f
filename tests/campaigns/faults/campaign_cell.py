"""The daemon's service on a simulated cell: it can be started, killed as by `kill -9`, and started again."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from typing import Any, cast

import numpy as np

from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors
from slipguard.config import GROUP_OF, Config, parse_config
from slipguard.control.control_step import control_step
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import DaemonRequest
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.store.background_images import BackgroundImage, BackgroundVersion
from slipguard.daemon.store.last_grasp import LastGraspSaver, restore_control_state
from slipguard.daemon.store.state_dir import LastGrasp
from slipguard.devices import (
    FINGERS,
    FRAME_HEIGHT_PX,
    FRAME_WIDTH_PX,
    Arm,
    DriverContext,
    Frame,
    Gripper,
    TactileSensor,
)
from slipguard.perception.estimate import DeclineReason, Estimate
from slipguard.registry import load_driver
from slipguard.sim.catalogue import find_object
from slipguard.sim.cell import WorldTruth
from slipguard.sim.gel_view import decode_view
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World, WorldSettings

LATENCY_S = 0.006
"""From a frame to its estimate."""
WATCHDOG_S = 0.25
"""An arm stops by itself this long after the last message of a dead daemon."""
EXTRA_WIDTH_MM = 20.0
"""The open jaws are this much wider than the object, which shortens a run."""
BRIGHT_LEVELS = 30.0
"""With a larger change of light the pipeline declines: the frame does not match the background image."""
LIFT: dict[str, object] = {"lift_height_mm": 50.0, "lift_speed_mm_s": 80.0, "tuning": {"lower_speed_mm_s": 150.0}}


class CuttableLink:
    """The link between a daemon and its devices. After it is cut, calls of the killed daemon never return."""

    def __init__(self) -> None:
        self.cut = False

    async def passes(self) -> None:
        """Return at once, or never."""
        if self.cut:
            await asyncio.Event().wait()


class LinkedDevice:
    """A device behind a link, with all methods of the device; `close` does nothing once the link is cut.

    Args:
        called: called with the name of each method before it reaches the device.
    """

    def __init__(self, device: Any, link: CuttableLink, called: Callable[[str], None] = lambda name: None) -> None:
        self._device, self._link, self._called = device, link, called
        self._methods: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._device, name)
        if not inspect.iscoroutinefunction(found):
            return found
        if name not in self._methods:
            self._methods[name] = self._linked(name, found)
        return self._methods[name]

    def _linked(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        link, called = self._link, self._called

        @wraps(method)
        async def call(*args: Any, **kwargs: Any) -> Any:
            if name == "close" and link.cut:
                return None
            await link.passes()
            called(name)
            result = await method(*args, **kwargs)
            if name != "close":
                await link.passes()
            return result

        return call


class MemoryState:
    """A state directory in memory: the last grasp, and one background image for all sensors."""

    def __init__(self) -> None:
        self._last: LastGrasp | None = None
        blank = np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), np.uint8)
        self._image = BackgroundImage(blank, (2.0, 2.0, 2.0), 30)

    def load_background(self, serial: str, number: int | None = None) -> BackgroundImage | None:
        """Return the background image."""
        return self._image

    first_of_gel = load_background

    def save_background(self, serial: str, taken: BackgroundImage, *, new_gel: bool = False) -> None:
        """Do nothing: the campaign does not calibrate."""

    def restore_background(self, serial: str, number: int) -> None:
        """Do nothing: there is one image only."""

    def background_versions(self, serial: str) -> list[BackgroundVersion]:
        """Return no versions."""
        return []

    def save_last_grasp(self, last: LastGrasp) -> None:
        """Store the last grasp."""
        self._last = last

    def load_last_grasp(self) -> LastGrasp | None:
        """Return the stored grasp."""
        return self._last

    def delete_last_grasp(self) -> None:
        """Delete the stored grasp."""
        self._last = None


class EncodedImagePerception:
    """Estimates with the errors of `error`. mirrored: rotations have the wrong sign, as with swapped cameras."""

    def __init__(self, error: PerceptionErrors, rng: np.random.Generator) -> None:
        self.mirrored = False
        self.last_patch = None
        self._model = ModeledFinger(error, rng)

    def keep_estimate(self, captured_at_s: float) -> None:
        """Do nothing for a skipped frame."""

    def reset_reference(self) -> None:
        """Take a new reference from the next stable contact."""
        self._model.reset()

    def process(self, frame: Frame) -> Estimate:
        """Return the estimate of one frame."""
        view, light = decode_view(frame.image)
        estimate = self._model.process(view, frame.captured_at_s, frame.sequence)
        if max(abs(level) for level in light) > BRIGHT_LEVELS:
            plain = replace(estimate, rotation_deg=None, sigma_deg=None, rate_deg_s=None, shift_mm=None)
            return replace(plain, contact=True, orientation_deg=None, declined=str(DeclineReason.IMAGE))
        if not estimate.contact:
            return replace(estimate, skipped="no contact", declined="no contact")
        if estimate.rotation_deg is None and estimate.declined is None:
            return replace(estimate, declined="no reference yet")
        if self.mirrored and estimate.rotation_deg is not None:
            return replace(estimate, rotation_deg=-estimate.rotation_deg, rate_deg_s=-(estimate.rate_deg_s or 0.0))
        return estimate


class CampaignCell:
    """One cell and its daemon; `on_line` is called with every log line."""

    def __init__(self, object_name: str, seed: int, guard: dict[str, object], on_line: Callable[[str], None]) -> None:
        settings = WorldSettings(step_s=2e-3, start_width_mm=find_object(object_name).width_mm + EXTRA_WIDTH_MM)
        self.world = World(settings, seed=seed)
        self.crashes: list[str] = []
        self.releases = 0
        """Number of release commands to the gripper."""
        self._error = PerceptionErrors(declined=not find_object(object_name).axial)
        self._object, self._seed, self._on_line = object_name, seed, on_line
        self._config = _config({**LIFT, **guard})
        self._state = MemoryState()
        self._rng = np.random.default_rng([seed, 11])
        self.perception: dict[str, EncodedImagePerception] = {}
        self.mirrored: set[str] = set()
        self._link = CuttableLink()
        self._task: asyncio.Task[None] | None = None

    @property
    def params(self) -> Config:
        """The daemon's configuration."""
        return self._config

    @property
    def alive(self) -> bool:
        """Whether the daemon runs."""
        return self._task is not None and not self._task.done()

    @property
    def now_s(self) -> float:
        """The loop's time."""
        return asyncio.get_running_loop().time()

    @property
    def truth(self) -> WorldTruth:
        """The true state of the world."""
        return self.world.truth(self.now_s)

    def place(self) -> None:
        """Place the object between the jaws."""
        self.world.place(scenario(self._object, self._seed), self.now_s)

    def start(self) -> None:
        """Start a daemon on the state that the last one stored."""
        self._link = CuttableLink()
        self.service = self._build(self._link)
        self.handlers = RequestHandlers(self.service)
        self._task = asyncio.create_task(self._run(self.service), name="service")

    async def submit(self, request: DaemonRequest) -> Mapping[str, object]:
        """Submit a request to the daemon."""
        return await self.handlers.submit(request)

    async def kill(self) -> None:
        """End the daemon like `kill -9`: it sends nothing more, and the arm's watchdog stops the arm."""
        self._link.cut = True
        await self._end()
        for finger in FINGERS:
            await self._sensors[finger].close()  # the killed process no longer holds the device
        asyncio.get_running_loop().call_later(WATCHDOG_S, lambda: self.world.command_stop(self.now_s))

    async def stop(self) -> None:
        """End the daemon like SIGTERM."""
        await self._end()

    async def _end(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _run(self, service: Service) -> None:
        try:
            await service.run()
        except* Exception as group:
            self.crashes += [f"{type(error).__name__}: {error}" for error in group.exceptions]

    def _build(self, link: CuttableLink) -> Service:
        devices = {name: self._device(name) for name in GROUP_OF}
        self._sensors = {name: devices[name] for name in FINGERS}
        self.perception = {}

        def count_releases(name: str) -> None:
            self.releases += name == "release"

        def maker(name: str) -> Callable[[str], EncodedImagePerception]:
            def make(serial: str) -> EncodedImagePerception:
                self.perception[name] = EncodedImagePerception(self._error, self._rng)
                self.perception[name].mirrored = name in self.mirrored
                return self.perception[name]

            return make

        service = Service(
            self._config,
            sensors={name: cast(TactileSensor, LinkedDevice(devices[name], link)) for name in FINGERS},
            gripper=cast(Gripper, LinkedDevice(devices["gripper"], link, count_releases)),
            arm=cast(Arm, LinkedDevice(devices["arm"], link)),
            make_worker=lambda name: FixedLatencyWorker(LATENCY_S),
            make_pipeline={name: maker(name) for name in FINGERS},
            store=self._state,
            controller=control_step,
            control_state=restore_control_state(self._state),
        )
        service.observers.append(
            LastGraspSaver(self._state, service.event_log.info, service.event_log.warning).add_decision
        )
        service.event_log.listeners.append(lambda event: self._on_line(event.line))
        return service

    def _device(self, name: str) -> Any:
        section = getattr(self._config, name)
        context = DriverContext(name, self.world, self._config.guard.mode)
        return load_driver(GROUP_OF[name], section.driver)(section.settings, context)


def _config(guard: dict[str, object]) -> Config:
    fingers = {name: {"driver": "fake", "fake": {"draw": "encoded"}} for name in FINGERS}
    return parse_config({**fingers, "guard": guard}, where="the campaign", sim=True)
