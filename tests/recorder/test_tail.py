"""The newest image can be read while its shard grows, and is never incomplete."""

from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from recorder import SessionError, StreamWriter, camera_spec, force_spec
from recorder.store.layout import create_stream
from recorder.store.reader import open_tail

SHAPE = (24, 32, 3)


def pixels(number: int) -> np.ndarray:
    return np.full(SHAPE, number % 200, dtype=np.uint8)


def jpeg(number: int) -> bytes:
    return simplejpeg.encode_jpeg(pixels(number), quality=90)


def stream(folder: Path, codec: str) -> Path:
    path = folder / "camera"
    create_stream(path, camera_spec(30.0, height=SHAPE[0], width=SHAPE[1], codec=codec))
    return path


def test_every_row_is_there_as_soon_as_it_is_appended(tmp_path: Path) -> None:
    path = stream(tmp_path, "jpeg")
    tail = open_tail(path)
    with StreamWriter.open(path) as writer:
        # Two shards and a part: the tail continues from one to the next.
        for row in range(150):
            assert tail.jpeg(row) is None
            writer.append(value=jpeg(row), device_t=0.0, t_ns=row + 1)
            assert tail.jpeg(row) == jpeg(row)
        assert tail.jpeg(3) == jpeg(3)
        assert tail.jpeg(100) == jpeg(100)
        assert tail.jpeg(1000) is None
    tail = open_tail(path)
    assert tail.jpeg(149) == jpeg(149)
    assert tail.jpeg(150) is None


def test_pixels_are_encoded_for_the_viewer(tmp_path: Path) -> None:
    path = stream(tmp_path, "zstd")
    with StreamWriter.open(path) as writer:
        writer.append(value=pixels(77), device_t=0.0, t_ns=1)
        data = open_tail(path).jpeg(0)
    assert data is not None
    assert np.abs(simplejpeg.decode_jpeg(data).astype(int) - 77).max() <= 2


def test_a_record_that_is_half_written_is_not_there(tmp_path: Path) -> None:
    path = stream(tmp_path, "jpeg")
    with StreamWriter.open(path) as writer:
        writer.append(value=jpeg(0), device_t=0.0, t_ns=1)
        writer.append(value=jpeg(1), device_t=0.0, t_ns=2)
        partial = next(path.glob("value/c/*/*/*/*.partial"))
        whole = partial.read_bytes()
        copy = tmp_path / "copy"
        copy.mkdir()
        torn = stream(copy, "jpeg")
        place = torn / partial.relative_to(path)
        place.parent.mkdir(parents=True)
        for cut in (len(whole) - 1, len(whole) - len(jpeg(1)) - 5):
            place.write_bytes(whole[:cut])
            tail = open_tail(torn)
            assert tail.jpeg(0) == jpeg(0)
            assert tail.jpeg(1) is None
        # The rest arrives, and the image is complete.
        tail = open_tail(torn)
        assert tail.jpeg(1) is None
        place.write_bytes(whole)
        assert tail.jpeg(1) == jpeg(1)
        corrupt = bytearray(whole)
        corrupt[-10] ^= 0xFF
        place.write_bytes(corrupt)
        assert tail.jpeg(1) is None


def test_a_stream_without_images_is_refused(tmp_path: Path) -> None:
    create_stream(tmp_path / "force", force_spec(1000.0))
    with pytest.raises(SessionError, match="has no images"):
        open_tail(tmp_path / "force")
