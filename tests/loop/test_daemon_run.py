"""The daemon's process: its settings while it runs are restored at its end."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
from pathlib import Path
from typing import Any

from slipguard.cli.run import bind_api
from slipguard.config import parse_config
from slipguard.daemon import run as root
from slipguard.sim.world import World, WorldSettings


def test_garbage_collections_skip_what_exists_at_the_start(tmp_path: Path) -> None:
    frozen: list[int] = []

    async def extra_task_body(service: Any) -> None:
        rotated = asyncio.Event()
        service.observers.append(lambda decision: rotated.set())
        await rotated.wait()
        frozen.append(gc.get_freeze_count())
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.Event().wait()

    given = {"state": {"directory": str(tmp_path)}}

    async def main() -> None:
        async with asyncio.timeout(30.0):
            await root.run(
                parse_config(given, where="test", sim=True),
                bind_api,
                world=World(WorldSettings(), seed=0),
                extra_task=extra_task_body,
            )

    asyncio.run(main())
    assert frozen[0] > 10_000
    assert gc.get_freeze_count() == 0


def test_a_forgotten_fingertip_thickness_is_logged_once_at_the_start(tmp_path: Path) -> None:
    texts: list[str] = []

    async def extra_task_body(service: Any) -> None:
        texts.extend(event.text for event in service.event_log.events)
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.Event().wait()

    config = parse_config({"state": {"directory": str(tmp_path)}}, where="test", sim=True)
    left = config.left.model_copy(update={"driver": "digit"})
    forgotten = config.model_copy(update={"left": left})

    async def main() -> None:
        def build(config: Any, world: World) -> Any:
            return root.build_service(config.model_copy(update={"left": right}), world=world)

        right = config.left
        async with asyncio.timeout(30.0):
            await root.run(
                forgotten, bind_api, world=World(WorldSettings(), seed=0), extra_task=extra_task_body, build=build
            )

    asyncio.run(main())
    assert len([text for text in texts if "fingertip_mm = 0 with a DIGIT on the jaws (left)" in text]) == 1
