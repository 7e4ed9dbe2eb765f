"""The no-contact images that are stored of each finger's sensor, as people and programs may see them."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.calibration import BackgroundArchive, BackgroundVersion
from slipguard.errors import CommandRefused, InputError


async def history(service: Service, pool: Executor) -> dict[str, object]:
    """By finger: `serial` (None: not seen yet) and `versions`, oldest first; reads in a thread of `pool`."""
    loop = asyncio.get_running_loop()
    told: dict[str, object] = {}
    for name, finger in service.fingers.items():
        there: Sequence[BackgroundVersion] = ()
        if finger.serial is not None and isinstance(service.store, BackgroundArchive):
            there = await loop.run_in_executor(pool, service.store.background_versions, finger.serial)
        told[name] = {"serial": finger.serial, "versions": [as_dict(version) for version in there]}
    return told


def as_dict(version: BackgroundVersion) -> dict[str, object]:
    """As JSON knows it; the time as ISO 8601."""
    return asdict(version) | {"created_at": version.created_at.isoformat()}


async def stored_image(
    service: Service, pool: Executor, name: str, number: int | None
) -> tuple[str, int, NDArray[np.uint8]]:
    """Serial number, number and picture, (320, 240, 3) uint8 BGR; the newest if not told which. Reads in `pool`.

    Raises CommandRefused where there is none.
    """
    finger, store = service.fingers.get(name), service.store
    if finger is None:
        raise CommandRefused(f"no finger {name!r}; there are: {', '.join(service.fingers)}")
    if finger.serial is None or not isinstance(store, BackgroundArchive):
        raise CommandRefused(f"no sensor of the {name} finger was seen yet: {finger.health.reason}")
    loop = asyncio.get_running_loop()
    versions = await loop.run_in_executor(pool, store.background_versions, finger.serial)
    chosen = number if number is not None else max((version.number for version in versions), default=None)
    try:
        found = (
            None if chosen is None else await loop.run_in_executor(pool, store.load_background, finger.serial, chosen)
        )
    except InputError as error:
        raise CommandRefused(str(error)) from None
    if chosen is None or found is None:
        known = ", ".join(str(version.number) for version in versions) or "none"
        raise CommandRefused(f"{finger.serial}: no such no-contact image is stored; there are: {known}")
    return finger.serial, chosen, found.image
