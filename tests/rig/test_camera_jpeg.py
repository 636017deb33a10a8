"""JPEG segments: size, missing Huffman tables, truncated files, the emulator's time stamp."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.jpegs import stripped, without_stamp

from rig.devices.camera.jpeg import (
    frame_stamp,
    huffman_segment,
    is_whole,
    jpeg_size,
    stamped,
    with_huffman_tables,
)


def encoded(width: int = 64, height: int = 48) -> bytes:
    image = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def decoded(jpeg: bytes) -> np.ndarray | None:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


@pytest.mark.parametrize("size", [(64, 48), (8, 8), (33, 100)])
def test_the_size_is_read_from_the_header(size: tuple[int, int]) -> None:
    assert jpeg_size(encoded(*size)) == size


def test_missing_huffman_tables_are_put_back_and_the_picture_is_the_same() -> None:
    whole = encoded()
    bare = stripped(whole)
    assert len(bare) < len(whole) - 400
    restored = with_huffman_tables(bare)
    assert huffman_segment() in restored
    image, expected = decoded(restored), decoded(whole)
    assert image is not None
    assert (image == expected).all()


def test_a_file_with_huffman_tables_is_left_as_it_is() -> None:
    whole = encoded()
    assert with_huffman_tables(whole) is whole


def test_torn_files_are_not_whole() -> None:
    whole = encoded()
    assert is_whole(whole)
    assert is_whole(whole + b"\0\0\0")
    for torn in (b"", whole[:-2], whole[: len(whole) // 2], whole[1:], b"\xff\xd8\xff\xd9"):
        assert not is_whole(torn)


@given(st.binary(max_size=200))
def test_no_bytes_break_the_parser(content: bytes) -> None:
    assert not is_whole(content)
    assert frame_stamp(content) is None


@given(st.integers(0, 2**63), st.integers(-(2**62), 2**63))
def test_a_stamp_is_read_back_and_taken_off(seq: int, t_ns: int) -> None:
    whole = b"\xff\xd8rest"
    marked = stamped(whole, seq, t_ns)
    assert frame_stamp(marked) == (seq, t_ns)
    assert without_stamp(marked) == whole


def test_a_stamped_picture_is_still_the_same_picture() -> None:
    whole = encoded()
    marked = stamped(whole, 7, 8)
    assert is_whole(marked)
    assert jpeg_size(marked) == jpeg_size(whole)
    image = decoded(marked)
    assert image is not None
    assert (image == decoded(whole)).all()


def test_a_camera_without_an_emulator_has_no_stamp() -> None:
    assert frame_stamp(encoded()) is None
    assert without_stamp(encoded()) == encoded()
    comment = b"\xff\xd8\xff\xfe\x00\x10Lavc62.28.101\0" + encoded()[2:]
    assert frame_stamp(comment) is None
