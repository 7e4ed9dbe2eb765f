"""Image distortions of growing strength: light, color, pixel and compression faults of a camera."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Distortion = Callable[[Image, float, np.random.Generator], Image]
"""(image (320, 240, 3) uint8 BGR, strength 0..1, random numbers) to an image of the same shape and type."""


def _clipped(levels: NDArray[np.floating]) -> Image:
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)


def _gain(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return _clipped(image * 2.0 ** (4.0 * strength * rng.choice((-1.0, 1.0))))


def _offset(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return _clipped(image + 200.0 * strength * rng.choice((-1.0, 1.0), 3))


def _gamma(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return _clipped(255.0 * (image / 255.0) ** (5.0 ** (strength * rng.choice((-1.0, 1.0)))))


def _slope(image: Image, strength: float, rng: np.random.Generator) -> Image:
    y, x = np.mgrid[-1.0:1.0:320j, -1.0:1.0:240j]
    tilt = rng.uniform(-1, 1, (2, 3))
    return _clipped(image + 200.0 * strength * (x[..., None] * tilt[0] + y[..., None] * tilt[1]))


def _lamp(image: Image, strength: float, rng: np.random.Generator) -> Image:
    """One color channel fails or saturates."""
    out = image.astype(np.float64)
    channel = int(rng.integers(3))
    out[..., channel] += strength * ((0.0, 255.0)[int(rng.integers(2))] - out[..., channel])
    return _clipped(out)


def _swapped(image: Image, strength: float, rng: np.random.Generator) -> Image:
    """Swap color channels; the smallest strength is the usual mistake, RGB for BGR."""
    orders = ((2, 1, 0), (1, 0, 2), (0, 2, 1), (1, 2, 0), (2, 0, 1))
    return np.ascontiguousarray(image[..., orders[min(int(strength * 5), 4)]])


def _hot(image: Image, strength: float, rng: np.random.Generator) -> Image:
    out = image.copy()
    where = rng.random(image.shape[:2]) < 10.0 ** (-5.0 + 4.3 * strength)
    out[where] = rng.choice((0, 255), (int(where.sum()), 1 if rng.random() < 0.5 else 3))
    return out


def _lines(image: Image, strength: float, rng: np.random.Generator) -> Image:
    out = image.copy()
    for _ in range(1 + int(40 * strength)):
        if rng.random() < 0.5:
            out[int(rng.integers(320))] = rng.integers(256)
        else:
            out[:, int(rng.integers(240))] = rng.integers(256)
    return out


def _spot(image: Image, strength: float, rng: np.random.Generator) -> Image:
    out = image.copy()
    center = (int(rng.integers(240)), int(rng.integers(320)))
    level = int(rng.choice((0, 255)))
    cv2.circle(out, center, int(4 + 200 * strength), (level, level, level), -1)
    return out


def _saturated(image: Image, strength: float, rng: np.random.Generator) -> Image:
    """Saturate values above a level: the exposure is too long."""
    return np.where(image > int(255 - 254 * strength), 255, image).astype(np.uint8)


def _crushed(image: Image, strength: float, rng: np.random.Generator) -> Image:
    """Clip values below a level to black."""
    return np.where(image < int(254 * strength), 0, image).astype(np.uint8)


def _noise(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return _clipped(image + 64.0 * strength * rng.standard_normal(image.shape, dtype=np.float32))


def _blur(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.3 + 12.0 * strength), np.uint8)


def _jpeg(image: Image, strength: float, rng: np.random.Generator) -> Image:
    packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(90 - 89 * strength)])[1]
    unpacked = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    assert unpacked is not None
    return np.asarray(unpacked, np.uint8)


def _few_levels(image: Image, strength: float, rng: np.random.Generator) -> Image:
    step = 1 << (1 + int(6 * strength))
    return (image // step * step).astype(np.uint8)


def _negative(image: Image, strength: float, rng: np.random.Generator) -> Image:
    return _clipped(image + strength * (255.0 - 2.0 * image))


DISTORTIONS: dict[str, Distortion] = {
    "gain": _gain,
    "offset": _offset,
    "gamma": _gamma,
    "slope": _slope,
    "lamp": _lamp,
    "swapped colors": _swapped,
    "hot pixels": _hot,
    "dead lines": _lines,
    "spot": _spot,
    "saturated": _saturated,
    "crushed": _crushed,
    "noise": _noise,
    "blur": _blur,
    "JPEG": _jpeg,
    "few levels": _few_levels,
    "negative": _negative,
}


def unrelated_image(rng: np.random.Generator) -> Image:
    """Return an image that shows no gel: gray, one color, noise, a checkerboard, clouds or a rectangle."""
    kind = int(rng.integers(6))
    shape = (320, 240, 3)
    if kind == 0:
        return np.full(shape, rng.integers(256), np.uint8)
    if kind == 1:
        return rng.integers(0, 256, shape, np.uint8)
    if kind == 2:
        y, x = np.mgrid[0:320, 0:240]
        size = int(rng.integers(1, 60))
        return np.repeat((((x // size + y // size) % 2) * 255).astype(np.uint8)[..., None], 3, 2)
    if kind == 3:
        return np.broadcast_to(rng.integers(0, 256, (1, 1, 3)), shape).astype(np.uint8)
    if kind == 4:
        field = rng.standard_normal((320, 240, 3), dtype=np.float32)
        field = np.asarray(cv2.GaussianBlur(field, (0, 0), float(rng.uniform(2, 40))), np.float32)
        return _clipped(128.0 + 60.0 * field / field.std())
    out = np.zeros(shape, np.uint8)
    cv2.rectangle(out, (60, 80), (180, 240), (255, 255, 255), -1)
    return out


def malformed(rng: np.random.Generator) -> object:
    """Return an object that is not a DIGIT image: another shape, another type, or None."""
    good = np.full((320, 240, 3), 96, np.uint8)
    odd: tuple[Callable[[], object], ...] = (
        lambda: None, lambda: good[..., 0], lambda: good[..., :1], lambda: np.dstack([good, good])[..., :4],
        lambda: good[:160], lambda: good.transpose(1, 0, 2), lambda: good[:0], lambda: good.astype(np.float32),
        lambda: good.astype(np.float32) * np.nan, lambda: good.astype(np.int64), lambda: good.astype(np.bool_),
        lambda: good[None], lambda: np.zeros((), np.uint8), good.tolist, lambda: b"", lambda: 7,
        lambda: good[::-1, ::-1, ::-1], lambda: np.zeros_like(good), lambda: np.full_like(good, 255),
        lambda: good.astype(object),
    )  # fmt: skip
    return odd[int(rng.integers(len(odd)))]()
