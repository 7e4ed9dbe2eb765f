"""Contain what a driver or a finger's pipeline does not foresee: name it, log where it happened, and go on."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Protocol

import structlog

from slipguard.cancellation import raise_if_cancelled
from slipguard.daemon.loop.device_health import Health
from slipguard.errors import SlipguardError, describe_error, raised_in

log = structlog.get_logger()
HERE = Path(__file__).parent
DRIVER_ERRORS = (Exception, asyncio.CancelledError)
"""A driver may raise CancelledError itself, for example where a library cancels a future: call `raise_if_cancelled`."""


class Closable(Protocol):
    """What all devices have in common."""

    async def close(self) -> None: ...


def failure_reason(source: object, error: BaseException, health: Health) -> str:
    """Return in one line why a device failed.

    An unexpected exception is an error in the code of `source`: the line names its class and the place, and the first
    time in a row the log gets the traceback.
    """
    if isinstance(error, SlipguardError):
        return str(error)
    reason = f"error in {error_place(type(source), error)}: {describe_error(error)}; tried again, the grip stays"
    if reason != health.reason:
        log.error(f"{health.name}: {reason}", exc_info=error)
    return reason


def error_place(source: object, error: BaseException) -> str:
    """Return the name of a class or function, and the file and line in which the exception was raised.

    The place is left out if it is in this folder, where a returned value was found to be invalid.
    """
    source = getattr(source, "func", source)  # of a partial
    where = raised_in(error, HERE)
    return f"{source.__module__}.{getattr(source, '__qualname__', type(source).__qualname__)}{where}"


async def close_contained(device: Closable, health: Health) -> None:
    """Close a device; an exception, which the ports do not allow, is logged."""
    try:
        await device.close()
    except DRIVER_ERRORS as error:
        if isinstance(error, asyncio.CancelledError):
            raise_if_cancelled()
        log.error(f"{health.name}: error while closing {type(device).__qualname__}", exc_info=error)
