"""Wire format of RTDE version 2, shared by the pose reader and the emulator.

Every message is `uint16 size (these 3 bytes included) | uint8 type | payload`, big endian. A client
sends V (version), v (which controller), O (outputs to read), I (inputs to write), S (start), then
receives data packages U: `uint8 recipe | values in recipe order`. All functions are pure.
"""

import struct
from collections.abc import Sequence
from enum import IntEnum
from functools import cache

PORT = 30004
PROTOCOL = 2
CONTROLLER_RATE_HZ = 500.0

Value = float | int | tuple[float, ...] | tuple[int, ...]


class Kind(IntEnum):
    """Message types: the ASCII code of a mnemonic letter."""

    PROTOCOL = ord("V")
    CONTROLLER = ord("v")
    OUTPUTS = ord("O")
    INPUTS = ord("I")
    START = ord("S")
    PAUSE = ord("P")
    DATA = ord("U")
    TEXT = ord("M")


_CODES = {
    "BOOL": "B",
    "UINT8": "B",
    "UINT32": "I",
    "INT32": "i",
    "UINT64": "Q",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

_VECTOR6 = (
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_control_output",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_TCP_pose",
    "target_TCP_speed",
    "joint_temperatures",
    "actual_joint_voltage",
    "ft_raw_wrench",
    "payload_inertia",
    "tcp_offset",
)
_SCALARS = (
    "timestamp",
    "actual_execution_time",
    "speed_scaling",
    "target_speed_fraction",
    "actual_momentum",
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "standard_analog_input0",
    "standard_analog_input1",
    "standard_analog_output0",
    "standard_analog_output1",
    "payload",
)

# Variables that a controller of version 5.12 can report, and their types.
OUTPUTS: dict[str, str] = {
    **dict.fromkeys(_VECTOR6, "VECTOR6D"),
    **dict.fromkeys(_SCALARS, "DOUBLE"),
    **dict.fromkeys(
        ("actual_tool_accelerometer", "elbow_position", "elbow_velocity", "payload_cog"), "VECTOR3D"
    ),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
    **dict.fromkeys(("robot_mode", "safety_mode", "safety_status"), "INT32"),
    **dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits"), "UINT32"),
    **dict.fromkeys(("output_bit_registers0_to_31", "output_bit_registers32_to_63"), "UINT32"),
    "joint_mode": "VECTOR6INT32",
    **{f"output_int_register_{k}": "INT32" for k in range(48)},
    **{f"output_double_register_{k}": "DOUBLE" for k in range(48)},
}

# Variables that a client may write, and their types.
INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    **dict.fromkeys(
        (
            "standard_digital_output_mask",
            "standard_digital_output",
            "configurable_digital_output_mask",
            "configurable_digital_output",
            "tool_digital_output_mask",
            "tool_digital_output",
            "standard_analog_output_mask",
            "standard_analog_output_type",
        ),
        "UINT8",
    ),
    **dict.fromkeys(("standard_analog_output_0", "standard_analog_output_1"), "DOUBLE"),
    "external_force_torque": "VECTOR6D",
    **{f"input_int_register_{k}": "INT32" for k in range(48)},
    **{f"input_double_register_{k}": "DOUBLE" for k in range(48)},
}


def pack_message(kind: int, payload: bytes = b"") -> bytes:
    """Frame one message."""
    return struct.pack(">HB", len(payload) + 3, kind) + payload


def split_messages(buffer: bytearray) -> list[tuple[int, bytes]]:
    """Remove every complete (type, payload) from the front of `buffer`; keep a partial one."""
    messages = []
    start = 0
    while len(buffer) - start >= 3:
        size, kind = struct.unpack_from(">HB", buffer, start)
        if size < 3:
            raise ValueError(f"RTDE message of size {size}; the least is 3")
        if len(buffer) - start < size:
            break
        messages.append((kind, bytes(buffer[start + 3 : start + size])))
        start += size
    del buffer[:start]
    return messages


def pack_output_request(rate_hz: float, names: Sequence[str]) -> bytes:
    """Pack the payload of a client's O message: the rate, then names separated by commas."""
    return struct.pack(">d", rate_hz) + ",".join(names).encode()


def unpack_output_request(payload: bytes) -> tuple[float, list[str]]:
    """Return rate [Hz] and names of an O request, dropping ur_rtde's comma at the end."""
    return struct.unpack_from(">d", payload)[0], unpack_names(payload[8:])


def unpack_names(payload: bytes) -> list[str]:
    """Return the names of an I request or the types of a reply, empty ones dropped."""
    return [name for name in payload.decode().split(",") if name]


def pack_recipe(number: int, types: Sequence[str]) -> bytes:
    """Pack the payload of the controller's reply to O or I; number 0 means rejected."""
    return bytes([number]) + ",".join(types).encode()


def unpack_recipe(payload: bytes) -> tuple[int, list[str]]:
    """Return recipe number and types of the controller's reply to O or I."""
    if not payload:
        raise ValueError("RTDE recipe reply without content")
    return payload[0], unpack_names(payload[1:])


@cache
def layout(types: tuple[str, ...]) -> struct.Struct:
    """Return the packing of one recipe's values, without the recipe number."""
    unknown = [name for name in types if name not in _CODES]
    if unknown:
        raise ValueError(f"RTDE types {unknown}; known: {sorted(_CODES)}")
    return struct.Struct(">" + "".join(_CODES[name] for name in types))


@cache
def _widths(types: tuple[str, ...]) -> tuple[int, ...]:
    return tuple(int(code[0]) if len(code) > 1 else 0 for code in map(_CODES.__getitem__, types))


def pack_values(types: tuple[str, ...], values: Sequence[Value]) -> bytes:
    """Pack the values of one data package, in recipe order."""
    flat: list[float | int] = []
    for width, value in zip(_widths(types), values, strict=True):
        if width:
            flat.extend(value)  # type: ignore[arg-type]
        else:
            flat.append(value)  # type: ignore[arg-type]
    return layout(types).pack(*flat)


def unpack_values(types: tuple[str, ...], data: bytes) -> list[Value]:
    """Return the values of one data package, in recipe order; vectors as tuples."""
    packing = layout(types)
    if len(data) != packing.size:
        raise ValueError(f"RTDE package of {len(data)} bytes; the recipe has {packing.size}")
    flat = packing.unpack(data)
    values: list[Value] = []
    at = 0
    for width in _widths(types):
        if width:
            values.append(flat[at : at + width])
            at += width
        else:
            values.append(flat[at])
            at += 1
    return values
