"""Estimate the grip force that a load needs, from the elastic torsion of the gel and from the onset of slip.

Each of two equal fingers presses with a force N on a round patch of radius a(N) ~ N^gamma (Xydas and Kao). mu is the
friction coefficient, and xi nu the factor of the pressure profile (`pressure_shape` in limit_surface.py). Before they
slip, both fingers together hold, on the limit surface (Howe and Cutkosky), a torque or a force of at most

    T(N) = 4 mu xi nu a(N) N ~ N^(1 + gamma)             torque about the grasp axis (Costanzo et al.)
    F(N) = 2 mu N                                        force, for a load without lever

A torque tau below T twists them elastically by theta = tau / (2 k). k = 16/3 G a^3 is the torsional stiffness of one
gel with the shear modulus G (Johnson, 3.10), so k = k6 (a / 6 mm)^3. r is the load over what the grip holds, tau / T.
From that follow five estimates:

1. The onset of slip. At the first slip under a known force N1 the torque is T(N1), and goes on growing to r T(N1).
2. Free slip. The excess rotates the object: I alpha = tau - T. A bar held at its end has the mass m, the center of
   mass at b, and I = 4/3 m b^2, so without friction alpha would be 3 g / (4 b). Hence r = 1 / (1 - alpha 4 b / (3 g)),
   where alpha = rate^2 / (2 theta) is measured. A slide is the same with g alone. Without a known lever, b = 60 mm. r
   is at least `ratio_least`, as rates lag, and at most RATIO_MAX, for a gel that swings elastically rotates as fast at
   first.
3. Slip while the object leaves the table. Its far end leads it: the rate is the arm's, not the load's, and no image
   shows r. So the load is searched: each step is r = `search`, which ends within a factor of 1 to `search` above
   the needed force, in the geometric mean its square root. The arm stands meanwhile, and the load does not grow.
4. Elastic motion. Before anything slips, a gel twists by up to theta_on = T(N) / (2 k), and gives way in shear by up to
   s_on = mu N a^2 / k (Johnson, 3.7: shear and torsion of an incompressible half-space differ by a^2). Up to these, no
   motion is slip. k6 is a log-normal estimate, and so is mu; the likeliest theta_on is its mode, the median times
   exp(-spread^2), and at most UNKNOWN_MAX before the first grasp. Each object that was lifted and hangs at rest has
   used a share of theta_on and s_on, which narrows k6: an object without a lever shears the gel and does not twist it.
   What it moved until the last step may have been slip, and what it moved since then has not been; the geometric mean
   of both counts. The torsion at the first slip narrows the friction as far as k6 is known: ln theta_on = ln mu - ln
   k6 + ln(...), a Kalman update. Both gels twist with the one object, so k6 is the mean of both; it is kept by the
   sensors' serial numbers.
5. A load that grows at rest. The share of the elastic motion that is used grows with it (elastic_share.py). Once that
   exceeds 1 within the delay of the loop, the grip is raised by that share, before anything slips.

The force for a torque of r T(N1) is N1 r^(1 / (1 + gamma)), for a slide N1 r: friction and patch cancel. `margin` is
added where r was measured. With `friction` and `mass_kg` given, the force of the limit surface counts, too.

Its a(N) is that of the contact that the cameras show. Of all patches of one area a disk holds the least torque, for
the mean distance from its middle is the least (Hardy, Littlewood and Polya, rearrangement). So a contact counts
as the disk of its area, and as no more than what the image shows of it. The slopes around it show as well: of 117
rendered presses (39 objects, three depths), nine in ten hold the torque of a disk of at least SEEN_SHARE times the
radius seen. Before it is seen, the contact counts as a large one, for a grip can be made firmer, but not looser; it is
made firmer before the lift. Elastic motion does not depend on the contact seen: k6 is learned for the patch of `PAD`.

Sources:
    M. Costanzo, G. De Maria, C. Natale: Two-fingered in-hand object handling based on force/tactile feedback. IEEE
        Transactions on Robotics 36 (2020); their code: slipping_control.
    G. H. Hardy, J. E. Littlewood, G. Polya: Inequalities (1934), chapter 10.
    R. D. Howe, M. R. Cutkosky: Practical force-motion models for sliding manipulation. International Journal of
        Robotics Research 15 (1996).
    K. L. Johnson: Contact Mechanics (1985), sections 3.7 and 3.10.
    N. Xydas, I. Kao: Modeling of contact mechanics and friction limit surfaces for soft fingers in robotics.
        International Journal of Robotics Research 18 (1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.limit_surface import FINGER_COUNT, GRAVITY_M_S2, Pad, torque_limit_n_m

PAD = Pad()
SEEN_SHARE = 0.75
UNSEEN_MM = 2.5
"""Radius of a contact that no camera shows: of the smallest that is measured well."""
RATIO_MAX = 2.5
LEVER_MM = 60.0
"""Where no lever is given."""
STIFFNESS_RADIUS_M = 6e-3
HELD_SHARE, HELD_SPREAD = 0.33, 0.7
"""A grip uses this share of its torque, and the spread of that (standard deviation of the logarithm)."""
STIFFNESS_SPREAD_LEAST = 0.3
"""However many grasps it was learned from: gels wear, and grips differ in how much of their torque they use."""
ELASTIC_MAX_DEG, ELASTIC_MAX_MM = 15.0, 3.0
"""No gel is trusted to move further without slip,"""
UNKNOWN_MAX_DEG, UNKNOWN_MAX_MM = 2.0, 0.4
"""... and none that no grasp has shown yet to move further than this."""
ONSET_SPREAD = 0.5
"""Spread of the torsion at the first slip: part of it may have been slip already."""
TORSION_LEAST_DEG = 0.1
"""A smaller torsion is the estimate's noise: the gel is at least as stiff as this says, and so little is expected."""


@dataclass(frozen=True, slots=True)
class LogNormal:
    """An estimated quantity: its median, and the standard deviation of its logarithm."""

    median: float
    spread: float

    @property
    def sigma(self) -> float:
        """One standard deviation, about."""
        return self.median * self.spread

    def moved(self, log_difference: float, total: float) -> LogNormal:
        """Return the estimate after a measurement that differs by this in the logarithm, with this variance in all."""
        gain = self.spread**2 / total
        return LogNormal(self.median * math.exp(gain * log_difference), self.spread * math.sqrt(1.0 - gain))


@dataclass(frozen=True, slots=True)
class ElasticMotion:
    """How far an object moves in a grip without slip: torsion in degrees, shear in mm."""

    deg: float = 0.0
    mm: float = 0.0


STIFFNESS_PRIOR = LogNormal(0.16, 0.8)
"""Torsional stiffness of one gel at 6 mm, N m/rad: that of 0.14 MPa, as a DIGIT has; 50 for a stiff pad."""
FRICTION_PRIOR = LogNormal(0.6, 0.35)
FRICTION_GIVEN_SPREAD = 0.1


@dataclass(frozen=True, slots=True)
class ForceSteps:
    """How far a step of the force goes: ratios of the load to that at which the grip slips.

    search: of each step while the load arrives. ratio_least: least measured ratio, because rates lag and a second step
    costs one more delay of the loop. margin: over the measured ratio.
    """

    search: float
    ratio_least: float
    margin: float


QUICK = ForceSteps(1.5, 1.4, 1.15)
GENTLE = ForceSteps(1.2, 1.15, 1.05)
"""For fragile objects: less force, more slip."""


@dataclass(frozen=True, slots=True)
class NeededForce:
    """The force that a slipping load needs, and why.

    Args:
        load: torque in N m, or force in N if `slides`, of both fingers. friction: between object and gel.
        force_n: per finger.
    """

    load: float
    friction: LogNormal
    force_n: float
    slides: bool = False

    @property
    def reason(self) -> str:
        """The estimate in words, with values."""
        load = f"{self.load:.1f} N" if self.slides else f"{self.load:.2f} N·m"
        return f"load {load}, friction {self.friction.median:.2f} ± {self.friction.sigma:.2f}"


def friction_of(given: float | None) -> LogNormal:
    """Return what is known of the friction before anything slips."""
    return FRICTION_PRIOR if given is None else LogNormal(given, FRICTION_GIVEN_SPREAD)


def seen_pad(radius_mm: float | None, force_n: float) -> Pad:
    """Return the pad whose patch the cameras show at this force. radius_mm: None if they show none."""
    radius_m = 1e-3 * (UNSEEN_MM if radius_mm is None else SEEN_SHARE * radius_mm)
    return replace(PAD, radius_m=radius_m / max(force_n, 1.0) ** PAD.gamma)


def torque_n_m(force_n: float, friction: float, pad: Pad = PAD) -> float:
    """Return the torque that both fingers hold."""
    return FINGER_COUNT * torque_limit_n_m(force_n, friction, pad)


def onset(force_n: float, friction: float, stiffness_n_m_rad: float) -> ElasticMotion:
    """Return the elastic motion at which a grip begins to slip: by a torque alone, and by a force alone."""
    radius_m = PAD.contact_radius_m(force_n)
    if radius_m <= 0.0:
        return ElasticMotion()
    gel_n_m_rad = stiffness_n_m_rad * (radius_m / STIFFNESS_RADIUS_M) ** 3
    deg = math.degrees(torque_n_m(force_n, friction) / (FINGER_COUNT * gel_n_m_rad))
    return ElasticMotion(deg, 1e3 * friction * force_n * radius_m**2 / gel_n_m_rad)


def elastic_limit(force_n: float, friction: LogNormal, stiffness: LogNormal) -> ElasticMotion:
    """Return the likeliest elastic motion at which this grip begins to slip: near 0 while the stiffness is unknown."""
    median = onset(force_n, friction.median, stiffness.median)
    mode = math.exp(-(friction.spread**2) - stiffness.spread**2)
    known = stiffness.spread < STIFFNESS_PRIOR.spread
    most_deg, most_mm = (ELASTIC_MAX_DEG, ELASTIC_MAX_MM) if known else (UNKNOWN_MAX_DEG, UNKNOWN_MAX_MM)
    return ElasticMotion(min(mode * median.deg, most_deg), min(mode * median.mm, most_mm))


def after_slip(force_n: float, torsion_deg: float, friction: LogNormal, stiffness: LogNormal) -> LogNormal:
    """Return the friction after the first slip, with the torsion up to which nothing had slipped."""
    expected_deg = onset(force_n, friction.median, stiffness.median).deg
    total = friction.spread**2 + stiffness.spread**2 + ONSET_SPREAD**2
    return friction.moved(_log_ratio(torsion_deg, expected_deg), total)


def after_lift(
    since_grip: tuple[float, ElasticMotion],
    since_step: tuple[float, ElasticMotion],
    friction: LogNormal,
    stiffness: LogNormal,
) -> LogNormal:
    """Return the stiffness after an object has been lifted and hangs at rest.

    Args:
        since_grip, since_step: force at the beginning, and motion since then.
    """

    def softer(force_n: float, moved: ElasticMotion) -> float:
        first = onset(force_n, friction.median, stiffness.median)
        shear_deg = moved.mm * first.deg / first.mm if first.mm > 0.0 else 0.0
        return _log_ratio(math.hypot(moved.deg, shear_deg), HELD_SHARE * first.deg)

    most, least = softer(*since_grip), softer(*since_step)
    total = friction.spread**2 + stiffness.spread**2 + HELD_SPREAD**2 + (0.5 * (most - least)) ** 2
    learned = stiffness.moved(-0.5 * (most + least), total)
    return LogNormal(learned.median, max(learned.spread, STIFFNESS_SPREAD_LEAST))


def load_ratio(
    rotation_deg: float, rate_deg_s: float, slip_mm: float, rate_mm_s: float, lever_mm: float, ratio_least: float
) -> float:
    """Return how many times the load exceeds what the grip holds, from its motion: ratio_least to RATIO_MAX.

    Args:
        rotation_deg, rate_deg_s: free rotation. slip_mm, rate_mm_s: free slide. lever_mm: 0 if unknown.
    """
    free_rad_s2 = 0.75 * GRAVITY_M_S2 / (1e-3 * (lever_mm or LEVER_MM))
    shares = (
        math.radians(max(rate_deg_s, 0.0) ** 2 / (2.0 * rotation_deg)) / free_rad_s2 if rotation_deg > 0.0 else 0.0,
        1e-3 * max(rate_mm_s, 0.0) ** 2 / (2.0 * slip_mm) / GRAVITY_M_S2 if slip_mm > 0.0 else 0.0,
    )
    return max(1.0 / max(1.0 - max(shares), 1.0 / RATIO_MAX), ratio_least)


def needed_force(
    present_n: float,
    ratio: float,
    *,
    slides: bool,
    friction: LogNormal,
    modelled_n: float | None,
    pad: Pad = PAD,
) -> NeededForce:
    """Return the force for `ratio` times the load at which this grip slips.

    Args:
        present_n: per finger, above 0.
        ratio: margin included. slides: without rotation.
        modelled_n: what given friction, mass and lever require; None if they are not given.
        pad: as seen.
    """
    holds = FINGER_COUNT * friction.median * present_n if slides else torque_n_m(present_n, friction.median, pad)
    force_n = present_n * ratio ** (1.0 if slides else 1.0 / (1.0 + pad.gamma))
    return NeededForce(holds * ratio, friction, max(force_n, modelled_n or 0.0), slides)


def _log_ratio(torsion_deg: float, expected_deg: float) -> float:
    """Return the logarithm of measured over expected torsion; a grip with almost no force expects none."""
    return math.log(max(torsion_deg, TORSION_LEAST_DEG) / max(expected_deg, TORSION_LEAST_DEG))
