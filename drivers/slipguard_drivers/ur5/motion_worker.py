"""ur-rtde in a process of its own: `python -m slipguard_drivers.ur5.motion_worker SOCKET_FD HOST`.

In the daemon itself, ur-rtde's constructors would block the interpreter while a controller is silent, a synchronous
move would wait up to 300 s, and a dropped connection could crash the daemon. Here it only ends this process. The
robot's own watchdog, started before any motion, stops the arm when the `beat` requests end.

One thread makes all calls, because a second one overwrites the command register. Moves and stops are asynchronous,
because the script executes a synchronous `stopL` as `stopj`. Packets are JSON: the request is `[name, arguments...]`,
the reply `{"ok": result}`, `{"refused": reason}` or `{"lost": reason}`. The first request is `connect`.
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

from slipguard.thread_priority import set_normal_priority
from slipguard_drivers.child_process import PACKET_BYTES

SCRIPT_START_TIMEOUT_S = 5.0
POLL_S = 0.005
CALL_MAX_S = 30
"""The kernel ends a longer call, and this process with it. ur-rtde can wait forever for a controller that is gone,
block the interpreter meanwhile, and take control of the robot when the controller is back. A running daemon ends the
process sooner; this is for a daemon that was killed."""


class ControllerLost(Exception):
    """The controller is gone or no longer runs the script: this process cannot be used any more."""


class MotionRefused(Exception):
    """The robot's state does not allow the motion."""


class MotionControl:
    """The calls that the arm driver needs.

    mark: three numbers that the script writes to its first output registers, until `leave`. upper_registers: use the
    registers from 24 on, the lower ones are in use.
    """

    def __init__(
        self, host: str, watchdog_hz: float, deceleration_m_s2: float, mark: list[float], upper_registers: bool
    ) -> None:
        flags = RTDEControlInterface.FLAGS_DEFAULT
        if upper_registers:
            flags |= RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
        self._deceleration_m_s2 = deceleration_m_s2
        self._control = RTDEControlInterface(host, -1.0, flags)
        deadline_s = time.monotonic() + SCRIPT_START_TIMEOUT_S
        while not self._control.isProgramRunning():
            if time.monotonic() > deadline_s:
                raise ControllerLost("the control script does not start; see the message on the robot's panel")
            signal.sigtimedwait([], POLL_S)  # sleeps; no other thread runs in this process
        if not self._control.setWatchdog(watchdog_hz):
            raise ControllerLost("the robot's watchdog cannot be started; open the arm again")
        self._write_mark(mark)

    def beat(self) -> dict[str, Any]:
        """Feed the watchdog; return whether the script runs and whether a motion is under way."""
        # A lost connection must end this process before ur-rtde reconnects and restarts the script by itself.
        if not self._control.isConnected():
            raise ControllerLost("the connection to the controller was lost; open the arm again")
        running = bool(self._control.isProgramRunning())
        if running:
            self._control.kickWatchdog()
        moving = running and bool(self._control.getAsyncOperationProgressEx().isAsyncOperationRunning())
        return {"running": running, "moving": moving}

    def move(self, pose: list[float], speed_m_s: float, acceleration_m_s2: float) -> bool:
        """Start a straight move to a pose; only allowed while the arm is at rest."""
        if not self._control.isProgramRunning():
            raise ControllerLost("the control script is not running; open the arm again")
        if not self._control.moveL(pose, speed_m_s, acceleration_m_s2, True):
            raise MotionRefused("the controller did not accept the move")
        return True

    def stop(self) -> bool:
        """Start braking. A script that is not running moves nothing."""
        if self._control.isProgramRunning():
            self._control.stopL(self._deceleration_m_s2, True)
        return True

    def leave(self) -> bool:
        """End the control script, so that other programs can use the robot; a moving arm brakes."""
        try:
            if self._control.isProgramRunning():  # a paused script executes nothing
                self._write_mark([0.0, 0.0, 0.0])
        finally:
            self._control.stopScript()
        return True

    def _write_mark(self, mark: list[float]) -> None:
        """Let the script write three of its output registers: a frame at `mark`, seen from the origin, is at `mark`."""
        self._control.poseTrans([*mark, 0.0, 0.0, 0.0], [0.0] * 6)


class WorkerServer:
    """Executes requests, one at a time."""

    def __init__(self, host: str) -> None:
        self._host = host
        self.motion: MotionControl | None = None

    def reply(self, packet: bytes) -> dict[str, Any]:
        """Execute one request and return its reply."""
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

    def _connect(self, watchdog_hz: float, deceleration_m_s2: float, mark: list[float], upper_registers: bool) -> bool:
        self.motion = MotionControl(self._host, watchdog_hz, deceleration_m_s2, mark, upper_registers)
        return True


def main() -> None:
    """Serve until the other end closes the socket; then stop the arm.

    ur-rtde polls without a pause, so it must not have the real-time priority that the daemon hands down.
    """
    set_normal_priority()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # ur-rtde prints every event; what matters is in the replies
        os.dup2(silent, stream)
    fd, host = sys.argv[1:3]
    server = WorkerServer(host)
    with socket.socket(fileno=int(fd)) as link:
        while packet := link.recv(PACKET_BYTES):
            signal.alarm(CALL_MAX_S)
            link.send(json.dumps(server.reply(packet)).encode())
            signal.alarm(0)
    signal.alarm(CALL_MAX_S)
    if server.motion is not None:
        server.motion.stop()
        server.motion.leave()


if __name__ == "__main__":
    main()
