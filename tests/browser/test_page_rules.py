"""The page blocks commands that the controller would refuse, and never one that it would grant."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import pytest
from page_rig import DaemonProcess

from slipguard.control.messages import ControlRequest, Observation, RequestKind, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.requests import handle_request
from slipguard.control.state import Adoption, ArmMotion, GraspState, Grip, HeldObject, PersonNear, Phase, SlipEpisode
from slipguard.devices import ArmState, GripperState

pytestmark = [pytest.mark.browser, pytest.mark.asyncio(loop_scope="session")]
NOW_S = 10.0
KINDS = {
    "grasp": RequestKind.GRASP, "lift": RequestKind.LIFT, "lower": RequestKind.LOWER, "clear": RequestKind.CLEAR,
}  # fmt: skip
ASK = """async (cases) => {
  const { isGuarding, blockedReason } = await import("/page/permissions.js");
  const names = ["grasp", "lift", "lower", "clear", "guard", "release"];
  return cases.map((state) => {
    const view = { live: true, control: true, state };
    return [isGuarding(state), Object.fromEntries(names.map((name) => [name, blockedReason(name, view)]))];
  });
}"""


def grippers() -> list[GripperState | None]:
    """Disconnected, open, holding, moving."""
    open_ = GripperState(True, False, False, False, 85.0, 0.0, None, NOW_S)
    held = replace(open_, holding=True, width_mm=18.0, force_n=40.0)
    return [None, open_, held, replace(open_, moving=True)]


def arms() -> list[ArmState | None]:
    """Disconnected, at rest, in each kind of stop."""
    rest = ArmState(50.0, 0.0, False, False, False, NOW_S)
    return [None, rest, replace(rest, protective_stop=True), replace(rest, emergency_stop=True)]


def cases() -> list[tuple[GraspState, Observation, GuardParams]]:
    """Return every phase in combination with modes, gripper and arm states."""
    fault, slip = Fault(FaultCode.ARM_SILENT, "seen", "do"), SlipEpisode(9.0, 9.5)
    made = []
    for phase, mode, guarding, slips, gripper, arm in product(
        Phase, ("lift", "guard"), (True, False), (None, slip), grippers(), arms()
    ):
        near = arm is not None and (arm.protective_stop or arm.emergency_stop)
        state = GraspState(
            phase, 5.0, guarding, Grip(commanded_s=5.0), HeldObject(slip=slips), ArmMotion(ground_mm=0.0),
            person=PersonNear(near), adoption=Adoption(done=True), fault=fault if phase is Phase.FAULT else None,
        )  # fmt: skip
        made.append((state, Observation(NOW_S, gripper=gripper, arm=arm), GuardParams(mode=mode)))
    return made


def page_state(state: GraspState, observation: Observation, params: GuardParams) -> dict[str, Any]:
    """Return the state that the page receives."""
    devices = {"left": object(), "right": object(), "gripper": observation.gripper, "arm": observation.arm}
    gone = [name for name, one in devices.items() if one is None]
    return {
        "phase": state.phase.value, "mode": params.mode, "guarding": state.guarding,
        "slipping": state.held.slip is not None, "putting_down": state.arm.putting_down,
        "waiting_for": [f"{name}: gone" for name in gone],
        "gripper": observation.gripper
        and {name: getattr(observation.gripper, name) for name in GripperState.__slots__},
        "has_arm": True,
        "arm": observation.arm and {name: getattr(observation.arm, name) for name in ArmState.__slots__},
    }  # fmt: skip


def granted(state: GraspState, observation: Observation, params: GuardParams, kind: RequestKind) -> bool:
    return (
        handle_request(state, StepOutput(), replace(observation, request=ControlRequest(kind)), params)[1].refusal
        is None
    )


async def test_the_page_allows_every_command_that_the_controller_grants(running: DaemonProcess, open_page) -> None:  # type: ignore[no-untyped-def]
    page = await open_page(control=False)
    every = cases()
    spared = 0
    for case, (guards, forbidden) in zip(
        every, await page.evaluate(ASK, [page_state(*case) for case in every]), strict=True
    ):
        kinds = {**KINDS, "guard": RequestKind.GUARD_OFF if guards else RequestKind.GUARD_ON}
        assert forbidden["release"] is None, "letting go is possible in every state"
        for name, kind in kinds.items():
            grants = granted(*case, kind)
            # The daemon refuses to grasp before the controller does.
            ready = name != "grasp" or not page_state(*case)["waiting_for"]
            assert not (grants and ready and forbidden[name]), f"{name} is forbidden ({forbidden[name]}): {case}"
            spared += not grants and forbidden[name] is not None
    assert spared > len(every), "most refusals are foreseen"
