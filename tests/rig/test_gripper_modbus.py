"""The gripper's frames and registers: inverse functions, and the examples of its manual."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.devices.gripper import robotiq_wire
from rig.devices.gripper.robotiq_wire import (
    ACTIVE,
    AT_POSITION,
    STOPPED_CLOSING,
    FrameError,
    GripperCommand,
    GripperStatus,
    ModbusRequest,
    RefusedError,
    emit_command,
    emit_status,
    parse_command,
    parse_status,
)

words = st.integers(0, 0xFFFF)
reads = st.builds(
    ModbusRequest, st.integers(0, 247), st.sampled_from([3, 4]), words, st.integers(1, 100)
)
writes = st.builds(
    lambda slave, address, values: ModbusRequest(slave, 16, address, len(values), tuple(values)),
    st.integers(0, 247),
    words,
    st.lists(words, min_size=1, max_size=20),
)
bytes_ = st.integers(0, 255)


def test_closing_is_the_frame_the_manual_prints() -> None:
    command = GripperCommand(go=True, position=255, speed=255, force=255)
    request = ModbusRequest(9, robotiq_wire.WRITE, 0x03E8, 3, emit_command(command))
    frame = robotiq_wire.emit_request(request)
    assert frame.hex(" ") == "09 10 03 e8 00 03 06 09 00 00 ff ff ff 42 29"


def test_reading_the_status_is_the_frame_the_manual_prints() -> None:
    assert (
        robotiq_wire.emit_request(ModbusRequest(9, 3, 0x07D0, 3)).hex(" ")
        == "09 03 07 d0 00 03 04 0e"
    )


def test_the_status_bytes_of_the_manual_mean_what_it_says() -> None:
    # F9: at the position; B9: stopped on an object while closing.
    free = parse_status((0xF900, 0x00FF, 0xFF00))
    held = parse_status((0xB900, 0x00FF, 0xBD0A))
    assert (free.state, free.object, free.holding) == (ACTIVE, AT_POSITION, False)
    assert (held.state, held.object, held.holding) == (ACTIVE, STOPPED_CLOSING, True)
    assert held.position == 0xBD
    assert held.current == pytest.approx(0.1)


@given(st.one_of(reads, writes))
def test_a_request_is_read_back_as_it_was_sent(request_sent: ModbusRequest) -> None:
    frame = robotiq_wire.emit_request(request_sent)
    assert robotiq_wire.request_length(frame[:7]) == len(frame)
    assert robotiq_wire.parse_request(frame) == request_sent


@given(reads, st.data())
def test_a_reply_is_read_back_as_it_was_sent(
    request_sent: ModbusRequest, data: st.DataObject
) -> None:
    values = data.draw(st.lists(words, min_size=request_sent.count, max_size=request_sent.count))
    frame = robotiq_wire.emit_reply(request_sent, values)
    assert len(frame) == robotiq_wire.reply_length(request_sent)
    assert robotiq_wire.parse_reply(frame, request_sent) == tuple(values)


@given(writes)
def test_the_reply_to_a_write_holds_nothing(request_sent: ModbusRequest) -> None:
    assert robotiq_wire.parse_reply(robotiq_wire.emit_reply(request_sent), request_sent) == ()


@given(reads, st.data())
def test_one_flipped_bit_is_always_noticed(
    request_sent: ModbusRequest, data: st.DataObject
) -> None:
    frame = bytearray(robotiq_wire.emit_reply(request_sent, [0] * request_sent.count))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    with pytest.raises(FrameError):
        robotiq_wire.parse_reply(bytes(frame), request_sent)


@given(st.binary(max_size=64))
def test_garbage_is_no_reply(garbage: bytes) -> None:
    with pytest.raises(FrameError):
        robotiq_wire.parse_reply(garbage, ModbusRequest(9, 4, 0x07D0, 3))


def test_an_answer_to_something_else_is_refused() -> None:
    asked = ModbusRequest(9, 4, 0x07D0, 3)
    for other in (
        ModbusRequest(8, 4, 0x07D0, 3),
        ModbusRequest(9, 3, 0x07D0, 3),
        ModbusRequest(9, 4, 0x07D0, 2),
    ):
        with pytest.raises(FrameError):
            robotiq_wire.parse_reply(robotiq_wire.emit_reply(other, [0] * other.count), asked)
    wrote = ModbusRequest(9, 16, 0x03E8, 3, (0, 0, 0))
    with pytest.raises(FrameError, match="another write"):
        robotiq_wire.parse_reply(
            robotiq_wire.emit_reply(ModbusRequest(9, 16, 0x03E9, 3, (0, 0, 0))), wrote
        )


def test_a_refusal_says_why() -> None:
    asked = ModbusRequest(9, 4, 0x0001, 3)
    with pytest.raises(RefusedError, match="illegal register address"):
        robotiq_wire.parse_reply(
            robotiq_wire.emit_refusal(asked, robotiq_wire.ILLEGAL_ADDRESS), asked
        )


@given(st.booleans(), st.booleans(), bytes_, bytes_, bytes_)
def test_a_command_survives_its_registers(
    activate: bool, go: bool, position: int, speed: int, force: int
) -> None:
    command = GripperCommand(activate, go, position, speed, force)
    assert parse_command(emit_command(command)) == command


@given(
    st.booleans(),
    st.booleans(),
    st.integers(0, 3),
    st.integers(0, 3),
    st.integers(0, 15),
    bytes_,
    bytes_,
    bytes_,
)
def test_a_status_survives_its_registers(
    active: bool,
    going: bool,
    state: int,
    found: int,
    fault: int,
    requested: int,
    position: int,
    current: int,
) -> None:
    status = GripperStatus(active, going, state, found, fault, requested, position, current * 0.01)
    assert parse_status(emit_status(status)) == status


def test_a_number_that_is_no_byte_is_refused() -> None:
    with pytest.raises(ValueError, match="force: found 256; allowed: 0 to 255"):
        GripperCommand(force=256)
