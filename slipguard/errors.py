"""The errors that slipguard raises: one line with what happened, the value and its limit, and what to do."""

from __future__ import annotations

import traceback
from pathlib import Path


class SlipguardError(Exception):
    """Base class; `str(error)` is one line for the user."""


class ConfigError(SlipguardError):
    """The configuration is wrong; the message has the key, the value and what is allowed."""


class InputError(SlipguardError):
    """A file, frame or argument from outside cannot be used."""


class ModelError(SlipguardError):
    """A network file is missing, damaged, or has the wrong inputs or outputs."""


class DeviceError(SlipguardError):
    """Base class of device errors: a device did not do what was requested."""


class DeviceLost(DeviceError):
    """The device is gone (unplugged, connection closed) and must be opened again."""


class DeviceTimeout(DeviceError):
    """The device is connected but did not respond or deliver in time."""


class FrameCorrupt(DeviceError):
    """A frame arrived damaged: wrong size, error flag, or an impossible value. The next may be good."""


class FrameTorn(FrameCorrupt):
    """The upper and the lower part of a frame are from different captures."""


class FrameFrozen(DeviceError):
    """The camera repeats a frame: identical pixels or a repeated sequence number."""


class CommandRefused(SlipguardError):
    """The command is not possible or not safe in the present state; the state is unchanged."""


def describe_error(error: BaseException) -> str:
    """Return type and text of an exception in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def raised_in(error: BaseException, own: Path) -> str:
    """Return file and line in which an exception was raised, as " (name.py, line 3)".

    Empty if it was not raised yet, or in `own`, the file or folder that found the error.
    """
    for frame in traceback.extract_tb(error.__traceback__)[-1:]:
        file = Path(frame.filename)
        return "" if file.is_relative_to(own) else f" ({file.name}, line {frame.lineno})"
    return ""
