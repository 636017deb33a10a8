"""The Net F/T wire format: requests, records, the settings page, status words."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.core.errors import ConfigError
from rig.devices.force.netft_wire import (
    COMMAND_REALTIME,
    ERROR_MASK,
    FORCE_UNITS,
    RECORD,
    SATURATION_MASK,
    TORQUE_UNITS,
    Page,
    emit_page,
    emit_request,
    parse_page,
    parse_request,
    status_text,
)

UINT32 = st.integers(0, 2**32 - 1)
POSITIVE = st.floats(1e-6, 1e12)


@given(st.integers(0, 2**16 - 1), UINT32)
def test_parsing_a_request_undoes_emitting_it(command: int, samples: int) -> None:
    assert parse_request(emit_request(command, samples)) == (command, samples)


@given(
    st.builds(
        Page,
        product=st.just("Net F/T"),
        serial=st.sampled_from(["", "FT12345"]),
        runstat=UINT32,
        counts_per_force=POSITIVE,
        counts_per_torque=POSITIVE,
        force_unit=st.sampled_from(sorted(FORCE_UNITS)),
        torque_unit=st.sampled_from(sorted(TORQUE_UNITS)),
        rate_hz=st.integers(1, 7000),
    )
)
def test_parsing_a_page_undoes_emitting_it(page: Page) -> None:
    assert parse_page(emit_page(page)) == page


def test_a_request_to_stream_is_these_eight_bytes() -> None:
    assert emit_request(COMMAND_REALTIME).hex() == "1234000200000000"


def test_a_record_is_thirty_six_big_endian_bytes() -> None:
    packet = bytes.fromhex("00000001000000070000000000000001ffffffff" + "00000002" * 4)
    assert RECORD.unpack(packet) == (1, 7, 0, 1, -1, 2, 2, 2, 2)


@given(st.binary(max_size=80))
def test_any_other_packet_is_no_request(packet: bytes) -> None:
    assert (parse_request(packet) is not None) == (
        len(packet) == 8 and packet.startswith(b"\x12\x34")
    )


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"<html", "not XML"),
        (b"<netFTApi><cfgcpf>1</cfgcpf></netFTApi>", "missing"),
        (emit_page(Page()).replace(b">1000<", b">fast<"), "fast"),
    ],
)
def test_a_page_of_something_else_is_refused(content: bytes, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        parse_page(content)


def test_n_mm_is_a_thousandth_of_n_m() -> None:
    assert Page(torque_unit="N-mm").scale() == pytest.approx((1e-6, 1e-9))
    assert Page(torque_unit="N-m").scale() == pytest.approx((1e-6, 1e-6))


def test_a_pound_force_inch_is_the_pound_force_times_the_inch() -> None:
    assert TORQUE_UNITS["lbf-in"] == pytest.approx(FORCE_UNITS["lbf"] * 0.0254)
    assert TORQUE_UNITS["lbf-ft"] == pytest.approx(FORCE_UNITS["lbf"] * 0.3048)


@pytest.mark.parametrize("page", [Page(force_unit="dyn"), Page(torque_unit="Nm")])
def test_an_unknown_unit_is_refused_with_the_known_ones(page: Page) -> None:
    with pytest.raises(ConfigError, match=r"known: .*N"):
        page.scale()


def test_status_words_are_told_in_words() -> None:
    assert status_text(0) == "ok"
    assert status_text(0x80010000) == "monitor condition latched"
    assert status_text(1 << 31 | 1 << 17 | 1 << 2) == "saturation or A/D error; temperature error"
    assert "0x00008000" in status_text(1 << 15)


def test_the_latched_monitor_condition_and_saturation_are_not_among_the_errors() -> None:
    assert 0x80010000 & ERROR_MASK == 0
    assert SATURATION_MASK & ERROR_MASK == 0
    assert 1 << 28 & ERROR_MASK
