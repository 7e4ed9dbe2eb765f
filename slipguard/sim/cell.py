"""State of gripper, arm, table and object, and the simulation step: pure values.

The object lies on a table between the jaws until they press on it; from then on it moves in the fingers' frame.
A dropped object stays dropped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from slipguard.limit_surface import FINGER_COUNT, NO_CONTACT_N
from slipguard.sim import arm_plant, gripper_plant, object_motion
from slipguard.sim.arm_plant import ArmPlant, ArmPose
from slipguard.sim.friction import SoftPad
from slipguard.sim.gel_view import GelView
from slipguard.sim.gripper_plant import Drive, GripperDynamics, GripperPlant
from slipguard.sim.object_motion import ExternalLoad, GraspedBody, ObjectMotion
from slipguard.sim.scenario import Scenario
from slipguard.sim.sim_object import SimObject

MAX_ROTATION_DEG = 60.0
"""A larger rotation counts as dropped."""
MAX_SLIP_MM = 12.0
"""With a larger slip the object is out of the fingers: the gel is 25.5 mm high, grasps are near its center."""
REFERENCE_PRESS_N = 40.0
"""The force of an object's `press_mm`; the depth is proportional to the square root of the force."""
GEL_IMPRINT = "egg"
"""The object whose imprint is that of another gel: a smooth dome."""
GEL_PRESS_MM = 0.6
"""Indentation of two gels that press on each other with 40 N."""


Mechanics = Callable[[ObjectMotion, GraspedBody, SoftPad, ExternalLoad, float], ObjectMotion]
"""As `object_motion.advance`: motion, body, gel, load, step in seconds -> motion."""


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """The placed object: its scenario and its mechanics, with scaled friction."""

    scenario: Scenario
    item: SimObject
    body: GraspedBody
    needed_n: float


@dataclass(frozen=True, slots=True)
class CellState:
    """State of the cell.

    Attributes:
        held: the fingers press on the object.
        fingertip_mm: thickness of each fingertip sensor; without an object the gels meet at twice this width.
        table_mm: finger height at which the object lies flat.
        disturbance_m_s2: additional acceleration of the fingers (vibration, a touch), up, by time; None for none.
        push: additional force on the object, downwards, and torque, by time; None for none.
        mechanics: returns the motion of the object one step later.
    """

    gripper: GripperPlant
    gripper_model: GripperDynamics
    arm: ArmPlant = field(default_factory=ArmPlant)
    placed: PlacedObject | None = None
    motion: ObjectMotion = field(default_factory=ObjectMotion)
    table_mm: float = 0.0
    held: bool = False
    dropped: str | None = None
    fingertip_mm: float = 0.0
    disturbance_m_s2: Callable[[float], float] | None = None
    push: Callable[[float], tuple[float, float]] | None = None
    mechanics: Mechanics = object_motion.advance

    @property
    def present(self) -> PlacedObject | None:
        """The object between the jaws, None if there is none."""
        return self.placed if self.dropped is None else None

    @property
    def gels_meet(self) -> bool:
        """Whether the gels press on each other, with nothing between them."""
        return self.present is None and self.fingertip_mm > 0.0 and self.gripper.force_n > NO_CONTACT_N

    @property
    def stops_at_mm(self) -> float | None:
        """Width of the jaws at which object or gels stop them; None if nothing does."""
        if self.present is not None:
            return self.present.item.width_mm + 2.0 * self.fingertip_mm
        return 2.0 * self.fingertip_mm if self.fingertip_mm > 0.0 else None


def step(cell: CellState, now_s: float, step_s: float, *, gripper_works: bool = True) -> CellState:
    here = arm_plant.pose(cell.arm, now_s)
    placed = cell.present
    gripper = cell.gripper
    if gripper_works:
        gripper = gripper_plant.advance(gripper, cell.gripper_model, now_s, step_s, cell.stops_at_mm)
    if placed is None:
        return replace(cell, gripper=gripper)
    pressed = gripper.force_n > NO_CONTACT_N
    if not pressed and not cell.held:
        return replace(cell, gripper=gripper, table_mm=here.height_mm)
    motion = cell.motion if cell.held else ObjectMotion()
    push_n, push_n_m = cell.push(now_s) if cell.push is not None else (0.0, 0.0)
    load = ExternalLoad(
        force_n=gripper.force_n,
        acceleration_m_s2=1e-3 * here.acceleration_mm_s2
        + (cell.disturbance_m_s2(now_s) if cell.disturbance_m_s2 else 0.0),
        rise_m=1e-3 * (here.height_mm - cell.table_mm),
        rise_m_s=1e-3 * here.speed_mm_s,
        push_n=push_n,
        push_n_m=push_n_m,
    )
    motion = cell.mechanics(motion, placed.body, placed.scenario.gel, load, step_s)
    dropped = _why_dropped(motion, gripper)
    held = pressed and dropped is None
    if not pressed and dropped is None:  # set down: it rests on the table
        motion = ObjectMotion(rotation_rad=motion.rotation_rad, slip_m=motion.slip_m, on_table=True)
    return replace(cell, gripper=gripper, motion=motion, held=held, dropped=dropped)


def _why_dropped(motion: ObjectMotion, gripper: GripperPlant) -> str | None:
    """Return why the object is dropped in this state; None if it is not. A slide may end while fingers touch it."""
    if abs(motion.rotation_rad) > math.radians(MAX_ROTATION_DEG):
        return f"rotated more than {MAX_ROTATION_DEG:.0f} deg"
    if math.hypot(motion.slip_m, motion.side_m) > 1e-3 * MAX_SLIP_MM:
        return "contact lost"
    opened = gripper.drive is Drive.OPENING or gripper.force_n <= NO_CONTACT_N
    return "contact lost" if opened and motion.slipping and not motion.on_table else None


def is_static(before: CellState, after: CellState, now_s: float) -> bool:
    """Return True if nothing moves until the next command."""
    if not after.gripper.at_rest or now_s < after.arm.segments[-1].start_s or before.held != after.held:
        return False
    if before.gripper is not after.gripper:
        return False
    if not after.held:
        return True
    if after.disturbance_m_s2 is not None or after.push is not None:
        return False
    old, new = before.motion, after.motion
    at_rest = abs(new.rate_rad_s) < 1e-8 and abs(new.slip_m_s) < 1e-10
    return at_rest and abs(new.rate_rad_s - old.rate_rad_s) < 1e-9 and abs(new.slip_m_s - old.slip_m_s) < 1e-11


def view(cell: CellState, finger_sign: int) -> GelView:
    """Return the view of a finger's camera; left +1, right -1 (mirrored image)."""
    placed = cell.present
    if cell.gels_meet:
        depth_mm = GEL_PRESS_MM * math.sqrt(cell.gripper.force_n / REFERENCE_PRESS_N)
        return GelView(GEL_IMPRINT, depth_mm=depth_mm)
    if placed is None:
        return GelView(object_name="", depth_mm=-1.0)
    motion, scenario = cell.motion, placed.scenario
    rotation_sign = finger_sign * scenario.lever_sign
    right, up = (1e3 * part for part in _in_image(motion.slip_m, motion.side_m, scenario))
    right_s, up_s = (1e3 * part for part in _in_image(motion.slip_m_s, 0.0, scenario))
    return GelView(
        object_name=placed.item.name,
        x_mm=finger_sign * (scenario.x_mm + right),
        y_mm=scenario.y_mm + up,
        angle_deg=finger_sign * scenario.angle_deg + rotation_sign * math.degrees(motion.rotation_rad),
        depth_mm=_depth_mm(placed.item, cell),
        vx_mm_s=finger_sign * right_s,
        vy_mm_s=up_s,
        rate_deg_s=rotation_sign * math.degrees(motion.rate_rad_s),
    )


def _in_image(down: float, side: float, scenario: Scenario) -> tuple[float, float]:
    """Return the left image's (right, up) of a way along gravity and one towards the center of mass."""
    side *= -scenario.lever_sign  # a lever to the left rotates the object counter-clockwise
    cos, sin = math.cos(math.radians(scenario.wrist_deg)), math.sin(math.radians(scenario.wrist_deg))
    return down * sin + side * cos, side * sin - down * cos


def _depth_mm(item: SimObject, cell: CellState) -> float:
    """Return the indentation: minus the gap before contact, then press_mm * sqrt(N / 40 N)."""
    gripper = cell.gripper
    if gripper.force_n <= NO_CONTACT_N:
        return min(0.5 * (item.width_mm - gripper.width_mm) + cell.fingertip_mm, 0.0)
    return item.press_mm * math.sqrt(gripper.force_n / REFERENCE_PRESS_N)


@dataclass(frozen=True, slots=True)
class WorldTruth:
    """The true state, for evaluation only, never for the loop. After a drop: the state at that moment.

    Angles are degrees in the left image, counter-clockwise positive, relative to the present grasp on the table.

    Attributes:
        rotation_deg: elastic_deg (reversible torsion of the gel) + slip_deg.
        slip_mm, slip_rate_mm_s: translational slip, downwards; elastic_mm of it is the gel's shear.
        needed_force_n: per finger, to hold the level object at rest.
        load_n: tangential load per finger.
        in_contact: the gels press on the object, or on each other.
    """

    time_s: float
    object_name: str | None
    rotation_deg: float
    elastic_deg: float
    slip_deg: float
    rate_deg_s: float
    angle_deg: float
    slip_mm: float
    slip_rate_mm_s: float
    elastic_mm: float
    force_n: float
    applied_n: float
    needed_force_n: float
    load_n: float
    height_mm: float
    on_table: bool
    in_contact: bool
    slipping: bool
    dropped: str | None


def truth(cell: CellState, here: ArmPose, now_s: float) -> WorldTruth:
    motion, placed = cell.motion, cell.placed
    sign = placed.scenario.lever_sign if placed is not None else 1
    start_deg = placed.scenario.angle_deg if placed is not None else 0.0
    rotation_deg = sign * math.degrees(motion.rotation_rad)
    elastic_deg = sign * math.degrees(motion.twist_rad)
    return WorldTruth(
        time_s=now_s,
        object_name=placed.item.name if placed is not None else None,
        rotation_deg=rotation_deg,
        elastic_deg=elastic_deg,
        slip_deg=rotation_deg - elastic_deg,
        rate_deg_s=sign * math.degrees(motion.rate_rad_s),
        angle_deg=start_deg + rotation_deg,
        slip_mm=1e3 * motion.slip_m,
        slip_rate_mm_s=1e3 * motion.slip_m_s,
        elastic_mm=1e3 * motion.shear_m,
        force_n=cell.gripper.force_n,
        applied_n=cell.gripper.applied_n,
        needed_force_n=placed.needed_n if placed is not None else 0.0,
        load_n=max(motion.load_n, 0.0) / FINGER_COUNT,
        height_mm=here.height_mm,
        on_table=placed is not None and cell.dropped is None and (not cell.held or motion.on_table),
        in_contact=cell.held or cell.gels_meet,
        slipping=cell.held and motion.slipping,
        dropped=cell.dropped,
    )
