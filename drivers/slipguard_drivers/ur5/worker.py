"""ur-rtde in a process of its own: `python -m slipguard_drivers.ur5.worker SOCKET_FD HOST WATCHDOG_HZ`.

Why not in the daemon: its constructors hold the interpreter for as long as a silent controller likes, a synchronous
move waits up to 300 s, and one dropped connection can crash the process. Here that ends this process only, and the
robot's own watchdog, armed before anything moves, stops the arm when the `beat` requests cease.

One thread makes all calls (a second one overwrites the command register), and moves are asynchronous only. Packets
are JSON: `[name, arguments...]` in, `{"ok": ...}` or `{"refused": reason}` or `{"lost": reason}` out.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

import rtde_control
import rtde_receive

from slipguard_drivers.child import PACKET_BYTES

VARIABLES = ["timestamp", "actual_TCP_pose", "actual_TCP_speed", "runtime_state", "safety_status_bits"]
SCRIPT_START_S = 5.0
POLL_S = 0.005
PROTECTIVE = 1 << 2 | 1 << 4
"""Protective stop, safeguard stop."""
EMERGENCY = 1 << 5 | 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9
"""System, robot and emergency stop, safety violation, safety fault."""


class Lost(Exception):
    """The controller is gone or runs our script no more: this process is of no use any longer."""


class Refused(Exception):
    """The robot is in no state to do that."""


class Robot:
    """The calls the arm driver needs, on both interfaces of ur-rtde."""

    def __init__(self, host: str, watchdog_hz: float) -> None:
        self._receive = rtde_receive.RTDEReceiveInterface(host, -1.0, VARIABLES)
        self._control = rtde_control.RTDEControlInterface(host)
        deadline_s = time.monotonic() + SCRIPT_START_S
        while not self._control.isProgramRunning():
            if time.monotonic() > deadline_s:
                raise Lost("the control script does not start; is the robot in remote control and its program stopped?")
            self._pause()
        if not self._control.setWatchdog(watchdog_hz):
            raise Lost("the robot's watchdog cannot be armed")

    def beat(self) -> dict[str, Any]:
        """Feed the watchdog and tell the newest state."""
        # A connection that dropped must end this process before ur-rtde reconnects and starts the script by itself.
        if not (self._receive.isConnected() and self._control.isConnected()):
            raise Lost("the connection to the controller dropped")
        running = bool(self._control.isProgramRunning())
        if running:
            self._control.kickWatchdog()
        bits = int(self._receive.getSafetyStatusBits())
        return {
            "timestamp_s": self._receive.getTimestamp(),
            "height_m": self._receive.getActualTCPPose()[2],
            "speed_m_s": self._receive.getActualTCPSpeed()[2],
            "travelling": running and self._travels(),
            "running": running,
            "protective": bool(bits & PROTECTIVE),
            "emergency": bool(bits & EMERGENCY),
        }

    def lift(self, height_m: float, speed_m_s: float, acceleration_m_s2: float) -> bool:
        """Start a straight move along the base's z axis from where the tool is."""
        if not self._control.isProgramRunning():
            raise Lost("the control script is not running")
        if self._travels():
            self._control.stopL(acceleration_m_s2, False)
        pose = self._receive.getActualTCPPose()
        pose[2] += height_m
        if not self._control.moveL(pose, speed_m_s, acceleration_m_s2, True):
            raise Refused("the controller did not accept the move")
        return True

    def stop(self, deceleration_m_s2: float) -> bool:
        """End a move under way. A script that is not running moves nothing."""
        if self._control.isProgramRunning() and self._travels():
            self._control.stopL(deceleration_m_s2, False)
        return True

    def leave(self) -> bool:
        """End the control script, so that the robot is free for others."""
        self._control.stopScript()
        return True

    def _travels(self) -> bool:
        return bool(self._control.getAsyncOperationProgressEx().isAsyncOperationRunning())

    @staticmethod
    def _pause() -> None:
        """Give the script time to start; nobody else runs in this process."""
        signal.sigtimedwait([], POLL_S)


def answer(robot: Robot, packet: bytes) -> dict[str, Any]:
    """Do what one packet asks."""
    name, *arguments = json.loads(packet)
    calls: dict[str, Callable[..., Any]] = {
        "beat": robot.beat,
        "lift": robot.lift,
        "stop": robot.stop,
        "leave": robot.leave,
    }
    try:
        return {"ok": calls[name](*arguments)}
    except Refused as error:
        return {"refused": str(error)}
    except Lost as error:
        return {"lost": str(error)}
    except Exception as error:
        return {"lost": f"{type(error).__name__}: {error}"}


def main() -> None:
    """Connect, report, and serve until the other end closes; then stop the arm."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    fd, host, watchdog_hz, deceleration = sys.argv[1:5]
    with socket.socket(fileno=int(fd)) as link:
        try:
            robot = Robot(host, float(watchdog_hz))
        except Exception as error:
            link.send(json.dumps({"lost": str(error)}).encode())
            return
        link.send(json.dumps({"ok": True}).encode())
        while packet := link.recv(PACKET_BYTES):
            link.send(json.dumps(answer(robot, packet)).encode())
        robot.stop(float(deceleration))
        robot.leave()


if __name__ == "__main__":
    main()
