"""ur-rtde in a process of its own: `python -m slipguard_drivers.ur5.motion_worker SOCKET_FD HOST`.

Why not in the daemon: its constructors hold the interpreter for as long as a silent controller likes, a synchronous
move waits up to 300 s, and one dropped connection can crash the process. Here that ends this process only, and the
robot's own watchdog, armed before anything moves, stops the arm when the `beat` requests cease.

One thread makes all calls (a second one overwrites the command register), and moves and stops are asynchronous: the
script carries out a synchronous `stopL` as `stopj`. Packets are JSON: `[name, arguments...]` in, `{"ok": ...}` or
`{"refused": reason}` or `{"lost": reason}` out. The first request is `connect`, any time after the start.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from typing import Any

from rtde_control import RTDEControlInterface

from slipguard_drivers.child_process import PACKET_BYTES

SCRIPT_START_S = 5.0
POLL_S = 0.005
LONGEST_CALL_S = 30
"""A call that lasts longer is ended by the kernel, and this process with it: ur-rtde can wait for a controller that is
gone for ever, hold the interpreter meanwhile, and take the robot's control when the controller is back. A daemon that
lives ends it sooner; this is for one that was killed.
"""


class ControllerLost(Exception):
    """The controller is gone or runs our script no more: this process is of no use any longer."""


class MotionRefused(Exception):
    """The robot is in no state to do that."""


class MotionControl:
    """The calls the arm driver needs. upper: use the registers from 24 on, those below belong to somebody else."""

    def __init__(self, host: str, watchdog_hz: float, deceleration_m_s2: float, upper: bool) -> None:
        flags = RTDEControlInterface.FLAGS_DEFAULT
        if upper:
            flags |= RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
        self._deceleration_m_s2 = deceleration_m_s2
        self._control = RTDEControlInterface(host, -1.0, flags)
        deadline_s = time.monotonic() + SCRIPT_START_S
        while not self._control.isProgramRunning():
            if time.monotonic() > deadline_s:
                raise ControllerLost("the control script does not start; see the message on the robot's panel")
            signal.sigtimedwait([], POLL_S)  # a pause; nobody else runs in this process
        if not self._control.setWatchdog(watchdog_hz):
            raise ControllerLost("the robot's watchdog cannot be armed")

    def beat(self) -> dict[str, Any]:
        """Feed the watchdog; tell whether the script runs and a motion is under way."""
        # A connection that dropped must end this process before ur-rtde reconnects and starts the script by itself.
        if not self._control.isConnected():
            raise ControllerLost("the connection to the controller dropped")
        running = bool(self._control.isProgramRunning())
        if running:
            self._control.kickWatchdog()
        travelling = running and bool(self._control.getAsyncOperationProgressEx().isAsyncOperationRunning())
        return {"running": running, "travelling": travelling}

    def move(self, pose: list[float], speed_m_s: float, acceleration_m_s2: float) -> bool:
        """Start a straight move to a pose; only while the arm rests."""
        if not self._control.isProgramRunning():
            raise ControllerLost("the control script is not running")
        if not self._control.moveL(pose, speed_m_s, acceleration_m_s2, True):
            raise MotionRefused("the controller did not accept the move")
        return True

    def stop(self) -> bool:
        """Begin to brake. A script that is not running moves nothing."""
        if self._control.isProgramRunning():
            self._control.stopL(self._deceleration_m_s2, True)
        return True

    def leave(self) -> bool:
        """End the control script, so that the robot is free for others; the arm brakes if it still moves."""
        self._control.stopScript()
        return True


class WorkerServer:
    """Answers packets, one at a time."""

    def __init__(self, host: str) -> None:
        self._host = host
        self.motion: MotionControl | None = None

    def answer(self, packet: bytes) -> dict[str, Any]:
        """Do what one packet asks."""
        name, *arguments = json.loads(packet)
        try:
            return {"ok": self._calls[name](*arguments)}
        except MotionRefused as error:
            return {"refused": str(error)}
        except ControllerLost as error:
            return {"lost": str(error)}
        except Exception as error:
            return {"lost": f"{type(error).__name__}: {error}"}

    @property
    def _calls(self) -> dict[str, Callable[..., Any]]:
        motion = self.motion
        if motion is None:
            return {"connect": self._connect}
        return {"beat": motion.beat, "move": motion.move, "stop": motion.stop, "leave": motion.leave}

    def _connect(self, watchdog_hz: float, deceleration_m_s2: float, upper: bool) -> bool:
        self.motion = MotionControl(self._host, watchdog_hz, deceleration_m_s2, upper)
        return True


def main() -> None:
    """Serve until the other end closes; then stop the arm."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    quiet = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # ur-rtde tells all that happens to it; what matters goes back over the link
        os.dup2(quiet, stream)
    fd, host = sys.argv[1:3]
    server = WorkerServer(host)
    with socket.socket(fileno=int(fd)) as link:
        while packet := link.recv(PACKET_BYTES):
            signal.alarm(LONGEST_CALL_S)
            link.send(json.dumps(server.answer(packet)).encode())
            signal.alarm(0)
    signal.alarm(LONGEST_CALL_S)
    if server.motion is not None:
        server.motion.stop()
        server.motion.leave()


if __name__ == "__main__":
    main()
