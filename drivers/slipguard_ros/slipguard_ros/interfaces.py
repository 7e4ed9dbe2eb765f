"""Names and types of the node's services, and `slipguard_call`, which calls one where `ros2` is not installed."""

from __future__ import annotations

import sys
from typing import Any

import rclpy
from std_srvs.srv import SetBool, Trigger

try:
    import slipguard_ros_interfaces.action as typed_actions
    import slipguard_ros_interfaces.msg as typed_messages
    from slipguard_ros_interfaces.srv import Activate, Grasp, Lift

    TYPED = True
except ImportError:
    TYPED = False
WITHOUT_TYPES = (
    "slipguard_ros_interfaces is not installed (build it with colcon or build_for_pip): ~/state is JSON; ~/grasp, "
    "~/lift and ~/lower use the configured values; no ~/slip, ~/activate_gripper, ~/grasp_object, ~/lift_object"
)
SERVICES: dict[str, Any] = {
    "stop": Trigger,
    "release": Trigger,
    "clear": Trigger,
    "calibrate": Trigger,
    "guard": SetBool,
    "grasp": Grasp if TYPED else Trigger,
    "lift": Lift if TYPED else Trigger,
    "lower": Lift if TYPED else Trigger,
}
if TYPED:
    SERVICES["activate_gripper"] = Activate
CALL_TIMEOUT_S = 40.0


def request_of(kind: Any, pairs: list[str]) -> Any:
    """Return a request of a service's type from words such as `force:=40`. Raises ValueError."""
    request = kind.Request()
    fields = request.get_fields_and_field_types()
    for pair in pairs:
        name, _, text = pair.partition(":=")
        if name not in fields:
            raise ValueError(f"{pair}: give FIELD:=VALUE with one of: {', '.join(fields) or '(no fields)'}")
        if fields[name] == "boolean" and text not in ("true", "false"):
            raise ValueError(f"{pair}: the value must be true or false")
        setattr(request, name, text == "true" if fields[name] == "boolean" else float(text))
    return request


def main() -> int:
    """Call the service of the command line; return the exit status."""
    words = sys.argv[1:]
    if not words or words[0] not in SERVICES:
        print(f"usage: slipguard_call SERVICE [FIELD:=VALUE ...]; services: {', '.join(SERVICES)}", file=sys.stderr)
        return 2
    try:
        request = request_of(SERVICES[words[0]], words[1:])
    except ValueError as wrong:
        print(f"slipguard_call: {wrong}", file=sys.stderr)
        return 2
    rclpy.init()
    node = rclpy.create_node("slipguard_call")
    response = call(node, words[0], request)
    rclpy.try_shutdown()
    if response is None:
        print(f"slipguard_call: no node offers /slipguard/{words[0]}; start slipguard_node", file=sys.stderr)
        return 1
    print(response.message)
    return 0 if response.success else 1


def call(node: Any, service: str, request: Any = None) -> Any:
    """Call a service of the node and return its response; None if it is not offered. Spins `node`."""
    kind = SERVICES[service]
    client = node.create_client(kind, f"/slipguard/{service}")
    try:
        if not client.wait_for_service(10.0):
            return None
        future = client.call_async(request or kind.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=CALL_TIMEOUT_S)
        return future.result()
    finally:
        node.destroy_client(client)


__all__ = ["SERVICES", "TYPED", "WITHOUT_TYPES", "call", "typed_actions", "typed_messages"]

if __name__ == "__main__":
    sys.exit(main())
