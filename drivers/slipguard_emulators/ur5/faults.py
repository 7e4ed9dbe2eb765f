"""The faults of an emulated controller, and which of them are safety stops."""

from __future__ import annotations

FAULTS = {
    "freeze": "no RTDE data, connections stay; with a probability: single packets are lost",
    "silence": "connections are accepted, but nothing is answered",
    "late": "data and answers are late_ms late",
    "garbage": "random bytes instead of a packet or an answer",
    "half": "only half of a packet or answer",
    "drop": "all connections are closed; until cleared, each new one too",
    "kill": "the controller is gone, its arm is at rest",
    "protective_stop": "the arm stops itself and its program pauses; clear unlocks it at once",
    "safeguard_stop": "a safeguard input is open and the program pauses; clear closes it, and the program continues",
    "enabling_stop": "a three-position switch is not pressed: only bit 10 of the safety status is set",
    "emergency_stop": "the emergency stop is pressed; clear releases it and powers the arm on",
    "refuse_stop": "the dashboard's `stop` fails during a safety stop",
    "local": "local control: no dashboard commands, no scripts",
    "fieldbus": "a fieldbus adapter holds all RTDE inputs: IN_USE",
}
STOPS = {
    "emergency_stop": "ROBOT_EMERGENCY_STOP",
    "protective_stop": "PROTECTIVE_STOP",
    "safeguard_stop": "SAFEGUARD_STOP",
    "enabling_stop": "SYSTEM_THREE_POSITION_ENABLING_STOP",
}
"""Faults that are safety stops, the gravest first."""
