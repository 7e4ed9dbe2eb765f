"""Every error slipguard raises on purpose: one line that says what was seen and what to do."""


class SlipguardError(Exception):
    """Base of all; `str(error)` is one line fit for a user."""


class ConfigError(SlipguardError):
    """The configuration is wrong: key, value and what is allowed are in the message."""


class InputError(SlipguardError):
    """A file, frame or argument from outside cannot be used."""


class ModelError(SlipguardError):
    """A network file is missing, corrupt or does not keep the model contract."""


class DeviceError(SlipguardError):
    """A device did not do what it was asked; base of the device errors."""


class DeviceLost(DeviceError):
    """The device is gone (unplugged, connection closed): it must be opened again."""


class DeviceTimeout(DeviceError):
    """The device is there but did not answer or deliver in time."""


class FrameCorrupt(DeviceError):
    """A frame arrived damaged: wrong size, error flag, or an impossible value. The next may be fine."""


class FrameFrozen(DeviceError):
    """The camera repeats itself: bit-identical pixels or a repeated sequence number."""


class CommandRefused(SlipguardError):
    """The command makes no sense or is not safe in the present state; the state is unchanged."""
