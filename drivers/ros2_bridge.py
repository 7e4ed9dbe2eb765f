"""A ROS 2 node for slipguard: publish the state and each new fault as JSON, offer the requests as services.

It is a client of the local API and needs rclpy and the standard library only, so it runs with the Python of ROS:

    python3 ros2_bridge.py --ros-args -p socket:=/run/slipguard/slipguard.sock
    ros2 service call /slipguard/guard std_srvs/srv/SetBool "{data: true}"

The socket accepts root and the daemon's user. Anyone who can use the node's services can open the jaws.
"""

import http.client
import json
import socket

import rclpy
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger


class Bridge(Node):
    """Topics `~/state` (ten per second) and `~/fault`; services `~/guard`, `~/grasp`, `~/lift`, `~/lower`, ..."""

    def __init__(self):
        super().__init__("slipguard")
        self.socket_path = self.declare_parameter("socket", "/run/slipguard/slipguard.sock").value
        self.states = self.create_publisher(String, "~/state", 10)
        self.faults = self.create_publisher(String, "~/fault", 10)
        self.last_fault = None
        self.create_timer(0.1, self.publish)
        self.create_service(SetBool, "~/guard", lambda call, reply: self.submit(reply, "guard", on=call.data))
        for name in ("grasp", "lift", "lower", "clear"):
            self.create_service(Trigger, f"~/{name}", lambda call, reply, name=name: self.submit(reply, name))
        self.create_service(Trigger, "~/release", lambda call, reply: self.submit(reply, "release", confirm=True))

    def request(self, method, path, **body):
        """Return the API's JSON response; {"error": ...} if there is no daemon."""
        http_over_unix = http.client.HTTPConnection("slipguard", timeout=3.0)
        try:
            http_over_unix.sock = socket.socket(socket.AF_UNIX)
            http_over_unix.sock.settimeout(3.0)
            http_over_unix.sock.connect(self.socket_path)
            http_over_unix.request(method, path, json.dumps(body) if method == "POST" else None)
            return json.loads(http_over_unix.getresponse().read())
        except OSError as error:
            return {
                "error": f"no slipguard daemon at {self.socket_path}: {error}. Start it, or set the parameter socket."
            }
        finally:
            http_over_unix.close()

    def submit(self, reply, name, **body):
        """Send one request to the daemon and fill the service's reply."""
        response = self.request("POST", f"/{name}", **body)
        reply.success = "error" not in response
        reply.message = response.get("message") or response.get("error", "")
        return reply

    def publish(self):
        """Publish the state, and a fault when it changes."""
        state = self.request("GET", "/state")
        self.states.publish(String(data=json.dumps(state)))
        fault = state.get("error") or state.get("fault")
        if fault and fault != self.last_fault:
            self.faults.publish(String(data=json.dumps(fault)))
        self.last_fault = fault


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Bridge())
