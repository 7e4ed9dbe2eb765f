"""Friction of soft fingertips: the limit of torque and load that a grip holds, and the slip at this limit.

One fingertip presses with `force_n` on a round patch of radius a(N) = delta N^gamma (Xydas & Kao 1999). It holds
any tangential load and torque inside the ellipsoid (f / (mu N))^2 + (tau / tau_max)^2 <= 1 (Howe & Cutkosky 1996).
Inside, the gel deforms elastically; on the surface it slips along the surface normal. There is no bristle model, which
would creep below the limit: a sticking load does not move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from slipguard.limit_surface import FINGER_COUNT, GRAVITY_M_S2, Pad, force_needed_n
from slipguard.sim.sim_object import SimObject

STIFFNESS_RADIUS_M = 6e-3
"""Contact radius at which a gel's stiffness is stated; 0.14 MPa gives 0.16 N m/rad there."""


@dataclass(frozen=True, slots=True)
class SoftPad(Pad):
    """The soft fingertip: contact size (from `Pad`), elasticity and damping, per finger.

    Attributes:
        torsion_n_m_rad: torque per elastic torsion. Silicone 0.1-0.5 at 6 mm radius; 50 is a stiff pad.
        stiffening: torsion grows as (contact radius / 6 mm)^stiffening; 3 for an elastic half-space, 0 for constant.
        relaxation_s: damping over stiffness of the gel, in torsion and in shear.
        viscous_n_m_s: torque per slip rate in addition to dry friction (0.02: Costanzo et al.).
        viscous_n_s_m: tangential force per slip speed in addition to dry friction.
        creep: further deformation under a constant load, relative to the elastic one; 0 for none. creep_s: its time.
    """

    torsion_n_m_rad: float = 50.0
    stiffening: float = 0.0
    relaxation_s: float = 0.01
    viscous_n_m_s: float = 0.02
    viscous_n_s_m: float = 20.0
    creep: float = 0.0
    creep_s: float = 2.0

    def stiffness(self, force_n: float) -> tuple[float, float]:
        """Return the torsional (N m/rad) and shear (N/m) stiffness of one fingertip at this force.

        Shear follows from torsion: for a round patch on an elastic half-space their ratio is the radius squared.
        """
        if self.stiffening == 0.0:
            return self.torsion_n_m_rad, self.torsion_n_m_rad / STIFFNESS_RADIUS_M**2
        ratio = self.contact_radius_m(force_n) / STIFFNESS_RADIUS_M
        torsion = self.torsion_n_m_rad * ratio**self.stiffening
        return torsion, torsion / (STIFFNESS_RADIUS_M * ratio) ** 2


def needed_force_n(item: SimObject, gel: SoftPad, acceleration_m_s2: float = 0.0) -> float:
    """Return the force per finger at which a level object just does not slip.

    Args:
        acceleration_m_s2: of the lift, upward positive; in free fall the load is 0.
    """
    load_n = item.mass_kg * max(GRAVITY_M_S2 + acceleration_m_s2, 0.0) / FINGER_COUNT
    return force_needed_n(load_n, item.com_offset_mm * 1e-3, item.friction, gel)


def return_to_surface(
    load: tuple[float, float], limit: tuple[float, float], compliance: tuple[float, float]
) -> tuple[float, float]:
    """Return the friction (force, torque) of a contact, given the load it would carry if it stuck.

    Inside the ellipse with half-axes `limit` this is `load`: stick. Outside it is the point of the ellipse from which
    the vector to `load`, weighted with `compliance` (slip rate per force), is normal to the ellipse: the slip that
    dissipates most energy (associated flow rule). Limits of 0 give (0, 0); compliances are positive.
    """
    if limit[0] <= 0.0 or limit[1] <= 0.0:
        return 0.0, 0.0
    p, q = load[0] / limit[0], load[1] / limit[1]
    size_squared = p * p + q * q
    if size_squared <= 1.0:
        return load
    c, d = 1.0 / (compliance[0] * limit[0] ** 2), 1.0 / (compliance[1] * limit[1] ** 2)
    # Secular equation |(p / (1 + s c), q / (1 + s d))| = 1; Newton on 1/size is nearly linear and never overshoots.
    s, u, v = 0.0, p, q
    for _ in range(30):
        size = math.sqrt(size_squared)
        if size - 1.0 < 1e-12:
            break
        fall = u * u * c / (1.0 + s * c) + v * v * d / (1.0 + s * d)
        s += size_squared * (size - 1.0) / fall
        u, v = p / (1.0 + s * c), q / (1.0 + s * d)
        size_squared = u * u + v * v
    size = math.sqrt(size_squared)
    return limit[0] * u / size, limit[1] * v / size
