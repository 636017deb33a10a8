"""The gripper's frames and registers: inverse functions, and the examples of its manual."""

import dataclasses

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


READ = ModbusRequest(9, 3, 0x07D0, 3)
CLOSE = GripperCommand(go=True, position=255, speed=255, force=255)


@pytest.mark.parametrize(
    ("request_sent", "frame"),
    [
        (
            ModbusRequest(9, robotiq_wire.WRITE, 0x03E8, 3, emit_command(CLOSE)),
            "09 10 03 e8 00 03 06 09 00 00 ff ff ff 42 29",
        ),
        (READ, "09 03 07 d0 00 03 04 0e"),
    ],
    ids=["closing", "reading the status"],
)
def test_requests_are_the_frames_of_the_manual(request_sent: ModbusRequest, frame: str) -> None:
    assert robotiq_wire.emit_request(request_sent).hex(" ") == frame


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


@given(reads, writes, st.data())
def test_a_reply_is_read_back_as_it_was_sent_and_that_to_a_write_holds_nothing(
    read: ModbusRequest, write: ModbusRequest, data: st.DataObject
) -> None:
    values = data.draw(st.lists(words, min_size=read.count, max_size=read.count))
    frame = robotiq_wire.emit_reply(read, values)
    assert len(frame) == robotiq_wire.reply_length(read)
    assert robotiq_wire.parse_reply(frame, read) == tuple(values)
    assert robotiq_wire.parse_reply(robotiq_wire.emit_reply(write), write) == ()


@given(reads, st.binary(max_size=64), st.data())
def test_garbage_and_one_flipped_bit_are_always_noticed(
    request_sent: ModbusRequest, garbage: bytes, data: st.DataObject
) -> None:
    frame = bytearray(robotiq_wire.emit_reply(request_sent, [0] * request_sent.count))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    for wrong in (bytes(frame), garbage):
        with pytest.raises(FrameError):
            robotiq_wire.parse_reply(wrong, request_sent)


@pytest.mark.parametrize("change", [{"slave": 8}, {"function": 3}, {"count": 2}], ids=str)
def test_an_answer_to_something_else_is_refused(change: dict[str, int]) -> None:
    asked = ModbusRequest(9, 4, 0x07D0, 3)
    other = dataclasses.replace(asked, **change)
    with pytest.raises(FrameError):
        robotiq_wire.parse_reply(robotiq_wire.emit_reply(other, [0] * other.count), asked)


def test_an_answer_to_another_write_and_a_refusal_say_so() -> None:
    wrote = ModbusRequest(9, 16, 0x03E8, 3, (0, 0, 0))
    other = dataclasses.replace(wrote, address=0x03E9)
    with pytest.raises(FrameError, match="another write"):
        robotiq_wire.parse_reply(robotiq_wire.emit_reply(other), wrote)
    refusal = robotiq_wire.emit_refusal(READ, robotiq_wire.ILLEGAL_ADDRESS)
    with pytest.raises(RefusedError, match="illegal register address"):
        robotiq_wire.parse_reply(refusal, READ)


flags, two_bits = st.booleans(), st.integers(0, 3)
hundredths = bytes_.map(lambda count: count * 0.01)
commands = st.builds(GripperCommand, flags, flags, bytes_, bytes_, bytes_)
statuses = st.builds(
    *(GripperStatus, flags, flags, two_bits, two_bits, st.integers(0, 15)),
    *(bytes_, bytes_, hundredths),
)


@given(commands, statuses)
def test_a_command_and_a_status_survive_their_registers(
    command: GripperCommand, status: GripperStatus
) -> None:
    assert parse_command(emit_command(command)) == command
    assert parse_status(emit_status(status)) == status


def test_a_number_that_is_no_byte_is_refused() -> None:
    with pytest.raises(ValueError, match="force: found 256; allowed: 0 to 255"):
        GripperCommand(force=256)
