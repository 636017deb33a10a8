"""HDF5 exports, read back with h5py."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.sessions import make_session, set_attrs

from recorder import Session
from recorder.convert import Options, export

STREAMS = [("camera", "force", "pose"), ("taxels", "force", "pose")]


@pytest.mark.parametrize("names", STREAMS)
def test_every_number_name_and_unit_is_there(names: tuple[str, ...], tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=names)
    export(path, tmp_path / "s.h5", "hdf5")
    session = Session(path)
    with h5py.File(tmp_path / "s.h5") as file:
        for name, stream in session.streams.items():
            group = file[f"streams/{name}"]
            assert group.attrs["rate_hz"] == stream.rate_hz
            assert set(group) == set(stream.names)
            for column in stream.small:
                found, expected = group[column][...], stream.array(column)
                assert found.dtype == expected.dtype
                np.testing.assert_array_equal(found, expected)
                assert group[column].attrs["units"]
                assert group[column].dims[0].label == "row"
        for table in ("targets", "segments", "reference", "frames"):
            expected_table = getattr(session, table)
            assert set(file[table]) == set(expected_table)
            for column, values in expected_table.items():
                assert file[table][column].dtype == values.dtype
                np.testing.assert_array_equal(file[table][column][...], values)
        assert file["frames"].attrs["rate_hz"] == 40
        assert file["frames/wrench"].attrs["units"] == "N, N m"


@pytest.mark.parametrize(
    ("codec", "images"), [("jpeg", "stored"), ("jpeg", "pixels"), ("zstd", "stored")]
)
def test_images_are_the_cameras_bytes_or_pixels(codec: str, images: str, tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera",), codec=codec, seconds=1.0)
    camera = Session(path).streams["camera"]
    export(path, tmp_path / "s.h5", "hdf5", options=Options(images=images))
    with h5py.File(tmp_path / "s.h5") as file:
        values = file["streams/camera/value"]
        if (codec, images) == ("jpeg", "stored"):
            assert [bytes(each) for each in values[...]] == [*camera.jpegs(range(len(camera)))]
            assert (values.attrs["codec"], [*values.attrs["image_shape"]]) == ("jpeg", [48, 64, 3])
        else:
            assert values.chunks == (1, 48, 64, 3)
            np.testing.assert_array_equal(values[...], camera.images(slice(None)))


def test_attributes_are_whole_however_long(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("force",), seconds=1.0)
    set_attrs(path, bench={"points": [[i, i + 0.5] for i in range(20_000)], "name": "µ"})
    export(path, tmp_path / "s.h5", "hdf5")
    with h5py.File(tmp_path / "s.h5") as file:
        for name, value in Session(path).attrs.items():
            found = file.attrs[name]
            assert (json.loads(found) if isinstance(value, dict | list) else found) == value
        assert len(file.attrs["bench"]) > 1 << 16


def test_a_stream_without_rows_is_there_and_empty(tmp_path: Path) -> None:
    def cut(name: str, columns: dict[str, object]) -> dict[str, object]:
        return {k: v[:0] for k, v in columns.items()} if name == "pose" else columns  # type: ignore[index]

    path = make_session(tmp_path / "s.zarr", names=("force", "pose"), seconds=1.0, change=cut)
    export(path, tmp_path / "s.h5", "hdf5")
    with h5py.File(tmp_path / "s.h5") as file:
        assert file["streams/pose/value"].shape == (0, 6)
