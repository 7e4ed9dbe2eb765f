"""A fit of the constants of the texture estimate's sigma to rotations of known size.

The rotations are rendered grasps of the training objects; with real data also the tuning part of real presses, rotated
and relit, and of real frames that shear without rotating. Each kind has its share of the weight. The constants are in
`slipguard.perception.rotation.texture_registration`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.rendered_grasps import FRAME_S, GraspFrame, RenderedGrasp, render_grasp
from slipguard.devices import Frame
from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.rotation.texture_map import TextureMapReader
from slipguard.perception.rotation.texture_registration import (
    FLOOR_DEG,
    SIGMA_SHARES,
    TextureFit,
    TexturePose,
    fit_texture,
    parts_deg,
    sigma_deg,
)
from slipguard.perception.rotation.texture_template import make_texture_template
from slipguard.sim.catalogue import object_names
from slipguard.tools.image_files import read_gel_image
from tests.campaigns.rotated_presses import PX_PER_MM, press_images, rotated_grasp

SEED = 7400
FRAME_PX = 2.0
MIN_AREA_PX = 200.0
DEGREES_OF_FREEDOM = 5.0
"""Errors have heavier tails than a Gaussian: a single bad grasp must not determine the constants."""
STEPS = (0.8, 0.4, 0.15, 0.05, 0.02)
HEADROOM = (1.25, 1.25, 1.7, 1.7)
"""Factors on the best fit: two sigmas shall cover 93 % of the errors of unknown objects, whose deformation differs more
between objects than noise does."""
KINDS = {"rendered": 0.6, "relit": 0.25, "sheared": 0.15}
"""Weight of each kind of rotation when all are present."""
SHEARED_NOISE_BGR = (1.5, 0.95, 1.3)
"""Of `anytouch2_force2`: from differences of neighboring frames away from the contact."""
SHEARED_LAST = "f0132"
SHEARED_FRAMES, SHEARED_STEP = 14, 3


@dataclass(frozen=True, slots=True)
class RotationSample:
    """One measured rotation: its error and the texture fit behind it. kind: one of `KINDS`."""

    grasp: str
    error_deg: float
    fit: TextureFit
    kind: str = "rendered"


def samples(grasps: Iterable[RenderedGrasp], segmenter: Segmenter, kind: str = "rendered") -> Iterator[RotationSample]:
    """Yield every texture rotation since the last still frame, frame by frame, of some grasps."""
    for number, grasp in enumerate(grasps):
        start = next((k for k, shot in enumerate(grasp.shots) if shot.compared), 0) - 1
        reader = TextureMapReader(grasp.background, grasp.noise_bgr)
        patch = _patch(segmenter, grasp, start)
        if start < 0 or patch is None:
            continue
        image = grasp.shots[start].frame.image
        reader.learn(image, patch)
        reference = make_texture_template(reader.read(image, patch), patch)
        pose, rate = TexturePose(), 0.0
        for k in range(start + 1, len(grasp.shots)):
            patch = _patch(segmenter, grasp, k)
            if reference is None or patch is None or not grasp.shots[k].compared:
                continue
            texture = reader.read(grasp.shots[k].frame.image, patch)
            fit = fit_texture(reference, texture, replace(pose, rotation_deg=pose.rotation_deg + rate))
            if fit.declined is not None:
                continue
            rate, pose = fit.pose.rotation_deg - pose.rotation_deg, fit.pose
            error = fit.pose.rotation_deg - grasp.shots[k].rotation_deg
            yield RotationSample(f"{kind} {grasp.object_name} {number}", error, fit, kind)


def sheared(folder: Path) -> Iterator[RenderedGrasp]:
    """Yield series of real frames in which a contact shears but does not rotate, tuning part of `anytouch2_force2`."""
    background = read_gel_image(folder / "anytouch2_force2" / "background.png")
    paths = sorted((folder / "anytouch2_force2" / "frames").glob("*.png"))
    images = [read_gel_image(path) for path in paths if path.stem <= SHEARED_LAST]
    for begin in range(0, len(images) - 2, SHEARED_STEP):
        shots = [
            GraspFrame(Frame(image, k * FRAME_S, k), True, 0.0, k > 0, None)
            for k, image in enumerate(images[begin : begin + SHEARED_FRAMES])
        ]
        yield RenderedGrasp(f"from {begin}", True, background, SHEARED_NOISE_BGR, PX_PER_MM, tuple(shots))


def fitted(found: Sequence[RotationSample]) -> tuple[float, ...]:
    """Return the shares of sigma's parts that maximize the likelihood; grasps of one kind have equal weights."""
    error, parts, weight = _table(found)
    best = np.log(np.array(SIGMA_SHARES))
    cost = _negative_log_likelihood(best, error, parts, weight)
    for step in STEPS:
        improved = True
        while improved:
            improved = False
            for axis in range(len(best)):
                for way in (-step, step):
                    other = best.copy()
                    other[axis] = max(other[axis] + way, math.log(1e-3))
                    now = _negative_log_likelihood(other, error, parts, weight)
                    if now < cost - 1e-6:
                        best, cost, improved = other, now, True
    return tuple((np.array(HEADROOM) * np.exp(best)).tolist())


def within(found: Sequence[RotationSample], sigmas: float) -> float:
    """Return the share of errors within a number of sigmas with the constants in use; grasps have equal weights."""
    _, _, weight = _table(found)
    inside = np.array([abs(one.error_deg) <= sigmas * sigma_deg(one.fit) for one in found])
    return float(weight @ inside)


def _patch(segmenter: Segmenter, grasp: RenderedGrasp, index: int) -> Patch | None:
    probability = segmenter.segment(grasp.shots[index].frame.image, grasp.background)
    frame_px = FRAME_PX * 120.0 / probability.shape[1]
    return find_patch(probability, segmenter.threshold, MIN_AREA_PX, frame_px)


def _table(found: Sequence[RotationSample]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return errors, the (n, 4) parts of sigma before their shares, and weights that add up to 1."""
    error = np.array([one.error_deg for one in found])
    parts = np.array([parts_deg(one.fit) for one in found])
    _, place, count = np.unique([one.grasp for one in found], return_inverse=True, return_counts=True)
    weight = 1.0 / count[place]
    kind = np.array([one.kind for one in found])
    for name, share in KINDS.items():
        weight[kind == name] *= share / max(weight[kind == name].sum(), 1e-9)
    return error, parts, weight / weight.sum()


def _negative_log_likelihood(
    logs: NDArray[np.float64], error: NDArray[np.float64], parts: NDArray[np.float64], weight: NDArray[np.float64]
) -> float:
    """Return the negative log likelihood per error, Student's t."""
    square = (parts**2) @ np.exp(2.0 * logs) + FLOOR_DEG**2
    half = (DEGREES_OF_FREEDOM + 1.0) / 2.0
    return float(weight @ (0.5 * np.log(square) + half * np.log1p(error**2 / square / DEGREES_OF_FREEDOM)))


def fit_and_report(grasps: int, real: Path | None, model: Path | None) -> None:
    """Measure rotations of known size, fit the constants, print both sets and how many errors lie within sigma."""
    segmenter = Segmenter(model)
    rendered = (render_grasp(name, SEED + number) for number in range(grasps) for name in object_names("train"))
    found = list(samples(rendered, segmenter))
    print(f"{len(found)} rotations of {len({one.grasp for one in found})} grasps, training objects, seeds from {SEED}")
    if real is not None:
        tuning = [press for press in press_images(real) if press.part == "tune" and press.readable]
        found += samples((rotated_grasp(press, "relit", SEED) for press in tuning), segmenter, "relit")
        found += samples(sheared(real), segmenter, "sheared")
    for word, constants in (("in use", SIGMA_SHARES), ("fitted", fitted(found))):
        named = zip(("SPREAD", "NOISE", "GROWTH", "MISFIT"), constants, strict=True)
        print(f"{word}: " + ", ".join(f"{name} {constant:.3g}" for name, constant in named))
    for kind in KINDS:
        some = [one for one in found if one.kind == kind]
        if some:
            held = [within(some, sigmas) for sigmas in (1.0, 2.0, 5.0)]
            print(f"{kind}: within 1 sigma {held[0]:.3f}, 2 sigma {held[1]:.3f}, 5 sigma {held[2]:.4f} of {len(some)}")
    worst = max(found, key=lambda one: abs(one.error_deg) / sigma_deg(one.fit))
    print(f"worst: {worst.grasp}, {worst.error_deg:+.2f} degrees at sigma {sigma_deg(worst.fit):.2f}")
    print(f"root mean square error {math.sqrt(sum(one.error_deg**2 for one in found) / len(found)):.3f} degrees")
