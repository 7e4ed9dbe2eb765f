"""The commands and questions of the dashboard, with the answers of a real one."""

from __future__ import annotations

from slipguard_emulators.ur5.controller import IDLE, PAUSED, PLAYING, POWER_OFF, RUNNING, EmulatedController

GREETING = "Connected: Universal Robots Dashboard Server"
NOT_IN_LOCAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)
TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)
POWER = {
    "power on": (IDLE, "Powering on"),
    "power off": (POWER_OFF, "Powering off"),
    "brake release": (RUNNING, "Brake releasing"),
}
"""What each order switches the arm to, and the answer. `brake release` also switches it on."""
MODES = {POWER_OFF: "POWER_OFF", IDLE: "IDLE", RUNNING: "RUNNING"}
ORDERS = ("play", "pause", "stop", "unlock protective stop", "close safety popup", *POWER)


class DashboardServer:
    """One connection. A connection that was made in local control refuses all commands."""

    def __init__(self, controller: EmulatedController, version: tuple[int, ...]) -> None:
        self._controller = controller
        self._version = version
        self._may_order = controller.remote

    def answer(self, line: str, now_s: float) -> str:
        """Return the answer to one line, in upper or lower case."""
        asked = line.strip().lower()
        if asked in ORDERS:
            return self._order(asked, now_s) if self._may_order else NOT_IN_LOCAL
        return self._questions(now_s).get(asked, f"could not understand: '{line.strip()}'")

    def _order(self, order: str, now_s: float) -> str:
        robot = self._controller
        if order == "play":
            return "Starting program" if robot.play(now_s) else "Failed to execute: play"
        if order == "pause":
            return "Pausing program" if robot.pause(now_s) else "Failed to execute: pause"
        if order == "stop":
            if robot.refuses_stop and robot.safety != "NORMAL":
                return "Failed to execute: stop"
            robot.end("stopped by the dashboard", now_s)
            return "Stopped"
        if order == "unlock protective stop":
            return "Protective stop releasing" if robot.unlock(now_s) else TOO_EARLY
        if order in POWER:
            mode, answer = POWER[order]
            robot.power(mode, now_s)
            return answer
        return "closing safety popup"

    def _questions(self, now_s: float) -> dict[str, str]:
        robot = self._controller
        name = robot.program.name if robot.program is not None else "shuttle.urp"
        state = {PLAYING: "PLAYING", PAUSED: "PAUSED"}.get(robot.runtime, "STOPPED")
        answers = {
            "polyscopeversion": f"URSoftware {'.'.join(map(str, self._version))} (Nov 01 2024)",
            "robotmode": f"Robotmode: {MODES[robot.mode]}",
            "safetymode": f"Safetymode: {robot.safety}",
            "safetystatus": f"Safetystatus: {robot.safety}",
            "programstate": f"{state} {name}",
            "running": f"Program running: {str(robot.runtime == PLAYING).lower()}",
            "get loaded program": f"Loaded program: /programs/{name}",
            "quit": "Disconnected",
        }
        if self._version[0] >= 5:
            answers |= {
                "get serial number": "20225500001",
                "get robot model": "UR5",
                "is in remote control": str(robot.remote).lower(),
            }
        return answers
