"""The daemon's service on a simulated cell: started, killed as by `kill -9`, and started again."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from slipguard.bench.grip.modeled_perception import SightError
from slipguard.config import GROUP_OF, Config, parse_config
from slipguard.control.step import control_step
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.loop.service import FINGERS, Service
from slipguard.daemon.loop.worker import StatedLatencyWorker
from slipguard.daemon.store.last_grasp import LastGraspSaver, remembered
from slipguard.devices import Arm, DriverContext, Gripper, TactileSensor
from slipguard.registry import load_driver
from slipguard.sim.catalogue import find_object
from slipguard.sim.cell import WorldTruth
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World, WorldSettings
from tests.campaigns.faults.fake_perception import EncodedImagePerception
from tests.campaigns.faults.memory import MemoryState
from tests.campaigns.faults.wire import CuttableLink, LinkedDevice

LATENCY_S = 0.006
"""From a frame to its estimate."""
WATCHDOG_S = 0.25
"""An arm stops by itself so long after it has heard from a dead daemon for the last time."""
ROOM_MM = 20.0
"""The open jaws are so much wider than the object, to spare a run the way."""
LIFT: dict[str, object] = {"lift_height_mm": 50.0, "lift_speed_mm_s": 80.0, "tuning": {"lower_speed_mm_s": 150.0}}


class CampaignCell:
    """One cell and its daemon. heard: called with every line of the log."""

    def __init__(self, object_name: str, seed: int, guard: dict[str, object], heard: Callable[[str], None]) -> None:
        settings = WorldSettings(step_s=2e-3, start_width_mm=find_object(object_name).width_mm + ROOM_MM)
        self.world = World(settings, seed=seed)
        self.crashes: list[str] = []
        self.releases = 0
        """How often the jaws were told to open."""
        self._error = SightError(declined=0.0 if find_object(object_name).axial else 1.0)
        self._object, self._seed, self._heard = object_name, seed, heard
        self._config = _config({**LIFT, **guard})
        self._state = MemoryState()
        self._rng = np.random.default_rng([seed, 11])
        self.sights: dict[str, EncodedImagePerception] = {}
        self.mirrored: set[str] = set()
        self._wire = CuttableLink()
        self._task: asyncio.Task[None] | None = None

    @property
    def params(self) -> Config:
        """What the daemon is configured to."""
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
        """What really happens."""
        return self.world.truth(self.now_s)

    def place(self) -> None:
        """Put the object between the jaws."""
        self.world.place(scenario(self._object, self._seed), self.now_s)

    def start(self) -> None:
        """Start a daemon that knows what the last one left behind."""
        self._wire = CuttableLink()
        self.service = self._build(self._wire)
        self.handlers = RequestHandlers(self.service)
        self._task = asyncio.create_task(self._run(self.service), name="service")

    async def kill(self) -> None:
        """End the daemon as `kill -9` does: nothing is told to anybody any more, and the arm's watchdog stops it."""
        self._wire.cut = True
        await self._end()
        for finger in FINGERS:
            await self._sensors[finger].close()  # its end of the cable is gone
        asyncio.get_running_loop().call_later(WATCHDOG_S, lambda: self.world.command_stop(self.now_s))

    async def stop(self) -> None:
        """End the daemon as SIGTERM does."""
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

    def _build(self, wire: CuttableLink) -> Service:
        devices = {name: self._device(name) for name in GROUP_OF}
        self._sensors = {name: devices[name] for name in FINGERS}
        self.sights = {}

        def told(name: str) -> None:
            self.releases += name == "release"

        def maker(name: str) -> Callable[[str], EncodedImagePerception]:
            def make(serial: str) -> EncodedImagePerception:
                self.sights[name] = EncodedImagePerception(self._error, self._rng)
                self.sights[name].mirrored = name in self.mirrored
                return self.sights[name]

            return make

        service = Service(
            self._config,
            sensors={name: cast(TactileSensor, LinkedDevice(devices[name], wire)) for name in FINGERS},
            gripper=cast(Gripper, LinkedDevice(devices["gripper"], wire, told)),
            arm=cast(Arm, LinkedDevice(devices["arm"], wire)),
            make_worker=lambda name: StatedLatencyWorker(LATENCY_S),
            make_pipeline={name: maker(name) for name in FINGERS},
            store=self._state,
            controller=control_step,
            memory=remembered(self._state),
        )
        service.observers.append(LastGraspSaver(self._state, service.event_log.info, service.event_log.warning).decided)
        service.event_log.listeners.append(lambda event: self._heard(event.line))
        return service

    def _device(self, name: str) -> Any:
        section = getattr(self._config, name)
        context = DriverContext(name, self.world, self._config.guard.mode)
        return load_driver(GROUP_OF[name], section.driver)(section.settings, context)


def _config(guard: dict[str, object]) -> Config:
    fingers = {name: {"driver": "fake", "fake": {"draw": "told"}} for name in FINGERS}
    return parse_config({**fingers, "guard": guard}, where="the campaign", sim=True)
