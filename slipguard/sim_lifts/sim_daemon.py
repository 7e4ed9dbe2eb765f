"""`slipguard run --sim`: the daemon with simulated devices; after each release the next object is placed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle

import structlog

from slipguard.config import Config
from slipguard.control.state import Phase
from slipguard.daemon import run as root
from slipguard.daemon.loop.service import Service
from slipguard.sim.catalogue import object_names
from slipguard.sim.scenario import scenario, sensor_gel
from slipguard.sim.world import World

SEED = 0
POLL_S = 0.2
ROOM_MM = 60.0
"""From this width on the jaws are open for the next object."""
log = structlog.get_logger()


async def run_simulated_cell(config: Config, bind_api: root.BindApi, on_stop: Callable[[], object]) -> None:
    """Run the daemon in a new simulated world until it is stopped. bind_api, on_stop: see `slipguard.daemon.run`."""
    world = World(seed=SEED)

    async def place_objects(service: Service) -> None:
        """After each release, remove the object and place the next."""
        log.info("try in another terminal: slipguard ctl calibrate, then grasp, state, lift, lower, release")
        loop = asyncio.get_running_loop()
        grasped = True
        for number, name in enumerate(cycle(object_names("test"))):
            while not (grasped and service.phase is Phase.IDLE and _is_open(service)):
                grasped = grasped or service.phase is not Phase.IDLE
                await asyncio.sleep(POLL_S)
            world.clear(loop.time())
            world.place(replace(scenario(name, number), gel=sensor_gel(SEED)), loop.time())
            log.info("an object lies between the jaws", object=name)
            grasped = False

    await root.run(config, bind_api, world=world, extra_task=place_objects, on_stop=on_stop)


def _is_open(service: Service) -> bool:
    gripper = service.gripper.newest
    return gripper is not None and not gripper.moving and gripper.width_mm >= ROOM_MM
