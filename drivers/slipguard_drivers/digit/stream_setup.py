"""The settings of a DIGIT, and starting its stream with them. Every function here blocks."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from slipguard.errors import DeviceLost
from slipguard_drivers.digit.capture import V4l2Capture, VideoMode
from slipguard_drivers.digit.decoding import WIRE_HEIGHT_PX, WIRE_WIDTH_PX
from slipguard_drivers.digit.discovery import DigitDevice, connected_digits
from slipguard_drivers.digit.v4l2 import ZOOM_ABSOLUTE

PIXELS = ("YUYV", "MJPG")
MJPG_SHARE = 0.2
"""Size of a compressed image; the camera decides it."""
Level = Annotated[int, Field(ge=0, le=15)]
LedLevels = tuple[Level, Level, Level]
StartedStream = tuple[DigitDevice, V4l2Capture, VideoMode, tuple[str, ...]]
"""Device, open capture, mode, and remarks on what differs from the settings."""


def _serial(text: str) -> str:
    if not (text.isascii() and text.isalnum()):
        raise ValueError("must consist of letters and digits, as printed on the sensor")
    return text


class DigitSettings(BaseModel):
    """Settings of a DIGIT."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    only_one: ClassVar = ("serial",)
    serial: Annotated[str, AfterValidator(_serial)]
    """As printed on the sensor: D and five digits."""
    fps: Literal[30, 60] = 60
    """Frame rate."""
    pixels: Literal["auto", "YUYV", "MJPG"] = "auto"
    """Pixel format: YUYV if it reaches the frame rate ("auto"); MJPG needs less USB bandwidth and more computing."""
    led_rgb: LedLevels = (15, 15, 15)
    """Red, green, blue, 0 to 15 each; calibrate again after a change."""
    stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0
    """Without a frame for this time the stream counts as stalled."""


def start_digit(
    settings: DigitSettings,
    name: str,
    find: Callable[[str, str], DigitDevice],
    open_capture: Callable[[str], V4l2Capture],
) -> StartedStream:
    """Find a sensor and start its stream. Raises DeviceLost."""
    device = find(settings.serial, name)
    refused: VideoMode | None = None
    while True:
        try:
            capture = open_capture(str(device.path))
        except OSError as error:
            raise DeviceLost(f"{name}: {device.path} cannot be opened: {reason(error)}") from error
        try:
            offered = capture.modes(WIRE_WIDTH_PX, WIRE_HEIGHT_PX)
            mode = capture.configure(choose_mode(offered, settings, capture, refused))
            remarks = [*_rate_remark(mode, settings.fps), *set_leds(capture, device, settings.led_rgb)]
            capture.start()
        except OSError as error:
            capture.close()
            if error.errno != errno.ENOSPC:
                raise DeviceLost(f"{name}: {device.path} does not start: {reason(error)}") from error
            if not any(_needs_less(other, mode) for other in usable_modes(offered, settings)):
                why = _no_bandwidth(device, settings)
                raise DeviceLost(f"{name}: {device.path} does not start: {why}") from error
            refused = mode
        else:
            break
    if refused is not None:
        remarks.insert(0, f"USB bus {device.bus} has not enough bandwidth for {refused}; {mode} is used")
    return device, capture, mode, tuple(remarks)


def stream_bytes_s(pixels: str, fps: float) -> float:
    """Return the bytes per second of a stream; a compressed image has about a fifth of the bytes."""
    return WIRE_WIDTH_PX * WIRE_HEIGHT_PX * 2 * fps * (MJPG_SHARE if pixels == "MJPG" else 1.0)


def usable_modes(modes: list[VideoMode], settings: DigitSettings) -> list[VideoMode]:
    """Return the modes with pixels as configured."""
    wanted = PIXELS if settings.pixels == "auto" else (settings.pixels,)
    return [mode for mode in modes if mode.pixels in wanted]


def _needs_less(mode: VideoMode, other: VideoMode) -> bool:
    return stream_bytes_s(mode.pixels, mode.fps) < stream_bytes_s(other.pixels, other.fps)


def choose_mode(
    modes: list[VideoMode], settings: DigitSettings, capture: V4l2Capture, refused: VideoMode | None = None
) -> VideoMode:
    """Return the mode to request: the nearest rate first, then YUYV, which needs no decoding.

    refused: the USB bus has not enough bandwidth for this mode. Raises OSError EINVAL if no mode is usable.
    """
    wanted = PIXELS if settings.pixels == "auto" else (settings.pixels,)
    usable = [mode for mode in usable_modes(modes, settings) if refused is None or _needs_less(mode, refused)]
    if not usable:
        offers = ", ".join(map(str, capture.modes())) or "no modes"
        raise OSError(
            errno.EINVAL,
            f"{WIRE_WIDTH_PX}x{WIRE_HEIGHT_PX} {' or '.join(wanted)} is needed, it offers {offers}; change pixels",
        )
    best = min(usable, key=lambda mode: (abs(mode.fps - settings.fps), wanted.index(mode.pixels)))
    return VideoMode(best.pixels, best.width_px, best.height_px, best.fps or float(settings.fps))


def set_leds(capture: V4l2Capture, device: DigitDevice, levels: LedLevels) -> list[str]:
    """Set the LEDs and return remarks on what was not possible. Raises OSError ENODEV if the device is gone."""
    value = led_value(levels, rgb=device.has_rgb)
    remarks = []
    if not device.has_rgb and len(set(levels)) > 1:
        remarks.append(
            f"firmware {device.firmware} has one brightness for all LEDs, so led_rgb = {list(levels)} becomes "
            f"{max(levels)}; update the firmware"
        )
    try:
        actual = capture.set_control(ZOOM_ABSOLUTE, value)
    except OSError as error:
        if error.errno == errno.ENODEV:
            raise
        return [*remarks, f"the LEDs cannot be set ({error.strerror or error}); led_rgb has no effect"]
    if actual != value:
        remarks.append(f"the LEDs are set to {actual:#x} instead of {value:#x}; led_rgb is not as configured")
    return remarks


def led_value(levels: LedLevels, *, rgb: bool) -> int:
    """Return the value of the zoom control, which the DIGIT's firmware uses for its LEDs.

    Args:
        levels: red, green, blue, 0-15 each.
        rgb: False for old firmware, which has one brightness of 0-255: that of the brightest LED.
    """
    red, green, blue = levels
    return red << 8 | green << 4 | blue if rgb else 17 * max(levels)


def _rate_remark(mode: VideoMode, fps: int) -> list[str]:
    if mode.fps == 0.0:
        return [f"the camera does not report its rate; {fps} frames per second were requested"]
    differs = abs(mode.fps - fps) > 0.5
    return [f"the camera delivers {mode.fps:g} frames per second, {fps} were requested"] if differs else []


def _no_bandwidth(device: DigitDevice, settings: DigitSettings) -> str:
    others = [other.serial for other in connected_digits() if other.bus == device.bus and other.serial != device.serial]
    shared = f", shared with {' and '.join(others)}" if others else ""
    return (
        f"USB bus {device.bus} ({device.usb_mbit_s:g} Mbit/s{shared}) has not enough bandwidth; use a port of another "
        f'USB controller, or set fps = 30 or pixels = "MJPG" (now {settings.fps} and {settings.pixels})'
    )


def reason(error: OSError) -> str:
    """Return why a device cannot be used, and what to do if that is known."""
    known = {
        errno.ENODEV: "it was unplugged; plug it in again",
        errno.ENOENT: "its device node does not exist yet; wait a moment",
        errno.EBUSY: "another program uses it, or the other finger has the same serial; check for both",
        errno.EACCES: "access is denied; `sudo slipguard install` adds the udev rule; join the group video",
    }
    return known.get(error.errno or 0) or error.strerror or str(error)
