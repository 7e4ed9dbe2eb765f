"""The robot behind the emulated ports: program, registers and their owners, safety state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from slipguard_emulators.ur5.flange import Accelerometer, joints
from slipguard_emulators.ur5.rtde import Value, type_of
from slipguard_emulators.ur5.script import PROGRAM_STOP_M_S2, ControlScript, RobotProgram, ShuttleProgram
from slipguard_emulators.ur5.tool import ToolPlant

STOPPED, PLAYING, PAUSED = 1, 2, 4
"""RTDE's `runtime_state`."""
SAFETY = {
    "NORMAL": (1, 1 << 0),
    "PROTECTIVE_STOP": (3, 1 << 2 | 1 << 10),
    "SAFEGUARD_STOP": (5, 1 << 4 | 1 << 10),
    "ROBOT_EMERGENCY_STOP": (7, 1 << 6 | 1 << 7 | 1 << 10),
    "SYSTEM_THREE_POSITION_ENABLING_STOP": (13, 1 << 10),
}
"""RTDE's `safety_mode` and `safety_status_bits`, by the dashboard's name. Bit 10: stopped due to safety."""
POWER_OFF, IDLE, RUNNING = 3, 5, 7
"""RTDE's `robot_mode`: off, on with the brakes engaged, and with the brakes released."""
UNLOCK_S = 5.0
"""A protective stop can be unlocked this long after it began, no sooner."""


class EventLogger(Protocol):
    """Logs an event with its details."""

    def __call__(self, event: str, **details: object) -> None: ...


class EmulatedController:
    """One robot. All times are seconds on one clock; `client` is any object that stands for one RTDE connection.

    ready: the arm is switched on with its brakes released, and the robot is in remote control. A robot that was just
    switched on is neither. mounting_deg: tilt of the base about its x axis. payload_kg: as entered at the panel.
    """

    def __init__(
        self,
        tool: ToolPlant,
        note: EventLogger,
        *,
        ready: bool = True,
        mounting_deg: float = 0.0,
        payload_kg: float = 0.0,
    ) -> None:
        self.tool = tool
        self.safety = "NORMAL"
        self.mode = RUNNING if ready else POWER_OFF
        self.remote = ready
        self.loaded: Callable[[], RobotProgram] = lambda: ShuttleProgram(tool)
        self.program: RobotProgram | None = None
        self.runtime = STOPPED
        self.output_bits = 0
        """Standard digital outputs."""
        self.refuses_stop = False
        """The dashboard's `stop` fails during a safety stop; it is not documented whether that of a real one does."""
        self.fieldbus = False
        """A fieldbus adapter is switched on: it holds all inputs."""
        self.registers: dict[str, Sequence[float]] = {}
        """Output registers that programs have written; they keep their values when the program ends."""
        self._accelerometer, self._payload_kg = Accelerometer(mounting_deg), payload_kg
        self._inputs: dict[str, Value] = {}
        self._owners: dict[str, object] = {}
        self._note = note
        self._stopped_at_s = 0.0
        self._continues = False

    # --- what RTDE clients do ---

    def claim(self, client: object, names: Sequence[str]) -> list[str]:
        """Give inputs to `client` and return their types; with any IN_USE or NOT_FOUND, none is given."""
        kinds = [
            "IN_USE" if self.fieldbus or self._owners.get(name, client) is not client else type_of(name, "input")
            for name in names
        ]
        if not {"IN_USE", "NOT_FOUND"} & set(kinds):
            self._owners.update(dict.fromkeys(names, client))
        return kinds

    def release(self, client: object) -> None:
        """Free the inputs of a closed connection; they keep their values."""
        self._owners = {name: owner for name, owner in self._owners.items() if owner is not client}

    def take(self, values: Mapping[str, Value], now_s: float) -> None:
        """Receive input values."""
        self._inputs.update(values)
        script = self.program
        if isinstance(script, ControlScript) and script.heartbeat_name in values:
            script.last_kick_s = now_s
        if "standard_digital_output_mask" in values and "standard_digital_output" in values:
            mask, wanted = (
                int(self._number("standard_digital_output_mask")),
                int(self._number("standard_digital_output")),
            )
            bits = self.output_bits & ~mask | wanted & mask
            if bits != self.output_bits:
                self.output_bits = bits
                self._note("outputs", bits=bits)

    def outputs(self, now_s: float) -> dict[str, Sequence[float]]:
        """Return the output values of this cycle; all others are zero."""
        pose, velocity = self.tool.pose(now_s), self.tool.velocity(now_s)
        values: dict[str, Sequence[float]] = {
            "timestamp": (now_s,),
            "actual_TCP_pose": pose,
            "target_TCP_pose": pose,
            "actual_TCP_speed": velocity,
            "target_TCP_speed": velocity,
            "actual_q": joints(tuple(pose[3:])),
            "actual_tool_accelerometer": self._accelerometer.read(now_s, pose, velocity),
            "payload": (self._payload_kg,),
            "speed_scaling": (1.0,),
            "target_speed_fraction": (1.0,),
            "runtime_state": (self.runtime,),
            "safety_status_bits": (SAFETY[self.safety][1],),
            "safety_mode": (SAFETY[self.safety][0],),
            "robot_status_bits": ((self.mode != POWER_OFF) | (self.runtime == PLAYING) << 1,),
            "robot_mode": (self.mode,),
            "actual_digital_output_bits": (self.output_bits,),
        }
        if isinstance(self.program, ControlScript):
            self.registers |= self.program.outputs()
        return values | self.registers

    # --- programs ---

    def upload(self, text: str, now_s: float) -> None:
        """Start a script from the script port and end the running program.

        Ignored in local control, in a stop, and with engaged brakes.
        """
        allowed = self.remote and self._may_move
        self._note("script", name=text.split("(")[0].removeprefix("def "), accepted=allowed)
        if allowed:
            self.end("replaced by an uploaded script", now_s)
            self._start(ControlScript(text, self.tool, self._number, self._command, now_s))

    def play(self, now_s: float) -> bool:
        """Start the loaded program or continue the paused one; return whether it runs now."""
        if not self._may_move or self.runtime == PLAYING:
            return self.runtime == PLAYING
        if self.program is None:
            self._start(self.loaded())
        else:
            self.runtime = PLAYING
            self.program.resume(now_s)
            self._note("resumed", program=self.program.name)
        return True

    def pause(self, now_s: float, why: str = "by the dashboard") -> bool:
        """Pause the running program; return whether there was one."""
        if self.program is None or self.runtime != PLAYING:
            return False
        self.program.pause(now_s)
        self.runtime = PAUSED
        self._note("paused", program=self.program.name, why=why)
        return True

    def end(self, why: str, now_s: float) -> None:
        """End the running program and brake, if one runs."""
        if self.program is not None:
            self._note("ended", program=self.program.name, why=why)
            self.tool.stop(now_s, PROGRAM_STOP_M_S2)
        self.program, self.runtime = None, STOPPED
        self._continues = False

    def set_safety(self, state: str, now_s: float) -> None:
        """Start or end a stop. Every stop pauses the program, and `play` continues it afterwards.

        An emergency stop ends the program and switches the arm off. After a safeguard stop without a reset button, the
        program continues by itself.
        """
        if state == self.safety:
            return
        continues, self._continues = self._continues, False
        self.safety = state
        self._note("safety", state=state)
        if state == "NORMAL":
            if continues:
                self.play(now_s)
            return
        self._stopped_at_s = now_s
        if state == "ROBOT_EMERGENCY_STOP":
            self.end("an emergency stop", now_s)
            self._set_mode(POWER_OFF)
        else:
            paused = self.pause(now_s, state.lower().replace("_", " "))
            self._continues = paused and state == "SAFEGUARD_STOP"
        self.tool.stop(now_s, PROGRAM_STOP_M_S2)

    def unlock(self, now_s: float) -> bool:
        """End a protective stop; return whether it could be unlocked already."""
        if self.safety == "PROTECTIVE_STOP" and now_s - self._stopped_at_s < UNLOCK_S:
            return False
        if self.safety == "PROTECTIVE_STOP":
            self.set_safety("NORMAL", now_s)
        return True

    def power(self, mode: int, now_s: float) -> None:
        """Switch the arm on or off, or release its brakes; a real one takes some seconds."""
        if self.safety != "ROBOT_EMERGENCY_STOP" and not (mode == IDLE and self.mode == RUNNING):
            if mode == POWER_OFF:
                self.end("the arm was switched off", now_s)
            self._set_mode(mode)

    def _set_mode(self, mode: int) -> None:
        self.mode = mode
        self._note("robot mode", mode=mode)

    def cycle(self, now_s: float) -> None:
        """Execute one cycle of the running program."""
        if self.program is not None and self.runtime == PLAYING:
            why = self.program.cycle(now_s)
            if why is not None:
                self.end(why, now_s)

    @property
    def _may_move(self) -> bool:
        return self.safety == "NORMAL" and self.mode == RUNNING

    def _start(self, program: RobotProgram) -> None:
        self.program, self.runtime = program, PLAYING
        self._note("started", program=program.name)

    def _command(self, number: int, what: str) -> None:
        self._note("command", number=number, what=what)

    def _number(self, name: str) -> float:
        value = self._inputs.get(name, 0.0)
        assert not isinstance(value, Sequence)
        return value
