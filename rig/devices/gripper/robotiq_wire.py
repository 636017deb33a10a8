"""Registers of a Robotiq 2F gripper, and their Modbus RTU frames. Pure, no I/O.

    write from 0x03E8   rACT b0, rGTO b3 (high byte of the first) | rPR | rSP << 8 | rFR
    read  from 0x07D0   gACT b0, gGTO b3, gSTA b4-5, gOBJ b6-7 (high byte) | gFLT << 8 | gPR
                        | gPO << 8 | gCU

Positions are counts: 0 open, 255 closed, about 0.4 mm each on a 2F-85. Source: Robotiq 2F-85 and
2F-140 instruction manual, chapter Control.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

# First register to write, first to read, and the number of each.
COMMAND_ADDRESS, STATUS_ADDRESS, REGISTERS = 0x03E8, 0x07D0, 3

# gSTA.
RESET, ACTIVATING, ACTIVE = 0, 1, 3
# gOBJ: moving; stopped by an object while opening, while closing; no object in between.
MOVING, STOPPED_OPENING, STOPPED_CLOSING, AT_POSITION = 0, 1, 2, 3

# Motor current of one count of gCU [A].
CURRENT_PER_COUNT = 0.01

# gFLT after a second without communication.
SILENT_FAULT = 9
# Meaning of gFLT as text.
FAULTS = {
    5: "action delayed, the activation must be completed first",
    7: "the activation bit must be set first",
    8: "too hot",
    SILENT_FAULT: "no communication for a second",
    10: "supply voltage too low",
    11: "automatic release in progress",
    12: "internal fault",
    13: "activation fault",
    14: "overcurrent",
    15: "automatic release completed",
}


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """Command to the gripper: activate, and go to a position."""

    activate: bool = True
    """rACT; False resets it."""
    go: bool = False
    """rGTO: move to the position; False: stop."""
    position: int = 0
    """rPR: 0 open to 255 closed."""
    speed: int = 0
    """rSP: 0 slowest to 255."""
    force: int = 0
    """rFR: 0 weakest to 255."""

    def __post_init__(self) -> None:
        for name in ("position", "speed", "force"):
            value = getattr(self, name)
            if not 0 <= value <= 255:
                raise ValueError(f"{name}: found {value!r}; allowed: 0 to 255")


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """Status reported by the gripper."""

    active: bool
    """gACT: True if it was commanded to activate."""
    going: bool
    """gGTO: True if it was commanded to move."""
    state: int
    """gSTA: RESET, ACTIVATING or ACTIVE."""
    object: int
    """gOBJ: MOVING, STOPPED_OPENING, STOPPED_CLOSING or AT_POSITION."""
    fault: int
    """gFLT: 0 none."""
    requested: int
    """gPR: requested position, counts."""
    position: int
    """gPO: current position, counts."""
    current: float
    """Motor current [A]."""

    @property
    def holding(self) -> bool:
        """True if the fingers rest on an object, inside or outside of it."""
        return self.state == ACTIVE and self.object in (STOPPED_OPENING, STOPPED_CLOSING)

    @property
    def text(self) -> str:
        """Status as text."""
        state = {RESET: "reset", ACTIVATING: "activating", ACTIVE: "active"}
        detection = ("moving", "holds from inside", "holds", "no object")[self.object]
        fault = f", fault {self.fault}: {fault_text(self.fault)}" if self.fault else ""
        return (
            f"{state.get(self.state, 'state 2')}, {detection}, position {self.position} of 255"
            f" ({self.current:.2f} A){fault}"
        )


def fault_text(fault: int) -> str:
    """Return the meaning of gFLT as text."""
    return FAULTS.get(fault, "unknown to the manual")


def emit_command(command: GripperCommand) -> tuple[int, int, int]:
    """Return the registers to write from COMMAND_ADDRESS."""
    action = (command.activate << 0) | (command.go << 3)
    return (action << 8, command.position, command.speed << 8 | command.force)


def parse_command(registers: Sequence[int]) -> GripperCommand:
    """Parse three written registers: the inverse of `emit_command`."""
    action, position, drive = registers
    return GripperCommand(
        activate=bool(action & 0x100),
        go=bool(action & 0x800),
        position=position & 0xFF,
        speed=drive >> 8,
        force=drive & 0xFF,
    )


def emit_status(status: GripperStatus) -> tuple[int, int, int]:
    """Return the registers to read from STATUS_ADDRESS."""
    byte = status.active | status.going << 3 | status.state << 4 | status.object << 6
    current = min(round(status.current / CURRENT_PER_COUNT), 255)
    return (byte << 8, status.fault << 8 | status.requested, status.position << 8 | current)


def parse_status(registers: Sequence[int]) -> GripperStatus:
    """Parse three read registers: the inverse of `emit_status`."""
    first, second, third = registers
    byte = first >> 8
    return GripperStatus(
        active=bool(byte & 1),
        going=bool(byte & 8),
        state=byte >> 4 & 3,
        object=byte >> 6 & 3,
        # The high half of the byte is kFLT, of an optional controller.
        fault=second >> 8 & 0xF,
        requested=second & 0xFF,
        position=third >> 8,
        current=(third & 0xFF) * CURRENT_PER_COUNT,
    )


# Modbus RTU frames that a gripper needs: read and write registers. Pure, no I/O.
#
#     request      slave u8 | function u8 | ... | crc u16 (little endian)
#     read         0x03 or 0x04 | address u16 | count u16
#       reply      function | bytes u8 | values u16...
#     write        0x10 | address u16 | count u16 | bytes u8 | values u16...
#       reply      function | address | count
#     refusal      function + 0x80 | code u8
#
# Everything but the CRC is big endian. Source: Modbus application protocol V1.1b3, and Modbus over
# serial line V1.02.

# Functions: read holding registers, read input registers, write several registers.
READ_HOLDING, READ_INPUT, WRITE = 0x03, 0x04, 0x10

# Codes of a refusal.
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3

_REASONS = {
    ILLEGAL_FUNCTION: "illegal function",
    ILLEGAL_ADDRESS: "illegal register address",
    ILLEGAL_VALUE: "illegal value",
    4: "device failure",
    5: "acknowledged, still working",
    6: "device busy",
}
_REFUSED = 0x80
_POLYNOMIAL = 0xA001


class FrameError(ValueError):
    """Bytes that are not a complete frame, or not the answer to the request."""


class RefusedError(ValueError):
    """Refusal of a valid request by the device."""


@dataclass(frozen=True, slots=True)
class ModbusRequest:
    """Request of a client."""

    slave: int
    function: int
    address: int
    """Address of the first register."""
    count: int
    """Number of registers."""
    values: tuple[int, ...] = ()
    """Values to write, 0..65535 each; empty for a read."""


def crc16(content: bytes) -> int:
    """Return the checksum of a frame's content: polynomial 0xA001 reflected, start 0xFFFF."""
    crc = 0xFFFF
    for byte in content:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ _POLYNOMIAL if crc & 1 else crc >> 1
    return crc


def sealed(content: bytes) -> bytes:
    """Return the frame of `content`: the content with its checksum."""
    return content + struct.pack("<H", crc16(content))


def emit_request(request: ModbusRequest) -> bytes:
    """Return the frame of `request`."""
    head = struct.pack(">BBHH", request.slave, request.function, request.address, request.count)
    if request.function in (READ_HOLDING, READ_INPUT):
        return sealed(head)
    values = struct.pack(f">{request.count}H", *request.values)
    return sealed(head + bytes([len(values)]) + values)


def reply_length(request: ModbusRequest) -> int:
    """Return the length of the reply to `request` [bytes]; a refusal has 5."""
    return 8 if request.function == WRITE else 5 + 2 * request.count


def parse_reply(frame: bytes, request: ModbusRequest) -> tuple[int, ...]:
    """Return the registers in a reply to `request`; empty after a write."""
    if len(frame) < 5:
        raise FrameError(f"{len(frame)} bytes; a reply has at least 5")
    content, (crc,) = frame[:-2], struct.unpack("<H", frame[-2:])
    if crc16(content) != crc:
        raise FrameError(f"checksum 0x{crc:04x}; its content has 0x{crc16(content):04x}")
    if content[0] != request.slave:
        raise FrameError(f"slave {content[0]} answered; expected {request.slave}")
    if content[1] == request.function | _REFUSED:
        raise RefusedError(f"refused: {_REASONS.get(content[2], f'code {content[2]}')}")
    if content[1] != request.function or len(frame) != reply_length(request):
        raise FrameError(
            f"function {content[1]} in {len(frame)} bytes; expected function {request.function}, "
            f"whose reply has {reply_length(request)}"
        )
    if request.function == WRITE:
        if struct.unpack(">HH", content[2:6]) != (request.address, request.count):
            raise FrameError("the reply is to another write")
        return ()
    if content[2] != 2 * request.count:
        raise FrameError(f"{content[2]} bytes of values; expected {2 * request.count}")
    return struct.unpack(f">{request.count}H", content[3:])


def request_length(head: bytes) -> int | None:
    """Return the length of the request that begins with `head` [bytes]; None if too short."""
    if len(head) < 7:
        return None
    # An unknown function is assumed to have two numbers, as most do.
    return 9 + head[6] if head[1] == WRITE else 8


def parse_request(frame: bytes) -> ModbusRequest:
    """Parse the frame of a request of any function: the inverse of `emit_request`."""
    content = frame[:-2]
    if len(frame) < 8 or sealed(content) != frame:
        raise FrameError("not a request, or a wrong checksum")
    slave, function, address, count = struct.unpack(">BBHH", content[:6])
    if function != WRITE:
        return ModbusRequest(slave, function, address, count)
    if content[6] != 2 * count or len(content) != 7 + 2 * count:
        raise FrameError(f"{content[6]} bytes of values for {count} registers")
    return ModbusRequest(slave, function, address, count, struct.unpack(f">{count}H", content[7:]))


def emit_reply(request: ModbusRequest, values: Sequence[int] = ()) -> bytes:
    """Return the reply that grants `request`, with the requested registers."""
    if request.function == WRITE:
        head = struct.pack(">BBHH", request.slave, WRITE, request.address, request.count)
        return sealed(head)
    packed = struct.pack(f">{len(values)}H", *values)
    return sealed(bytes([request.slave, request.function, len(packed)]) + packed)


def emit_refusal(request: ModbusRequest, code: int) -> bytes:
    """Return the reply that refuses `request`."""
    return sealed(bytes([request.slave, request.function | _REFUSED, code]))
