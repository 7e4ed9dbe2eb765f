"""Makes a DIGIT stream as configured, and says in words what could not be had. Everything here blocks."""

from __future__ import annotations

import errno
from collections.abc import Callable

from slipguard.errors import DeviceLost
from slipguard_drivers.digit.capture import V4l2Capture, VideoMode
from slipguard_drivers.digit.discovery import DigitDevice, plugged_in
from slipguard_drivers.digit.pixel_format import WIRE_HEIGHT_PX, WIRE_WIDTH_PX
from slipguard_drivers.digit.settings import DigitSettings, Levels
from slipguard_drivers.digit.v4l2 import ZOOM_ABSOLUTE

Started = tuple[DigitDevice, V4l2Capture, VideoMode, tuple[str, ...]]


def start_digit(
    settings: DigitSettings,
    name: str,
    find: Callable[[str, str], DigitDevice],
    open_capture: Callable[[str], V4l2Capture],
) -> Started:
    """Find a sensor and make it stream; what is not as asked comes last, in words. Blocks. Raises DeviceLost."""
    found = find(settings.serial, name)
    try:
        capture = open_capture(str(found.path))
    except OSError as error:
        raise DeviceLost(f"{name}: {found.path} cannot be used: {reason(error)}") from error
    try:
        mode = capture.configure(choose(capture.modes(WIRE_WIDTH_PX, WIRE_HEIGHT_PX), settings, capture))
        remarks = [*_rate_remark(mode, settings.fps), *set_leds(capture, found, settings.led_rgb)]
        capture.start()
    except OSError as error:
        capture.close()
        why = _no_bandwidth(found, settings) if error.errno == errno.ENOSPC else reason(error)
        raise DeviceLost(f"{name}: {found.path} does not start: {why}") from error
    return found, capture, mode, tuple(remarks)


def choose(modes: list[VideoMode], settings: DigitSettings, capture: V4l2Capture) -> VideoMode:
    """The mode to ask for: the rate first, then YUYV, which costs no decoding. OSError EINVAL where there is none."""
    wanted = ("YUYV", "MJPG") if settings.pixels == "auto" else (settings.pixels,)
    usable = [mode for mode in modes if mode.pixels in wanted]
    if not usable:
        offers = ", ".join(map(str, capture.modes())) or "nothing that can be listed"
        raise OSError(
            errno.EINVAL,
            f"{WIRE_WIDTH_PX}x{WIRE_HEIGHT_PX} {' or '.join(wanted)} is needed, it offers {offers}; change pixels",
        )
    best = min(usable, key=lambda mode: (abs(mode.fps - settings.fps), wanted.index(mode.pixels)))
    return VideoMode(best.pixels, best.width_px, best.height_px, best.fps or float(settings.fps))


def set_leds(capture: V4l2Capture, found: DigitDevice, levels: Levels) -> list[str]:
    """Set the LEDs, the DIGIT's zoom control, and say what could not be had. OSError ENODEV when it is gone."""
    value = led_value(levels, rgb=found.has_rgb)
    remarks = []
    if not found.has_rgb and len(set(levels)) > 1:
        remarks.append(
            f"firmware {found.firmware} has one brightness for all LEDs, not led_rgb = {list(levels)}: "
            f"{max(levels)} is used; update the firmware"
        )
    try:
        given = capture.set_control(ZOOM_ABSOLUTE, value)
    except OSError as error:
        if error.errno == errno.ENODEV:
            raise
        return [*remarks, f"the LEDs cannot be set ({error.strerror or error}): led_rgb has no effect"]
    if given != value:
        remarks.append(f"the LEDs were set to {given:#x} where {value:#x} was asked for: led_rgb is not as configured")
    return remarks


def led_value(levels: Levels, *, rgb: bool) -> int:
    """The zoom control's value for LED levels of 0-15 each: the DIGIT's firmware misuses zoom for its LEDs.

    Without `rgb` (old firmware) one brightness of 0-255, that of the brightest.
    """
    red, green, blue = levels
    return red << 8 | green << 4 | blue if rgb else 17 * max(levels)


def _rate_remark(mode: VideoMode, fps: int) -> list[str]:
    if mode.fps == 0.0:
        return [f"the camera does not say its rate; {fps} frames a second were asked for"]
    return [f"the camera gives {mode.fps:g} frames a second where {fps} were asked for"] * (abs(mode.fps - fps) > 0.5)


def _no_bandwidth(found: DigitDevice, settings: DigitSettings) -> str:
    beside = [one.serial for one in plugged_in() if one.bus == found.bus and one.serial != found.serial]
    beside_it = f" beside {' and '.join(beside)}" if beside else ""
    return (
        f"USB bus {found.bus} ({found.usb_mbit_s:g} Mbit/s) has no bandwidth left for it{beside_it}; plug it into a "
        f'port of another controller, or set fps = 30 or pixels = "MJPG" (now {settings.fps} and {settings.pixels})'
    )


def reason(error: OSError) -> str:
    """Why a device cannot be used, and what to do where that is known."""
    known = {
        errno.ENODEV: "it was unplugged; plug it in again",
        errno.ENOENT: "its device node is not there yet; wait a moment",
        errno.EBUSY: "another program is using it, or the other finger has the same serial; give each its own sensor",
        errno.EACCES: "access is denied; `sudo slipguard install` puts the udev rule in place; join the group video",
    }
    return known.get(error.errno or 0) or error.strerror or str(error)
