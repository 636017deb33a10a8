"""Meaning of the reports of pedals and SpaceMice."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.config import build
from rig.core.errors import ConfigError
from rig.devices.hid.drivers import DeadMan, PedalState
from rig.devices.hid.reports import CapReport, emit_cap, emit_keys, parse_cap, parse_keys
from rig.devices.hid.settings import PedalConfig, SpaceMouseConfig

parts = st.integers(-350, 350).map(lambda count: count / 350)
axes = st.tuples(parts, parts, parts)


@given(st.sets(st.integers(4, 0xDF), max_size=6), st.sets(st.integers(0xE0, 0xE7)))
def test_keys_are_read_back_as_they_were_pressed(keys: set[int], modifiers: set[int]) -> None:
    assert parse_keys(emit_keys([*keys, *modifiers])) == keys | modifiers


@pytest.mark.parametrize(
    ("report", "keys"),
    [("0000050000000000", {5}), ("0000000000000000", set()), ("010000050000000000", {5})],
    ids=["the letter b of a pedal as delivered", "its release", "with its number before it"],
)
def test_reports_of_a_pedal_are_keys(report: str, keys: set[int]) -> None:
    assert parse_keys(bytes.fromhex(report)) == keys


@pytest.mark.parametrize("report", ["", "0000", "00" * 12, "0000010101010101", "0007050000000000"])
def test_what_is_no_keyboard_report_or_an_error_is_refused(report: str) -> None:
    with pytest.raises(ValueError, match=r"keyboard"):
        parse_keys(bytes.fromhex(report))


@given(axes, axes)
def test_a_cap_is_read_back_as_it_was_pushed(shift, turn) -> None:
    for report in (CapReport(shift=shift), CapReport(turn=turn), CapReport(shift, turn)):
        found = parse_cap(emit_cap(report))
        assert (found.shift, found.turn) == (
            report.shift and pytest.approx(report.shift),
            report.turn and pytest.approx(report.turn),
        )


@pytest.mark.parametrize(
    ("report", "shift", "turn"),
    [
        # In the raw report, y points towards the user and z down.
        ("01 af00 51ff a2fe", (0.5, 0.5, 1.0), None),
        ("01 0000 0000 0000 5e01 0000 0000", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ("02 f401 0000 0000", None, (1.0, 0.0, 0.0)),
    ],
    ids=["right, away and up", "all six of a wireless model", "beyond full scale"],
)
def test_reports_of_a_cap_are_shift_and_turn(report: str, shift: object, turn: object) -> None:
    found = parse_cap(bytes.fromhex(report))
    assert (found.shift, found.turn) == (shift, turn)


@given(st.frozensets(st.integers(0, 15)))
def test_buttons_are_read_back_as_they_were_pressed(buttons: frozenset[int]) -> None:
    assert parse_cap(emit_cap(CapReport(buttons=buttons))).buttons == buttons


@pytest.mark.parametrize("report", ["", "01", "020000", "17000000000000", "03"])
def test_what_is_no_report_of_a_spacemouse_is_refused(report: str) -> None:
    with pytest.raises(ValueError, match="unknown"):
        parse_cap(bytes.fromhex(report))


def test_a_report_that_says_nothing_or_too_much_cannot_be_sent() -> None:
    for report in (CapReport(), CapReport(shift=(0, 0, 0), buttons=frozenset())):
        with pytest.raises(ValueError, match="allowed"):
            emit_cap(report)
    with pytest.raises(ValueError, match="up to 6"):
        emit_keys(list(range(4, 11)))


# The dead-man pedal.

UP = PedalState()
DOWN = UP.reported(True)


def test_a_press_arms_a_release_disarms_and_pressed_again_it_is_armed_again() -> None:
    dead_man, up = DeadMan(), DOWN.reported(False)
    assert not dead_man.armed(UP)
    assert dead_man.armed(DOWN)
    assert dead_man.held(DOWN)
    assert not dead_man.held(up)
    # A release and a press that were too quick to be seen.
    assert not dead_man.held(up.reported(True))
    assert not dead_man.armed(up)
    assert not dead_man.armed(up)
    assert dead_man.armed(up.reported(True))


def test_a_pedal_kept_down_while_the_arm_left_needs_a_release_first() -> None:
    dead_man = DeadMan()
    dead_man.armed(DOWN)
    again = DOWN.reported(False).reported(True)
    dead_man.disarm(again)
    assert not dead_man.armed(again)
    assert not dead_man.armed(again.reported(False))
    assert dead_man.armed(again.reported(False).reported(True))


def test_an_unplugged_pedal_is_a_released_one_and_back_in_it_is_up() -> None:
    dead_man = DeadMan()
    dead_man.armed(DOWN)
    out = DOWN.unplugged(5)
    assert not dead_man.held(out)
    assert out.out_since_ns == 5
    back = out.plugged()
    assert not back.down
    assert back.out_since_ns is None
    assert not dead_man.armed(back)
    assert dead_man.armed(back.reported(True))


@given(st.lists(st.sampled_from(["down", "up", "out", "in"]), max_size=30))
def test_whatever_happens_it_is_never_held_while_it_is_up(events: list[str]) -> None:
    dead_man, state = DeadMan(), UP
    for event in events:
        state = {
            "down": state.reported(True),
            "up": state.reported(False),
            "out": state.unplugged(1),
            "in": state.plugged(),
        }[event]
        before = dead_man.held(state)
        if event in ("up", "out"):
            assert not before
        assert dead_man.armed(state) <= state.down


@pytest.mark.parametrize(
    ("spec", "key", "value"),
    [
        (PedalConfig, "device", "hidraw3"),
        (PedalConfig, "device", "3553:B001"),
        (PedalConfig, "mode", "deadman"),
        (PedalConfig, "unplugged_limit_s", 0.0),
        (PedalConfig, "key", 256),
        (SpaceMouseConfig, "speed_max_mm_s", 50.0),
        (SpaceMouseConfig, "silence_ms", 5000.0),
        (SpaceMouseConfig, "dead_zone", 1.0),
    ],
)
def test_a_bench_file_that_makes_no_sense_is_refused(spec: type, key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=key.removesuffix("_s").removesuffix("_m").split("_")[0]):
        build(spec, {"device": "/dev/hidraw0", key: value}, "bench.x")
