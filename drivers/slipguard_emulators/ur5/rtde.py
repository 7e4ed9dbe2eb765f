"""RTDE version 2 on the controller's side: variables and their types, messages, recipes.

Written from the public description of the protocol, without code of the driver, so that the two check each other.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Mapping, Sequence
from typing import TypeAlias

Value: TypeAlias = float | Sequence[float]

FORMATS = {
    "DOUBLE": "d",
    "VECTOR6D": "6d",
    "VECTOR3D": "3d",
    "INT32": "i",
    "UINT32": "I",
    "UINT64": "Q",
    "VECTOR6INT32": "6i",
    "UINT8": "B",
    "BOOL": "?",
}
_OUTPUTS = {
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
        joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed
        joint_temperatures actual_joint_voltage ft_raw_wrench payload_inertia actual_current_as_torque tcp_offset""",
    "DOUBLE": """timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1
        standard_analog_output0 standard_analog_output1 payload""",
    "VECTOR3D": "actual_tool_accelerometer payload_cog",
    "INT32": "robot_mode safety_mode",
    "VECTOR6INT32": "joint_mode",
    "UINT32": "runtime_state robot_status_bits safety_status_bits",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
}
_INPUTS = {
    "VECTOR6D": "external_force_torque",
    "UINT32": "speed_slider_mask",
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "UINT8": """standard_digital_output_mask standard_digital_output configurable_digital_output_mask
        configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask
        standard_analog_output_type""",
}
OUTPUTS = {name: kind for kind, names in _OUTPUTS.items() for name in names.split()}
INPUTS = {name: kind for kind, names in _INPUTS.items() for name in names.split()}
_REGISTER = re.compile(r"(input|output)_(int|double)_register_(\d+)")
REGISTERS = 48


def type_of(name: str, direction: str) -> str:
    """Return the RTDE type of an "input" or "output"; NOT_FOUND for an unknown name."""
    if match := _REGISTER.fullmatch(name):
        known = match[1] == direction and int(match[3]) < REGISTERS
        return ("INT32" if match[2] == "int" else "DOUBLE") if known else "NOT_FOUND"
    return (OUTPUTS if direction == "output" else INPUTS).get(name, "NOT_FOUND")


def message(kind: str, payload: bytes) -> bytes:
    """Return a message: size (which includes itself), type, payload; big endian."""
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


def names_in(payload: bytes) -> list[str]:
    """Return the names of a recipe; a trailing comma is allowed."""
    return [name for name in payload.decode().split(",") if name]


class InputRecipe:
    """The inputs that a client sends under one number."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names
        self._layouts = [struct.Struct(">" + FORMATS[type_of(name, "input")]) for name in names]

    def values(self, payload: bytes) -> dict[str, Value]:
        """Return the values by name; vectors as tuples."""
        found: dict[str, Value] = {}
        at = 0
        for name, layout in zip(self.names, self._layouts, strict=True):
            values = layout.unpack_from(payload, at)
            at += layout.size
            found[name] = values[0] if len(values) == 1 else values
        return found


class OutputRecipe:
    """The outputs that a client receives, every `every` cycles."""

    def __init__(self, names: Sequence[str], every: int) -> None:
        self.names = names
        self.every = every
        kinds = [type_of(name, "output") for name in names]
        self._layout = struct.Struct(">B" + "".join(FORMATS[kind] for kind in kinds))
        self._zeros = [
            tuple(struct.Struct(FORMATS[kind]).unpack(bytes(struct.calcsize(FORMATS[kind])))) for kind in kinds
        ]

    def packet(self, values: Mapping[str, Sequence[float]]) -> bytes:
        """Return a data message; variables that `values` does not name are zero."""
        parts = (values.get(name, zero) for name, zero in zip(self.names, self._zeros, strict=True))
        return message("U", self._layout.pack(1, *itertools.chain.from_iterable(parts)))
