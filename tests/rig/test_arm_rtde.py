from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.devices.arm import rtde

whole = {
    "BOOL": st.integers(0, 1),
    "UINT8": st.integers(0, 255),
    "UINT32": st.integers(0, 2**32 - 1),
    "INT32": st.integers(-(2**31), 2**31 - 1),
    "UINT64": st.integers(0, 2**64 - 1),
    "DOUBLE": st.floats(allow_nan=False),
    "VECTOR3D": st.tuples(*[st.floats(allow_nan=False)] * 3),
    "VECTOR6D": st.tuples(*[st.floats(allow_nan=False)] * 6),
    "VECTOR6INT32": st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 6),
    "VECTOR6UINT32": st.tuples(*[st.integers(0, 2**32 - 1)] * 6),
}
recipes = st.lists(
    st.sampled_from(sorted(whole)).flatmap(lambda kind: st.tuples(st.just(kind), whole[kind])),
    max_size=8,
)
messages = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=60)), max_size=6)


@given(recipes)
def test_values_survive_packing(recipe):
    types = tuple(kind for kind, _ in recipe)
    values = [value for _, value in recipe]
    assert rtde.unpack_values(types, rtde.pack_values(types, values)) == values


@given(messages, st.integers(1, 40))
def test_messages_survive_any_cut_of_the_stream(sent, size):
    stream = b"".join(rtde.pack_message(kind, payload) for kind, payload in sent)
    buffer, found = bytearray(), []
    for at in range(0, len(stream), size):
        buffer += stream[at : at + size]
        found += rtde.split_messages(buffer)
    assert found == sent
    assert not buffer


def test_a_message_is_framed_as_the_manual_says():
    assert rtde.pack_message(rtde.Kind.PROTOCOL, b"\x00\x02") == b"\x00\x05V\x00\x02"


def test_an_impossible_size_is_refused():
    with pytest.raises(ValueError, match="size 2"):
        rtde.split_messages(bytearray(b"\x00\x02U..."))


def test_an_output_request_survives_packing_and_drops_the_trailing_comma_of_ur_rtde():
    payload = rtde.pack_output_request(125.0, ["timestamp", "actual_q"])
    assert rtde.unpack_output_request(payload) == (125.0, ["timestamp", "actual_q"])
    assert rtde.unpack_output_request(payload + b",")[1] == ["timestamp", "actual_q"]


def test_a_recipe_reply_survives_packing():
    payload = rtde.pack_recipe(3, ["DOUBLE", "NOT_FOUND"])
    assert rtde.unpack_recipe(payload) == (3, ["DOUBLE", "NOT_FOUND"])


def test_refused_variables_cannot_be_laid_out():
    with pytest.raises(ValueError, match="NOT_FOUND"):
        rtde.layout(("DOUBLE", "NOT_FOUND"))


def test_a_package_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="9 bytes; the recipe has 8"):
        rtde.unpack_values(("DOUBLE",), bytes(9))


def test_every_variable_has_a_known_type():
    sizes = (
        rtde.layout(tuple(rtde.OUTPUTS.values())).size,
        rtde.layout(tuple(rtde.INPUTS.values())).size,
    )
    assert all(sizes)
    assert rtde.layout(("VECTOR6D",)).size == struct.calcsize(">6d")
