"""One grasp to simulate: the object, its pose, and the deviations of the cell from its data sheets."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np

from slipguard.sim.friction import SoftPad
from slipguard.sim.gripper_plant import GripperDynamics


@dataclass(frozen=True, slots=True)
class FrameDelivery:
    """How a camera delivers its frames during one grasp.

    Attributes:
        latency_s: from exposure to delivery.
        jitter_s: standard deviation of the capture time stamps.
        tear_probability: of a frame whose upper part (on the wire: left in the image) is still the previous capture.
        light_drift_bgr: change of the light since the background image was taken, gray levels.
    """

    fps: float = 60.0
    latency_s: float = 0.035
    jitter_s: float = 0.002
    drop_probability: float = 0.005
    duplicate_probability: float = 0.002
    tear_probability: float = 0.0
    light_drift_bgr: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise_seed: int = 0


@dataclass(frozen=True, slots=True)
class CameraModel(FrameDelivery):
    """One fingertip camera: its identity and its present delivery."""

    serial: str = ""
    unit_seed: int = 0


@dataclass(frozen=True, slots=True)
class Scenario:
    """One grasp.

    Attributes:
        x_mm, y_mm, angle_deg: the object in the left image at contact.
        lever_sign: +1 if the center of mass causes a counter-clockwise rotation in the left image, else -1.
        friction_scale: factor on the object's friction. friction_difference: see `GraspedBody`.
        wrist_deg: direction of gravity in the left image, counter-clockwise from image down.
        lever_deg: direction of the lever below the horizontal; only 0 fits an object that lies on a table.
    """

    object_name: str
    seed: int = 0
    x_mm: float = 0.0
    y_mm: float = 0.0
    angle_deg: float = 0.0
    lever_sign: int = 1
    friction_scale: float = 1.0
    friction_difference: float = 0.0
    wrist_deg: float = 0.0
    lever_deg: float = 0.0
    gel: SoftPad = field(default_factory=SoftPad)
    gripper: GripperDynamics = field(default_factory=GripperDynamics)
    left: FrameDelivery = field(default_factory=FrameDelivery)
    right: FrameDelivery = field(default_factory=FrameDelivery)


def scenario(object_name: str, seed: int) -> Scenario:
    """Return a random grasp of an object; name and seed give the same grasp on every machine.

    The ranges are published or measured for such parts: dead time 20-60 ms, ramp 64-480 N/s, gain +-10 %, latency
    30-50 ms, 0.1-1 % dropped frames, stamp jitter 1-3 ms, light +-5 gray levels; one gel in five is stiff.
    """
    name_seed = int.from_bytes(hashlib.sha256(object_name.encode()).digest()[:8], "big")
    rng = np.random.default_rng([seed, name_seed])
    x_mm, y_mm = rng.uniform(-2.0, 2.0, 2)
    return Scenario(
        object_name=object_name,
        seed=seed,
        x_mm=float(x_mm),
        y_mm=float(y_mm),
        angle_deg=float(rng.uniform(-90.0, 90.0)),
        lever_sign=int(rng.choice((-1, 1))),
        friction_scale=float(rng.uniform(0.85, 1.15)),
        gel=_gel(rng),
        gripper=GripperDynamics(
            dead_time_s=float(rng.uniform(0.02, 0.06)),
            ramp_n_s=float(np.exp(rng.uniform(np.log(64.0), np.log(480.0)))),
            speed_mm_s=float(rng.uniform(50.0, 150.0)),
            gain=float(rng.uniform(0.9, 1.1)),
        ),
        left=_delivery(rng),
        right=_delivery(rng),
    )


def initial_delivery(seed: int, finger: str) -> FrameDelivery:
    """Return the delivery of a finger's camera before the first grasp."""
    return _delivery(np.random.default_rng([seed, 1 if finger == "left" else 2]))


def sensor_gel(seed: int) -> SoftPad:
    """Return the gel of a cell's two sensors, for `replace(scenario(...), gel=...)`: it is the same for all objects."""
    return _gel(np.random.default_rng([seed, 3]))


def _gel(rng: np.random.Generator) -> SoftPad:
    """Return a random gel: mostly soft silicone that stiffens with the contact, sometimes a stiff pad."""
    stiff = bool(rng.random() < 0.2)
    soft_n_m_rad = float(np.exp(rng.uniform(np.log(0.1), np.log(0.5))))
    relaxation_s = float(rng.uniform(0.01, 0.03))
    viscous_n_m_s = float(rng.uniform(0.005, 0.02))
    if stiff:
        return SoftPad(torsion_n_m_rad=50.0, relaxation_s=0.005, viscous_n_m_s=viscous_n_m_s)
    return SoftPad(torsion_n_m_rad=soft_n_m_rad, stiffening=3.0, relaxation_s=relaxation_s, viscous_n_m_s=viscous_n_m_s)


def _delivery(rng: np.random.Generator) -> FrameDelivery:
    """Return a random delivery; both cameras have the same nominal rate."""
    drift = rng.uniform(-5.0, 5.0, 3)
    return FrameDelivery(
        fps=60.0,
        latency_s=float(rng.uniform(0.03, 0.05)),
        jitter_s=float(rng.uniform(0.001, 0.003)),
        drop_probability=float(rng.uniform(0.001, 0.01)),
        duplicate_probability=float(rng.uniform(0.0, 0.005)),
        light_drift_bgr=(float(drift[0]), float(drift[1]), float(drift[2])),
        noise_seed=int(rng.integers(2**31)),
    )
