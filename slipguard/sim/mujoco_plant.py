"""A held object in MuJoCo, behind the interface of `object_motion.advance`: physics that is not ours.

Two fingers press two soft pads on a free body that lies on a table. Each pad gives way on springs in torsion and in
both directions of shear, and touches with MuJoCo's elliptic cone, which is the ellipsoid limit surface: its torsional
coefficient is a length and is set to the friction torque per newton of a pad of the present size. The pads' viscous
friction is added to it. Gravity contains the acceleration of the fingers, so they stand still and the table sinks.

MuJoCo needs the elliptic cone, condim 4 and noslip iterations: without them a held object creeps.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np

from slipguard.errors import InputError
from slipguard.limit_surface import FINGER_COUNT, GRAVITY_M_S2, NO_CONTACT_N, pressure_shape
from slipguard.sim.friction import SoftPad
from slipguard.sim.object_motion import ExternalLoad, GraspedBody, ObjectMotion, table_reaction_n

SUBSTEPS = 4
TABLE_M = 0.022
"""Height of the grasp axis above the table."""
GONE_M = 5.0
"""A removed table lies this far below."""
OVERHANG_M = 0.015
"""The object ends this far behind the grasp axis."""
SHEAR_MAX_N_M = 3e4
"""Stiffer pads would need shorter steps."""
SLIPS_RAD_S, SLIPS_M_S = 0.01, 1e-3
MODEL = """
<mujoco>
  <option timestep="0.001" cone="elliptic" impratio="10" noslip_iterations="10" integrator="implicitfast"
          iterations="50" tolerance="1e-10"/>
  <default><geom condim="4" solref="0.004 1" solimp="0.95 0.99 0.001"/></default>
  <worldbody>
    <body name="table" mocap="true" pos="0 0 {table}">
      <geom name="table" type="plane" size="2 2 .1" condim="1" contype="2" conaffinity="2" solref="0.02 1"/></body>
    {fingers}
    <body name="object" simple="false"><freejoint/>
      <inertial pos="{x} 0 {z}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      <geom type="box" size="0.1 0.0099 0.012" contype="1" conaffinity="1"/>
      <geom name="foot" type="box" pos="{middle} 0 {foot}" size="{half} 0.02 0.002" contype="2" conaffinity="2"/></body>
  </worldbody>
  <actuator><motor joint="left"/><motor joint="right"/></actuator>
</mujoco>
"""
FINGER = """
    <body pos="0 {y} 0" gravcomp="1"><joint name="{name}" type="slide" axis="0 {inwards} 0" damping="20"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
      <body gravcomp="1">
        <joint name="{name} x" type="slide" axis="1 0 0" stiffness="1"/>
        <joint name="{name} z" type="slide" axis="0 0 1" stiffness="1"/>
        <joint name="{name} twist" type="hinge" axis="0 1 0" stiffness="1" armature="1e-4"/>
        <geom name="{name} pad" type="sphere" size="0.01" mass="0.05" contype="1" conaffinity="1" priority="1"/>
      </body></body>"""
SIDES = {"left": -1.0, "right": 1.0}


class MujocoPlant:
    """One held object. A motion that it did not return itself starts a new grasp.

    Raises:
        InputError: MuJoCo is not installed.
    """

    def __init__(self) -> None:
        try:
            self._mujoco: Any = importlib.import_module("mujoco")
        except ImportError as error:
            raise InputError("--plant mujoco needs MuJoCo. Install it with: pip install 'slipguard[mujoco]'") from error
        self._last: ObjectMotion | None = None
        self._body: GraspedBody | None = None

    def __call__(
        self, motion: ObjectMotion, body: GraspedBody, gel: SoftPad, load: ExternalLoad, step_s: float
    ) -> ObjectMotion:
        """Return the motion one step later, as `object_motion.advance`."""
        if motion is not self._last:
            self._build(body, step_s)
        if body != self._body:
            self._weigh(body)
        model, data = self._model, self._data
        model.opt.gravity[2] = -(GRAVITY_M_S2 + load.acceleration_m_s2)
        data.mocap_pos[0, 2] = -(TABLE_M + load.rise_m if load.rise_m is not None else GONE_M)
        data.ctrl[:] = load.force_n if load.force_n > NO_CONTACT_N else -1.0
        self._press(body, gel, load.force_n)
        theta = body.lever_rad + motion.rotation_rad
        drag_x, drag_z, drag_torque = self._drag(body, gel, load.force_n, step_s)
        data.xfrc_applied[self._object, 0] = drag_x
        data.xfrc_applied[self._object, 2] = drag_z - load.push_n
        data.xfrc_applied[self._object, 4] = drag_torque + load.push_n_m - load.push_n * body.lever_m * math.cos(theta)
        self._creep(gel, step_s)
        self._mujoco.mj_step(model, data, SUBSTEPS)
        self._last = self._motion(body, load)
        return self._last

    def _build(self, body: GraspedBody, step_s: float) -> None:
        half_m = 0.5 * (OVERHANG_M + max(2.0 * body.lever_m, OVERHANG_M))
        text = MODEL.format(
            fingers="".join(FINGER.format(name=name, y=side * 0.02, inwards=-side) for name, side in SIDES.items()),
            table=-TABLE_M, x=0, z=0, mass=body.mass_kg, inertia=1e-3, middle=half_m - OVERHANG_M, half=half_m,
            foot=0.002 - TABLE_M,
        )  # fmt: skip
        mujoco = self._mujoco
        model = self._model = mujoco.MjModel.from_xml_string(text)
        model.opt.timestep = step_s / SUBSTEPS
        self._data = mujoco.MjData(model)
        named = mujoco.mj_name2id

        def joint(name: str) -> int:
            return int(named(model, mujoco.mjtObj.mjOBJ_JOINT, name))

        self._object = int(named(model, mujoco.mjtObj.mjOBJ_BODY, "object"))
        self._table = int(named(model, mujoco.mjtObj.mjOBJ_GEOM, "table"))
        self._pads = [int(named(model, mujoco.mjtObj.mjOBJ_GEOM, f"{name} pad")) for name in SIDES]
        springs = [joint(f"{name} {what}") for name in SIDES for what in ("twist", "x", "z")]
        self._springs = np.array(springs)
        self._positions = model.jnt_qposadr[self._springs]
        self._speeds = model.jnt_dofadr[self._springs]
        self._free = int(model.jnt_qposadr[-1])
        self._free_speed = int(model.jnt_dofadr[-1])
        self._set = np.zeros(6)
        """Where the springs are at rest: moves as a gel that is pressed firmer gets stiffer without springing back."""
        self._crept = np.zeros(6)
        self._stiffness = np.ones(6)
        self._weigh(body)

    def _weigh(self, body: GraspedBody) -> None:
        model, index = self._model, self._object
        own = body.inertia_kg_m2 - body.mass_kg * body.lever_m**2
        model.body_mass[index], model.body_inertia[index] = body.mass_kg, own
        model.body_ipos[index] = (
            body.lever_m * math.cos(body.lever_rad), 0.0, -body.lever_m * math.sin(body.lever_rad),
        )  # fmt: skip
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))
        self._body = body

    def _press(self, body: GraspedBody, gel: SoftPad, force_n: float) -> None:
        """Set friction and stiffness of both pads for this force."""
        model = self._model
        length_m = 2.0 * pressure_shape(gel.pressure_k) * gel.contact_radius_m(force_n)
        for pad, sign in zip(self._pads, (1.0, -1.0), strict=True):
            friction = body.friction * (1.0 + sign * body.friction_difference)
            model.geom_friction[pad] = (friction, friction * length_m, 0.0)
        torsion, shear = gel.stiffness(max(force_n, 1.0))
        shear = min(shear, SHEAR_MAX_N_M)
        stiffness = np.array((torsion, shear, shear) * 2)
        if not np.array_equal(stiffness, self._stiffness):
            at = self._data.qpos[self._positions]
            rest = self._set + self._crept
            self._set = at - self._stiffness * (at - rest) / stiffness - self._crept
            self._stiffness = stiffness
            model.jnt_stiffness[self._springs] = stiffness
            model.dof_damping[self._speeds] = stiffness * gel.relaxation_s
            model.qpos_spring[self._positions] = self._set + self._crept

    def _creep(self, gel: SoftPad, step_s: float) -> None:
        """Let the springs' rest follow the load, up to the gel's creep (a Kelvin element in series)."""
        if gel.creep == 0.0:
            return
        stretch = self._data.qpos[self._positions] - self._set - self._crept
        self._crept += min(step_s / gel.creep_s, 1.0) * (gel.creep * stretch - self._crept)
        self._model.qpos_spring[self._positions] = self._set + self._crept

    def _drag(self, body: GraspedBody, gel: SoftPad, force_n: float, step_s: float) -> tuple[float, float, float]:
        """Return the pads' viscous friction on a slipping object: forces to the side and up, and torque.

        MuJoCo's friction is dry. Implicit in the speed, for the drag of a step may exceed a light object's momentum.
        """
        x_m_s, z_m_s, rate = self._slip_speeds()
        touch = FINGER_COUNT * min(force_n, 1.0)
        shear, torsion = touch * gel.viscous_n_s_m, touch * gel.viscous_n_m_s
        linear = shear / (1.0 + step_s * shear / body.mass_kg)
        return -linear * x_m_s, -linear * z_m_s, -torsion / (1.0 + step_s * torsion / body.inertia_kg_m2) * rate

    def _slip_speeds(self) -> tuple[float, float, float]:
        """Return the object's speed relative to the pads: to the side, up, and rotation rate."""
        speed, data = self._free_speed, self._data
        vx_m_s, _, vz_m_s, _, rate, _ = (float(v) for v in data.qvel[speed : speed + 6])
        pad_rate, pad_vx, pad_vz = (float(v) for v in data.qvel[self._speeds].reshape(2, 3).mean(axis=0))
        return vx_m_s - pad_vx, vz_m_s - pad_vz, rate - pad_rate

    def _motion(self, body: GraspedBody, load: ExternalLoad) -> ObjectMotion:
        data, free, speed = self._data, self._free, self._free_speed
        x_m, _, z_m, w, _, qy, _ = (float(v) for v in data.qpos[free : free + 7])
        _, _, vz_m_s, _, rate, _ = (float(v) for v in data.qvel[speed : speed + 6])
        twist, _, pad_z = (float(v) for v in data.qpos[self._positions].reshape(2, 3).mean(axis=0))
        slip_x, slip_z, slip_rate = self._slip_speeds()
        rotation = 2.0 * math.atan2(qy, w)
        moved = ObjectMotion(rotation_rad=rotation, rate_rad_s=rate, slip_m=-z_m, slip_m_s=-vz_m_s)
        stretch = self._stiffness * (data.qpos[self._positions] - self._set - self._crept)
        torques, _, shears = (float(v) for v in stretch.reshape(2, 3).sum(axis=0))
        weight_n = body.mass_kg * (GRAVITY_M_S2 + load.acceleration_m_s2) + load.push_n
        return ObjectMotion(
            rotation_rad=rotation,
            rate_rad_s=rate,
            twist_rad=twist,
            twist_n_m=torques,
            slip_m=-z_m,
            slip_m_s=-vz_m_s,
            shear_m=-pad_z,
            shear_n=-shears,
            load_n=weight_n - self._table_n(),
            on_table=table_reaction_n(moved, body, load)[2],
            slipping=abs(slip_rate) > SLIPS_RAD_S or math.hypot(slip_x, slip_z) > SLIPS_M_S,
            side_m=x_m,
        )

    def _table_n(self) -> float:
        """Return the force of the table on the object."""
        data = self._data
        if data.ncon == 0:
            return 0.0
        of_table = (data.contact.geom == self._table).any(axis=1)
        rows = data.contact.efc_address[of_table]
        return float(data.efc_force[rows[rows >= 0]].sum())
