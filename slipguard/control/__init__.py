"""From what both fingers saw to how hard to hold: pure functions on values.

`control_step(state, observation, params)` returns the next state and what to command now. It knows no clock and no
device, so it can be used without the daemon. An object is gripped, and then slips while the arm rests:

>>> from slipguard.control import ControlState, GuardParams, control_step
>>> from slipguard.control.finger_fusion import FusedEstimate
>>> from slipguard.control.messages import ControlRequest, Observation, RequestKind
>>> from slipguard.devices import GripperState
>>> def seen(now_s, rotation_deg, force_n, request=ControlRequest()):
...     estimate = FusedEstimate(
...         left_contact=True, right_contact=True, captured_at_s=now_s, measured_at_s=now_s, newest_at_s=now_s,
...         fingers=("left", "right"), rotation_deg=rotation_deg, sigma_deg=0.1, rate_deg_s=0.0,
...     )
...     gripper = GripperState(
...         active=True, moving=False, holding=force_n > 0, closed_on_nothing=False, width_mm=28.0, force_n=force_n,
...         fault=None, measured_at_s=now_s,
...     )
...     return Observation(now_s, estimate, gripper=gripper, request=request)
>>> params = GuardParams(mode="guard", margin=1.3)
>>> state, output = control_step(ControlState(), seen(0.0, None, 0.0, ControlRequest(RequestKind.GRASP)), params)
>>> output.gripper
HoldForce(force_n=40.23..., kind='hold')
>>> for tick in range(1, 60):
...     state, output = control_step(state, seen(0.02 * tick, 0.0, 40.3), params)
>>> state.grasp.phase
<Phase.HOLDING: 'holding'>
>>> for tick in range(60, 64):
...     state, output = control_step(state, seen(0.02 * tick, 2.0 * (tick - 59), 40.3), params)
...     if output.gripper: print(output.text)
the load is 1... of what the grip holds (rotated 2.0° at ...°/s, moved 0.0 mm): tightening from 40 N to ... N
"""

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.params import GuardParams

__all__ = ["ControlState", "GuardParams", "control_step"]
