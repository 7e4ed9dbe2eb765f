"""Scenarios of the grip bench: a grasp, and how its load arrives. Both plants run the same ones.

The needed force is log-uniform over the force limit, so no constant force suits all of them. A scenario is a function
of its seed and number. Controllers are tuned on seeds below `FIRST_TEST_SEED`; results are stated on seeds from there.
Forces are true ones: only the plant knows by how much a gripper's force differs from the commanded one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Literal

import numpy as np

from slipguard.limit_surface import GRAVITY_M_S2, torque_limit_n_m
from slipguard.sim.catalogue import find_object
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import FrameDelivery, Scenario
from slipguard.sim.sim_object import SimObject

FIRST_TEST_SEED = 1000
TEST_OBJECTS = ("bar", "wedge", "wrench", "knife_edge", "key", "screwdriver", "cap", "hook")
"""Test objects whose rotation is visible: that of the ring never is, that of the ball is declined in most grasps."""
Event = Literal["lift", "support gone", "mass added", "contact", "acceleration"]
EVENTS: tuple[Event, ...] = ("lift", "support gone", "mass added", "contact", "acceleration")
Motion = Literal["rotation", "slide", "both"]
MOTIONS: tuple[Motion, ...] = ("rotation", "slide", "both")
PadKind = Literal["stiff", "soft", "creeping"]
PADS: tuple[PadKind, ...] = ("stiff", "soft", "creeping")
LIMITS_N = {60.0: 10.0, 120.0: 10.0, 130.0: 20.0, 200.0: 20.0}
"""Force limits, and the weakest grip of a gripper for it: of a 2F-140 and of a 2F-85."""
NEEDED_SHARE = (0.08, 0.95)
"""Needed force relative to the force limit, log-uniform."""
FIRM = 0.6
"""A grasp that needs at most this share of its first grip is firm: nothing may tighten it."""
FIRM_LIFTS = 0.25
"""Share of lifts that start firm; the others start with `WEAK_GRIP` of the needed force, if the gripper can."""
FIRM_GRIP, WEAK_GRIP, WEAK_GRIP_GONE = (0.25, 0.58), (0.3, 0.97), (0.75, 0.99)
"""Without its support an object falls before any motor acts, unless the grip nearly holds it."""
FRICTION, FRICTION_DIFFERENCE = (0.2, 1.2), 0.3
LEVER_MM: dict[Motion, tuple[float, float]] = {"rotation": (25.0, 120.0), "slide": (0.0, 0.0), "both": (2.0, 10.0)}
MASS_KG = (0.02, 5.0)
"""What a UR5 carries."""
BASE_SHARE, BASE_SHARE_MASS = (0.35, 0.85), (0.65, 0.95)
"""Share of the load that is there from lift-off on, where more arrives later; added mass arrives at once."""
LIFT_M_S2 = 1.2
"""Acceleration of the arm at the beginning of a lift."""
LIFT_MM = 60.0
SPEED_MM_S = (15.0, 250.0)
LATENCY_S = (0.06, 0.25)
"""From exposure to the start of the motor."""
CAMERA_SHARE = 0.4
"""Camera's share of the latency without perception; the rest belongs to the gripper's line and motor."""
PERCEIVING_S = 0.006
TRANSACTION_MAX_S = 0.016
ROOM_MM = 2.0
"""The jaws start this much wider than the object."""
ONSET_S = (0.1, 2.0)
"""Duration of the arrival of a contact or an acceleration."""
OUTAGES = 0.3
"""Share of lifts in which the frames of one finger are lost for a while."""
OUTAGE_S = (0.05, 0.8)


@dataclass(frozen=True, slots=True)
class GripScenario:
    """One grasp.

    Attributes:
        force_max_n: Force limit. first_n: first grip as commanded. needed_n: true force that the largest load needs.
        mass_kg, lever_mm: Of the whole load; base_share: the part that is there before the event.
        onset_s: Duration of a contact's or an acceleration's arrival.
        pose: Object, pads, gripper and cameras.
        outage: Finger, start after lift-off and duration in seconds of lost frames; None for none.
    """

    seed: int
    number: int
    event: Event
    motion: Motion
    pad: PadKind
    force_max_n: float
    first_n: float
    needed_n: float
    mass_kg: float
    lever_mm: float
    friction: float
    base_share: float
    onset_s: float
    lift_speed_mm_s: float
    pose: Scenario
    outage: tuple[str, float, float] | None

    @property
    def name(self) -> str:
        return f"scenario {self.seed}/{self.number}: {self.event}, {self.motion}, {self.pad} pads"

    @property
    def grip_n(self) -> float:
        """True force of the first grip."""
        return self.first_n * self.pose.gripper.gain

    @property
    def weak(self) -> bool:
        """Whether the first grip is too weak for the load."""
        return self.grip_n < self.needed_n

    @property
    def firm(self) -> bool:
        """Whether the first grip must not be tightened."""
        return self.needed_n <= FIRM * self.grip_n

    @property
    def item(self) -> SimObject:
        """The object before the event."""
        share = self.base_share if self.event in ("mass added", "contact", "acceleration") else 1.0
        return self._item(share * self.mass_kg)

    def _item(self, mass_kg: float) -> SimObject:
        inertia = mass_kg * ((1e-3 * self.lever_mm) ** 2 / 3.0 + 1e-4)
        plain = find_object(self.pose.object_name)
        return replace(
            plain, mass_kg=mass_kg, com_offset_mm=self.lever_mm, inertia_kg_m2=inertia, friction=self.friction
        )

    @property
    def base_needed_n(self) -> float:
        """True force that the lift needs, before more load arrives; its acceleration is included."""
        lifted_m_s2 = 0.0 if self.event == "support gone" else LIFT_M_S2
        return needed_force_n(self.item, self.pose.gel, acceleration_m_s2=lifted_m_s2)

    def as_json(self) -> dict[str, Any]:
        gripper, gel = self.pose.gripper, self.pose.gel
        return {
            "seed": self.seed,
            "number": self.number,
            "event": self.event,
            "motion": self.motion,
            "pad": self.pad,
            "object": self.pose.object_name,
            "force_max_n": self.force_max_n,
            "first_n": round(self.grip_n, 2),
            "needed_n": round(self.needed_n, 2),
            "mass_kg": round(self.mass_kg, 4),
            "lever_mm": round(self.lever_mm, 2),
            "friction": [round(self.friction * (1.0 + s * self.pose.friction_difference), 3) for s in (1.0, -1.0)],
            "base_share": round(self.base_share, 3),
            "onset_s": round(self.onset_s, 3),
            "lift_speed_mm_s": round(self.lift_speed_mm_s, 1),
            "wrist_deg": round(self.pose.wrist_deg, 1),
            "lever_deg": round(self.pose.lever_deg, 1),
            "torsion_n_m_rad": round(gel.torsion_n_m_rad, 3),
            "creep": round(gel.creep, 3),
            "gain": round(gripper.gain, 3),
            "ramp_n_s": round(gripper.ramp_n_s, 1),
            "fps": self.pose.left.fps,
        }


def scenarios(count: int, seed: int) -> list[GripScenario]:
    """Return scenarios that cover every event, motion and pad alike. Equal seeds give equal scenarios."""
    cells = list(product(EVENTS, MOTIONS, PADS))
    order = np.random.default_rng([seed, 1]).permutation(len(cells))
    return [draw(seed, k, *cells[order[k % len(cells)]]) for k in range(count)]


def draw(seed: int, number: int, event: Event, motion: Motion, pad: PadKind) -> GripScenario:
    """Return one scenario. Draws are repeated until the object is neither too light nor too heavy to be lifted."""
    rng = np.random.default_rng([seed, number, 5])
    while True:
        found = _drawn(rng, seed, number, event, motion, pad)
        if MASS_KG[0] <= found.mass_kg <= MASS_KG[1] and found.base_share * found.mass_kg > MASS_KG[0]:
            return found


def _drawn(
    rng: np.random.Generator, seed: int, number: int, event: Event, motion: Motion, pad: PadKind
) -> GripScenario:
    limit_n = float(rng.choice(tuple(LIMITS_N)))
    gripper = _gripper(rng, LIMITS_N[limit_n])
    gone = event == "support gone"
    needed_n = gripper.gain * limit_n * _log_uniform(rng, *NEEDED_SHARE)
    weak = WEAK_GRIP_GONE if gone else WEAK_GRIP
    grip = float(rng.uniform(*FIRM_GRIP)) if rng.random() < FIRM_LIFTS else 1.0 / _log_uniform(rng, *weak)
    first_n = gripper.quantized_force_n(min(needed_n / grip / gripper.gain, limit_n - gripper.force_step_n))
    low, high = FRICTION
    friction = _log_uniform(rng, low / (1.0 - FRICTION_DIFFERENCE), high / (1.0 + FRICTION_DIFFERENCE))
    lever_mm = float(rng.uniform(*LEVER_MM[motion]))
    fps, latency_s = float(rng.choice((30.0, 60.0))), CAMERA_SHARE * (_log_uniform(rng, *LATENCY_S) - PERCEIVING_S)
    x_mm, y_mm = (float(v) for v in rng.uniform(-2.0, 2.0, 2))
    scenario = GripScenario(
        seed=seed,
        number=number,
        event=event,
        motion=motion,
        pad=pad,
        force_max_n=limit_n,
        first_n=first_n,
        needed_n=needed_n,
        mass_kg=1.0,
        lever_mm=lever_mm,
        friction=friction,
        base_share=float(rng.uniform(*(BASE_SHARE_MASS if event == "mass added" else BASE_SHARE))),
        onset_s=_log_uniform(rng, *ONSET_S),
        lift_speed_mm_s=_log_uniform(rng, *SPEED_MM_S),
        pose=Scenario(
            object_name=str(rng.choice(TEST_OBJECTS)),
            seed=number,
            x_mm=x_mm,
            y_mm=y_mm,
            angle_deg=float(rng.uniform(-90.0, 90.0)),
            lever_sign=int(rng.choice((-1, 1))),
            friction_difference=float(rng.uniform(-FRICTION_DIFFERENCE, FRICTION_DIFFERENCE)),
            wrist_deg=float(rng.choice((0.0, 0.0, 90.0, 180.0)) + rng.normal(0.0, 15.0)),
            lever_deg=float(rng.uniform(-45.0, 45.0)) if gone else 0.0,
            gel=_pad(rng, pad),
            gripper=gripper,
            left=_delivery(rng, fps, latency_s),
            right=_delivery(rng, fps, latency_s),
        ),
        outage=_outage(rng) if rng.random() < OUTAGES else None,
    )
    return replace(scenario, mass_kg=_mass_kg(scenario))


def _mass_kg(scenario: GripScenario) -> float:
    """Return the mass of the whole load for which the largest load needs `needed_n`."""
    gel = scenario.pose.gel
    lever_m = 1e-3 * scenario.lever_mm * math.cos(math.radians(scenario.pose.lever_deg))
    later = scenario.event in ("mass added", "contact", "acceleration")
    lifted = 1.0 + LIFT_M_S2 / GRAVITY_M_S2
    peak = max(1.0, scenario.base_share * lifted) if later else 1.0 if scenario.event == "support gone" else lifted
    friction_n = scenario.friction * scenario.needed_n
    torque_n_m = torque_limit_n_m(scenario.needed_n, scenario.friction, gel)
    load_n = 1.0 / math.hypot(1.0 / friction_n, lever_m / torque_n_m)  # on the limit surface
    return 2.0 * load_n / (peak * GRAVITY_M_S2)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _pad(rng: np.random.Generator, kind: PadKind) -> SoftPad:
    viscous = float(rng.uniform(0.005, 0.02))
    if kind == "stiff":
        return SoftPad(torsion_n_m_rad=50.0, relaxation_s=0.005, viscous_n_m_s=viscous)
    return SoftPad(
        torsion_n_m_rad=_log_uniform(rng, 0.1, 0.5),
        stiffening=3.0,
        relaxation_s=float(rng.uniform(0.01, 0.03)),
        viscous_n_m_s=viscous,
        creep=float(rng.uniform(0.2, 0.8)) if kind == "creeping" else 0.0,
        creep_s=_log_uniform(rng, 0.3, 5.0),
    )


def _gripper(rng: np.random.Generator, force_min_n: float) -> GripperDynamics:
    """Return a gripper with its share of the latency: two transactions, then the motor's dead time."""
    rest_s = (1.0 - CAMERA_SHARE) * (_log_uniform(rng, *LATENCY_S) - PERCEIVING_S)
    transaction_s = min(TRANSACTION_MAX_S, rest_s / 4.0)
    return GripperDynamics(
        transaction_s=transaction_s,
        dead_time_s=rest_s - 2.0 * transaction_s,
        ramp_n_s=_log_uniform(rng, 64.0, 480.0),
        gain=float(rng.uniform(0.9, 1.1)),
        force_min_n=force_min_n,
    )


def _delivery(rng: np.random.Generator, fps: float, latency_s: float) -> FrameDelivery:
    """Return a camera in a light that differs from that of the background image."""
    drift = rng.uniform(-5.0, 5.0, 3)
    return FrameDelivery(
        fps=fps,
        latency_s=latency_s,
        jitter_s=float(rng.uniform(0.001, 0.003)),
        drop_probability=float(rng.uniform(0.001, 0.01)),
        duplicate_probability=0.0,
        light_drift_bgr=(float(drift[0]), float(drift[1]), float(drift[2])),
        noise_seed=int(rng.integers(2**31)),
    )


def _outage(rng: np.random.Generator) -> tuple[str, float, float]:
    return str(rng.choice(("left", "right"))), float(rng.uniform(0.0, 2.0)), float(rng.uniform(*OUTAGE_S))
