"""Motion of a held object between two fingers: rotation about the grasp axis, and slip straight down.

(I0 + m b^2) theta'' = m (g + a) b cos(theta) - torque of the fingers and of the table
               m s'' = m (g + a)              - force of the fingers and of the table

theta is 0 with the lever level and grows as the center of mass sinks; s grows downwards in the fingers' frame. The
inertial coupling (m b theta'' on s) is neglected: this is exact for the rotation while s sticks, and an object that
slips freely is dropped anyway. Each step is implicit in the friction: for any step size it is stable, and a sticking
contact does not creep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from slipguard.errors import InputError
from slipguard.limit_surface import FINGER_COUNT, GRAVITY_M_S2, NO_CONTACT_N, pressure_shape
from slipguard.sim.friction import SoftPad, return_to_surface
from slipguard.sim.sim_object import SimObject

SUPPORT_M = 3e-3
"""Lift over which the weight passes from the table to the fingers."""
LANDING_M = 2 * SUPPORT_M
"""An object this close to the table counts as on it: if it slips there it is not dropped."""
TABLE_DAMPING = 0.2
"""Damping ratio of the table under the object."""


@dataclass(frozen=True, slots=True)
class GraspedBody:
    """The mechanics of an object and its grip, in SI units.

    friction: mean of both fingers. A rigid object moves alike in both, so a weaker finger passes its load to the other,
        and together they hold what two fingers of the mean friction hold.
    friction_difference: of the left finger from the mean, relative. Only MuJoCo resolves the two fingers.
    lever_rad: direction of the lever below the horizontal at rotation 0.
    translates: False pins the object to the grasp axis (a hinge), to study rotation only.
    """

    mass_kg: float
    lever_m: float
    inertia_kg_m2: float
    """About the grasp axis: I0 + m b^2."""
    friction: float
    translates: bool = True
    friction_difference: float = 0.0
    lever_rad: float = 0.0

    @classmethod
    def of(cls, item: SimObject, translates: bool = True) -> GraspedBody:
        """Return the mechanics of an object; raise InputError if mass, inertia or friction is not positive."""
        lever_m = item.com_offset_mm * 1e-3
        if item.mass_kg <= 0 or item.inertia_kg_m2 <= 0 or item.friction <= 0:
            raise InputError(f"{item.name}: mass, inertia and friction must be above 0")
        inertia = item.inertia_kg_m2 + item.mass_kg * lever_m**2
        return cls(item.mass_kg, lever_m, inertia, item.friction, translates)


@dataclass(frozen=True, slots=True)
class ObjectMotion:
    """Position and motion of the object in the fingers; all 0 when it is grasped.

    rotation_rad is slip + twist_rad, and slip_m is slip + shear_m; twist and shear are the gel's
    reversible deformation.
    """

    rotation_rad: float = 0.0
    rate_rad_s: float = 0.0
    twist_rad: float = 0.0
    twist_n_m: float = 0.0
    """Torque stored in the gel, all fingers."""
    slip_m: float = 0.0
    slip_m_s: float = 0.0
    shear_m: float = 0.0
    shear_n: float = 0.0
    """Force stored in the gel, all fingers."""
    load_n: float = 0.0
    """Tangential load of all fingers: weight minus the table's share."""
    on_table: bool = False
    """At least one end is within `LANDING_M` of the table."""
    slipping: bool = False
    creep_n_m: float = 0.0
    creep_n: float = 0.0
    """The part of the stored torque and force that relaxes while the gel creeps."""
    side_m: float = 0.0
    """Position across gravity, towards the center of mass. Only MuJoCo's object moves this way."""


@dataclass(frozen=True, slots=True)
class ExternalLoad:
    """The external loads during one step.

    Attributes:
        force_n: grip force of each finger.
        acceleration_m_s2: of the fingers, up.
        rise_m, rise_m_s: of the fingers above the height at which the object lay on the table; None without a table.
        torque_n_m: replaces the gravity torque if given.
        push_n, push_n_m: of something that touches the object: force downwards and torque, in addition to the weight.
    """

    force_n: float
    acceleration_m_s2: float = 0.0
    rise_m: float | None = None
    rise_m_s: float = 0.0
    torque_n_m: float | None = None
    push_n: float = 0.0
    push_n_m: float = 0.0


def table_reaction_n(motion: ObjectMotion, body: GraspedBody, load: ExternalLoad) -> tuple[float, float, bool]:
    """Return the table's upward force at the object's near end (on the grasp axis) and far end (two levers away).

    Also return whether an end is within `LANDING_M` of the table. The object is a bar gripped at one end: lying flat,
    each end carries half the weight; lifted, the support fades over `SUPPORT_M`. If it rotates while lifted, it pivots
    on the far end. Forces are never negative, and 0 without a table.
    """
    if load.rise_m is None:
        return 0.0, 0.0, False
    near_m = load.rise_m - motion.slip_m
    if near_m - 2.0 * body.lever_m > LANDING_M:
        return 0.0, 0.0, False
    half_n = 0.5 * body.mass_kg * GRAVITY_M_S2
    stiffness = half_n / SUPPORT_M
    damping = 2.0 * TABLE_DAMPING * math.sqrt(stiffness * 0.5 * body.mass_kg)
    near_m_s = load.rise_m_s - motion.slip_m_s
    far_m = near_m - 2.0 * body.lever_m * math.sin(motion.rotation_rad)
    far_m_s = near_m_s - 2.0 * body.lever_m * math.cos(motion.rotation_rad) * motion.rate_rad_s
    near_n = half_n - stiffness * near_m - damping * near_m_s if near_m < SUPPORT_M else 0.0
    far_n = half_n - stiffness * far_m - damping * far_m_s if far_m < SUPPORT_M else 0.0
    return max(near_n, 0.0), max(far_n, 0.0), min(near_m, far_m) < LANDING_M


def advance(motion: ObjectMotion, body: GraspedBody, gel: SoftPad, load: ExternalLoad, step_s: float) -> ObjectMotion:
    """Return the motion one step later; first order, implicit in gel and friction, stable for any step and force.

    A step of 1 ms suffices (angles accurate to 1 %).
    """
    dt = step_s
    weight_n = body.mass_kg * (GRAVITY_M_S2 + load.acceleration_m_s2)
    near_n, far_n, on_table = table_reaction_n(motion, body, load)
    lever_m = body.lever_m * math.cos(body.lever_rad + motion.rotation_rad)
    torque_n_m = (weight_n - 2.0 * far_n) * lever_m if load.torque_n_m is None else load.torque_n_m
    torque_n_m += load.push_n_m
    load_n = weight_n + load.push_n - near_n - far_n
    if load.force_n <= NO_CONTACT_N:
        return _fall(motion, body, load_n, torque_n_m, on_table, dt)

    n = FINGER_COUNT
    torsion, shear = gel.stiffness(load.force_n)
    # Friction per elastic rate during the step: spring and damper together.
    elastic_s = dt + gel.relaxation_s
    twist_gain, shear_gain = n * torsion * elastic_s, n * shear * elastic_s
    # Viscous friction fades in over the first newton.
    touch = n * min(load.force_n, 1.0)
    drag, shear_drag = touch * gel.viscous_n_m_s, touch * gel.viscous_n_s_m

    # The friction that keeps the contact sticking during this step.
    inertia, mass = body.inertia_kg_m2, body.mass_kg
    stick_rate = (inertia * motion.rate_rad_s + dt * (torque_n_m - motion.twist_n_m)) / (inertia + dt * twist_gain)
    stick_torque = motion.twist_n_m + twist_gain * stick_rate
    if body.translates:
        stick_speed = (mass * motion.slip_m_s + dt * (load_n - motion.shear_n)) / (mass + dt * shear_gain)
        stick_force = motion.shear_n + shear_gain * stick_speed
    else:
        stick_force = 0.0

    force_max = n * body.friction * load.force_n
    torque_max = 2.0 * pressure_shape(gel.pressure_k) * gel.contact_radius_m(load.force_n) * force_max
    # Slip rate per missing friction: inertia, less elastic rate, and drag.
    rotation_compliance = dt / inertia + 1.0 / twist_gain
    slip_compliance = dt / mass + 1.0 / shear_gain
    rotation_compliance /= 1.0 + rotation_compliance * drag
    slip_compliance /= 1.0 + slip_compliance * shear_drag
    dry_force, dry_torque = return_to_surface(
        (stick_force, stick_torque), (force_max, torque_max), (slip_compliance, rotation_compliance)
    )
    rotational_slip = rotation_compliance * (stick_torque - dry_torque)
    translational_slip = slip_compliance * (stick_force - dry_force)
    torque = dry_torque + drag * rotational_slip
    force = dry_force + shear_drag * translational_slip

    rate = motion.rate_rad_s + dt * (torque_n_m - torque) / inertia
    twist_rate = (torque - motion.twist_n_m) / twist_gain
    if body.translates:
        speed = motion.slip_m_s + dt * (load_n - force) / mass
        shear_rate = (force - motion.shear_n) / shear_gain
    else:
        speed = shear_rate = 0.0
    twist_n_m, shear_n = n * torsion * dt * twist_rate, n * shear * dt * shear_rate
    crept_n_m, creep_n_m = _relaxed(gel, motion.creep_n_m, twist_n_m, dt)
    crept_n, creep_n = _relaxed(gel, motion.creep_n, shear_n, dt)
    return ObjectMotion(
        rotation_rad=motion.rotation_rad + dt * rate,
        rate_rad_s=rate,
        twist_rad=motion.twist_rad + dt * twist_rate,
        twist_n_m=motion.twist_n_m + twist_n_m - crept_n_m,
        slip_m=motion.slip_m + dt * speed,
        slip_m_s=speed,
        shear_m=motion.shear_m + dt * shear_rate,
        shear_n=motion.shear_n + shear_n - crept_n,
        load_n=load_n,
        on_table=on_table,
        slipping=rotational_slip != 0.0 or translational_slip != 0.0,
        creep_n_m=creep_n_m,
        creep_n=creep_n,
    )


def _fall(
    motion: ObjectMotion, body: GraspedBody, load_n: float, torque_n_m: float, on_table: bool, step_s: float
) -> ObjectMotion:
    """Return the motion one step later of an object that no finger touches."""
    rate = motion.rate_rad_s + step_s * torque_n_m / body.inertia_kg_m2
    speed = motion.slip_m_s + step_s * load_n / body.mass_kg if body.translates else 0.0
    return ObjectMotion(
        rotation_rad=motion.rotation_rad + step_s * rate,
        rate_rad_s=rate,
        slip_m=motion.slip_m + step_s * speed,
        slip_m_s=speed,
        load_n=load_n,
        on_table=on_table,
        slipping=True,
    )


def _relaxed(gel: SoftPad, creeping: float, added: float, step_s: float) -> tuple[float, float]:
    """Return what a creeping gel loses of its stored load in a step, and what can still relax (a Maxwell branch)."""
    if gel.creep == 0.0:
        return 0.0, 0.0
    creeping += added * gel.creep / (1.0 + gel.creep)
    lost = creeping * min(step_s * (1.0 + gel.creep) / gel.creep_s, 1.0)
    return lost, creeping - lost
